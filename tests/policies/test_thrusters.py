"""Thruster allocation against a quadratic program, and the least effort against an optimiser."""

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.dynamics import hold_step, vector_field
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.tasks.spacecraft.thrusters import (
    allocate,
    thrust_for_acceleration,
    to_body,
    wrench_of_acceleration,
)

BODIES = [
    pytest.param(Spacecraft(), id="paper"),
    pytest.param(Spacecraft(mass=2.3, inertia=0.4, arm=0.7, side_arm=1.6), id="lopsided"),
]


def thruster_matrix(body):
    """Return H of the paper, written out."""
    a, b = body.arm, body.side_arm
    return np.array(
        [[-1, -1, 0, 0, 1, 1, 0, 0], [0, 0, -1, -1, 0, 0, 1, 1], [-a, a, -b, b, -a, a, -b, b]],
        dtype=float,
    )


def least_effort(body, wrench):
    """Return min ||u||^2 in closed form, shape (...)."""
    lever = 2.0 * (body.arm**2 + body.side_arm**2)
    return 0.5 * np.sum(wrench[..., :2] ** 2, axis=-1) + wrench[..., 2] ** 2 / lever


def least_thrust(matrix, wrench):
    """Solve min ||u||^2, H u = w, u >= 0 as the nonnegative dual of a projection.

    The optimum is u = max(H'y, 0) for the y that maximises w'y - ||max(H'y, 0)||^2 / 2.
    """
    answer = scipy.optimize.minimize(
        lambda y: 0.5 * np.sum(np.maximum(matrix.T @ y, 0.0) ** 2) - wrench @ y,
        np.zeros(3),
        jac=lambda y: matrix @ np.maximum(matrix.T @ y, 0.0) - wrench,
        method="BFGS",
        options={"gtol": 1e-9},
    )
    return np.maximum(matrix.T @ answer.x, 0.0)


@pytest.mark.parametrize("body", BODIES)
def test_allocation_is_the_optimum_of_the_quadratic_program(body):
    rng = np.random.default_rng(1)
    wrenches = rng.standard_normal((60, 3)) * 10.0 ** rng.uniform(-2, 1, (60, 1))
    wrenches[::6, rng.integers(3)] = 0.0
    thrusts = allocate(body, wrenches)
    for wrench, thrust in zip(wrenches, thrusts, strict=True):
        best = least_thrust(thruster_matrix(body), wrench)
        assert thrust == pytest.approx(best, abs=1e-6 * (1 + np.linalg.norm(wrench)))


@pytest.mark.parametrize("body", BODIES)
def test_allocation_agrees_with_a_convex_solver(body):
    import cvxpy

    wrench = np.array([0.3, -1.1, 0.8])
    thrust = cvxpy.Variable(8, nonneg=True)
    problem = cvxpy.Problem(
        cvxpy.Minimize(cvxpy.sum_squares(thrust)), [thruster_matrix(body) @ thrust == wrench]
    )
    problem.solve(solver="CLARABEL")
    assert problem.status == "optimal"
    assert allocate(body, wrench) == pytest.approx(thrust.value, abs=1e-5)
    assert least_effort(body, wrench) == pytest.approx(problem.value, rel=1e-6)


@given(
    wrench=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    arm=st.floats(0.1, 10.0),
    side_arm=st.floats(0.1, 10.0),
)
def test_allocation_pushes_only_and_makes_the_wrench(wrench, arm, side_arm):
    body = Spacecraft(arm=arm, side_arm=side_arm)
    wrench = np.array(wrench)
    thrust = allocate(body, wrench)
    assert np.all(thrust >= 0.0)
    assert np.array(body.wrench(list(thrust))) == pytest.approx(wrench, rel=1e-9, abs=1e-9)
    assert np.sum(thrust**2) == pytest.approx(least_effort(body, wrench), rel=1e-9, abs=1e-12)


def test_no_opposing_pair_fires_together():
    thrusts = allocate(Spacecraft(), np.random.default_rng(2).standard_normal((100, 3)))
    for one, other in ((0, 5), (1, 4), (2, 7), (3, 6)):
        assert np.all(np.minimum(thrusts[:, one], thrusts[:, other]) == 0.0)


def test_batches_of_any_shape_agree_with_single_wrenches():
    body = Spacecraft()
    wrenches = np.random.default_rng(3).standard_normal((4, 5, 3))
    thrusts = allocate(body, wrenches)
    assert thrusts.shape == (4, 5, 8)
    for index in np.ndindex(4, 5):
        assert np.array_equal(thrusts[index], allocate(body, wrenches[index]))


