"""The spacecraft's equation of motion against rigid-body mechanics."""

import itertools
import math

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.dynamics import control_matrix, hold_step, jacobian, vector_field
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_envs.tasks.spacecraft.world import SUBSTEPS

# Not the defaults, and all different, so that no two parameters can be mistaken for each other.
ODD = Spacecraft(mass=1.7, inertia=0.6, arm=0.83, side_arm=0.37)
SYSTEMS = [pytest.param(Spacecraft(), id="default"), pytest.param(ODD, id="odd")]
headings = st.floats(-100.0, 100.0)


def random_states(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 6)) * [5, 5, 4, 1, 1, 1]


def random_controls(count, seed=1):
    return np.random.default_rng(seed).uniform(0.0, 2.0, (count, 8))


def published_control_matrix(system, heading):
    """B(phi) as printed in the method: T(phi) H."""
    arm, side = system.arm, system.side_arm
    H = np.array(
        [
            [-1, -1, 0, 0, 1, 1, 0, 0],
            [0, 0, -1, -1, 0, 0, 1, 1],
            [-arm, arm, -side, side, -arm, arm, -side, side],
        ]
    )
    turn = np.array(
        [[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]]
    )
    T = np.zeros((3, 3))
    T[:2, :2] = turn / system.mass
    T[2, 2] = 0.5 / system.inertia
    return np.vstack([np.zeros((3, 8)), T @ H])


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_control_matrix_is_the_published_one(system):
    for state in random_states(50):
        B = control_matrix(system, state)
        np.testing.assert_allclose(B, published_control_matrix(system, state[2]), atol=1e-12)


@given(headings)
def test_b_b_transposed_is_the_same_at_every_heading(heading):
    B = control_matrix(Spacecraft(), np.array([1.0, 2.0, heading, 0.3, -0.2, 0.1]))
    np.testing.assert_allclose(B @ B.T, np.diag([0, 0, 0, 4, 4, 2]), atol=1e-12)


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_equation_is_drift_plus_b_u(system):
    for state, control in zip(random_states(50), random_controls(50), strict=True):
        drift = np.concatenate([state[3:], np.zeros(3)])
        expected = drift + published_control_matrix(system, state[2]) @ control
        np.testing.assert_allclose(vector_field(system, state, control), expected, atol=1e-12)


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_jacobian_is_that_of_differences(system):
    step = 1e-6
    for state, control in zip(random_states(20), random_controls(20), strict=True):
        A, _ = jacobian(system, state, control)
        for column in range(6):
            shift = np.zeros(6)
            shift[column] = step
            slope = vector_field(system, state + shift, control)
            slope = (slope - vector_field(system, state - shift, control)) / (2.0 * step)
            np.testing.assert_allclose(A[:, column], slope, atol=1e-7)


def test_thrusters_come_in_opposing_pairs():
    columns = published_control_matrix(Spacecraft(), 0.4).T
    for one in columns:
        assert any(np.allclose(one[:5], -other[:5]) for other in columns)
    # Every unit wrench, of either sign, can be had with u >= 0.
    B = published_control_matrix(Spacecraft(), 0.4)[3:]
    for axis, sign in itertools.product(range(3), (1.0, -1.0)):
        control, residual = scipy_nnls(B, sign * np.eye(3)[axis])
        assert residual < 1e-12
        assert np.all(control >= 0.0)


def scipy_nnls(matrix, target):
    from scipy.optimize import nnls

    return nnls(matrix, target)


def test_the_wrench_drives_the_body_as_its_thrusters_do():
    for system in (Spacecraft(), ODD):
        for state, control in zip(random_states(20), random_controls(20), strict=True):
            wrench = np.array(system.wrench(list(control)))
            by_thrusters = vector_field(system, state, control)
            by_wrench = vector_field(system.by_wrench, state, wrench)
            np.testing.assert_allclose(by_wrench, by_thrusters, rtol=1e-13)


def test_a_held_step_is_the_solution_of_the_equation():
    for state, control in zip(random_states(10), random_controls(10), strict=True):
        push = np.array([0.1, -0.2, 0.3, 0.1, 0.2, -0.1])
        exact = scipy.integrate.solve_ivp(
            lambda _, x, u=control, d=push: vector_field(Spacecraft(), x, u) + d,
            (0.0, 0.1),
            state,
            rtol=1e-11,
            atol=1e-12,
        ).y[:, -1]
        held = hold_step(Spacecraft(), state, control, 0.1, push, SUBSTEPS)
        np.testing.assert_allclose(held, exact, atol=1e-7)


@pytest.mark.parametrize("spin", [0.0, 1.0, -4.0])
def test_halving_the_substep_moves_no_state_of_an_episode(spin):
    """At spins up to 5 rad/s, with thrusts that change every step."""
    rng = np.random.default_rng(3)
    coarse = fine = np.array([1.0, 2.0, 0.4, 0.0, 0.0, spin])
    for _ in range(450):
        control = rng.uniform(0.0, 1.0, 8)
        # Keeps the spin where it is, whatever the forces.
        torque = Spacecraft().wrench(list(control))[2] + 4.0 * (coarse[5] - spin)
        control += max(torque, 0.0) / 4.0 * np.array([1, 0, 1, 0, 1, 0, 1, 0])
        control += max(-torque, 0.0) / 4.0 * np.array([0, 1, 0, 1, 0, 1, 0, 1])
        coarse = hold_step(Spacecraft(), coarse, control, 0.1, None, SUBSTEPS)
        fine = hold_step(Spacecraft(), fine, control, 0.1, None, 2 * SUBSTEPS)
        assert abs(coarse[5]) < 5.0
        assert np.max(np.abs(coarse - fine)) < 1e-4


@pytest.mark.parametrize(
    ("values", "message"),
    [({"mass": 0.0}, "mass=0.0"), ({"arm": -1.0}, "arm=-1.0"), ({"inertia": math.nan}, "inertia")],
)
def test_parameters_that_are_not_physical_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Spacecraft(**values)