@pytest.mark.parametrize("body", BODIES)
def test_thrust_gives_the_acceleration_at_every_heading(body):
    rng = np.random.default_rng(4)
    state, acceleration = rng.uniform(-4, 4, (50, 6)), rng.standard_normal((50, 3))
    thrust = thrust_for_acceleration(body, state, acceleration)
    rates = vector_field(body, state, thrust)
    assert rates[:, 3:] == pytest.approx(acceleration, abs=1e-12)
    wrench = wrench_of_acceleration(body, state, acceleration)
    assert vector_field(body.by_wrench, state, wrench) == pytest.approx(rates, abs=1e-12)


def test_effort_of_a_force_does_not_depend_on_the_heading():
    body = Spacecraft()
    headings = np.linspace(-4.0, 4.0, 81)
    force = np.broadcast_to([0.7, -0.2], (81, 2))
    wrenches = np.column_stack([to_body(force, headings), np.zeros(81)])
    effort = np.sum(allocate(body, wrenches) ** 2, axis=1)
    assert effort == pytest.approx(np.full(81, 0.5 * (0.7**2 + 0.2**2)), rel=1e-12)
    turning = wrenches + np.array([0.0, 0.0, 0.3])
    assert np.all(least_effort(body, turning) > effort)


def six_state_optimum(start, goal, steps, period, seed):
    """Minimise the effort of eight held thrusters; heading and spin are free at the end."""
    body = Spacecraft()

    def fly(thrusts):
        states = [start]
        for thrust in thrusts.reshape(steps, 8):
            states.append(hold_step(body, states[-1], thrust, period))
        return np.array(states)

    def miss(thrusts):
        return fly(thrusts)[-1, [0, 1, 3, 4]] - goal

    def slopes(thrusts):
        moved = [miss(thrusts + 1e-6 * unit) - miss(thrusts - 1e-6 * unit) for unit in units]
        return np.array(moved).T / 2e-6

    units = np.eye(8 * steps)
    # The guess fires single thrusters at random: it turns the body.
    guess = 0.3 * np.random.default_rng(seed).random(8 * steps)
    answer = scipy.optimize.minimize(
        lambda u: period * u @ u,
        guess,
        jac=lambda u: 2.0 * period * u,
        bounds=[(0.0, None)] * guess.size,
        constraints={"type": "eq", "fun": miss, "jac": slopes},
        method="SLSQP",
        options={"maxiter": 300, "ftol": 1e-12},
    )
    assert answer.success, answer.message
    assert np.max(np.abs(miss(answer.x))) < 1e-6
    return answer.fun, fly(answer.x)


def held_double_integrator_effort(start, goal, steps, period):
    """Return the least 1/2 int ||F||^2 dt of held forces on a unit mass, by least norm."""
    left = period * np.arange(steps - 1, -1, -1)
    gain = np.array([0.5 * period**2 + period * left, np.full(steps, period)])
    duration = steps * period
    effort = 0.0
    for axis in range(2):
        drift = start[axis] + duration * start[3 + axis], start[3 + axis]
        force = np.linalg.pinv(gain) @ (goal[[axis, 2 + axis]] - drift)
        effort += 0.5 * period * force @ force
    return effort


@pytest.mark.parametrize("seed", [0, 1])
def test_least_effort_from_rest_to_rest_never_turns_the_body(seed):
    start = np.array([0.0, 0.0, 0.6, 0.0, 0.0, 0.0])
    goal = np.array([1.0, 0.5, 0.0, 0.0])
    effort, states = six_state_optimum(start, goal, 5, 0.8, seed)
    assert effort == pytest.approx(held_double_integrator_effort(start, goal, 5, 0.8), rel=1e-5)
    assert states[:, 2] == pytest.approx(0.6, abs=1e-3)
    assert states[:, 5] == pytest.approx(0.0, abs=1e-3)


def test_no_turning_beats_the_continuous_double_integrator():
    # While a wrench is held, a turning body turns its force, so that it may beat a held force; it
    # never beats a force that may vary.
    start = np.array([0.0, 0.0, -1.0, 0.3, -0.4, 0.0])
    goal = np.array([1.0, 1.0, 0.2, 0.1])
    steps, period = 5, 0.8
    duration = steps * period
    gramian = np.array([[duration**3 / 3, duration**2 / 2], [duration**2 / 2, duration]])
    least = 0.0
    for axis in range(2):
        speed = start[3 + axis]
        gap = goal[[axis, 2 + axis]] - [start[axis] + duration * speed, speed]
        least += 0.5 * gap @ np.linalg.solve(gramian, gap)
    effort, _ = six_state_optimum(start, goal, steps, period, seed=2)
    held = held_double_integrator_effort(start, goal, steps, period)
    assert least <= effort <= held * (1.0 + 1e-6)
