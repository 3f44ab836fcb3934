"""Energy and mirror images: of every task that is found, of files, and by integration."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lagros_envs.dynamics import hold_step
from lagros_envs.dynamics.invariants import ROUNDING, energy_balance, mirrored
from lagros_envs.numbers import functions
from tests.found import TASKS, named, task_of

# Why a system that is found has no energy.
WITHOUT = {"pendulum": "the example shows the least that a system needs"}


def drawn(system, count, seed):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, system.state_dim))


def gained_energy(system, states, controls):
    """Return what two seconds under a control add to the energy, as a share of it."""
    begun = np.array([system.energy(list(state), functions) for state in states])
    for _ in range(40):
        states = hold_step(system, states, controls, 0.05, substeps=50)
    ended = np.array([system.energy(list(state), functions) for state in states])
    return (ended - begun) / (1.0 + np.abs(begun))


@pytest.mark.parametrize("text", named(TASKS))
def test_the_energy_of_every_system_is_kept_or_falls_without_control(text):
    """At every state, by exact slopes; and along flights, by integration in small steps."""
    task = task_of(text)
    system, name = task.system, task.name
    assert (name in WITHOUT) == (not hasattr(system, "energy")), "state an energy, or why not"
    if name in WITHOUT:
        pytest.skip(WITHOUT[name])
    falls = getattr(system, "dissipates", False)
    states = drawn(system, 300, 0)
    balance = energy_balance(system, states)
    room = ROUNDING * (balance.size + 1.0)
    assert np.all(balance.rate <= room)
    assert falls or np.all(balance.rate >= -room)
    flown = 0.3 * drawn(system, 20, 1)
    gained = gained_energy(system, flown, np.zeros((20, system.control_dim)))
    assert np.all(gained <= 1e-6)
    assert falls or np.all(gained >= -1e-6)
    assert not falls or np.any(gained < -1e-3)
    # An energy that nothing changes would pass whatever the equation says.
    controls = np.random.default_rng(2).uniform(0.0, 1.0, (20, system.control_dim))
    assert np.any(np.abs(gained_energy(system, flown, controls)) > 1e-3)


@pytest.mark.parametrize("text", named(TASKS))
def test_mirror_images_that_are_stated_hold(text):
    system = task_of(text).system
    if not hasattr(system, "mirror"):
        pytest.skip("none is stated")
    states = drawn(system, 100, 2)
    controls = np.random.default_rng(3).uniform(-1.0, 1.0, (100, system.control_dim))
    np.testing.assert_allclose(mirrored(system, states, controls), 0.0, atol=1e-9)


class Pendulum:
    """A pendulum with a sign that can be wrong."""

    state_dim, control_dim = 2, 1
    mirror = ((-1, -1), (-1,))

    def __init__(self, sign=1.0, drag=0.0, push=0.0):
        """Remember the sign of gravity, drag and a push to one side."""
        self.sign, self.drag, self.push = sign, drag, push

    def derivative(self, state, control, functions):
        """Return dx/dt."""
        angle, rate = state
        pull = self.sign * 9.8 * functions.sin(angle) - self.drag * rate
        return rate, pull + self.push + control[0]

    def energy(self, state, functions):
        """Return the energy."""
        return 0.5 * state[1] ** 2 + 9.8 * functions.cos(state[0])


def test_the_rate_of_an_energy_is_its_difference_along_the_motion():
    system = Pendulum(drag=0.3, push=0.7)
    states = drawn(system, 50, 4)
    step = 1e-4
    ends = [hold_step(system, states, np.zeros((50, 1)), side * step) for side in (1.0, -1.0)]
    energies = [0.5 * end[:, 1] ** 2 + 9.8 * np.cos(end[:, 0]) for end in ends]
    expected = (energies[0] - energies[1]) / (2.0 * step)
    np.testing.assert_allclose(energy_balance(system, states).rate, expected, atol=1e-6)


def test_a_wrong_sign_shows_in_the_energy_and_not_in_the_mirror():
    states = drawn(Pendulum(), 50, 5)
    assert np.abs(energy_balance(Pendulum(), states).rate).max() < 1e-12
    wrong = energy_balance(Pendulum(sign=-1.0), states).rate
    expected = -2.0 * 9.8 * np.sin(states[:, 0]) * states[:, 1]
    np.testing.assert_allclose(wrong, expected, atol=1e-12)
    controls = np.ones((50, 1))
    np.testing.assert_allclose(mirrored(Pendulum(sign=-1.0), states, controls), 0.0, atol=1e-12)
    pushed = mirrored(Pendulum(push=0.5), states, controls)
    np.testing.assert_allclose(pushed, np.tile([0.0, 1.0], (50, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("energy", "message"),
    [
        (lambda state, functions: math.sin(state[0]), "energy fails: TypeError"),
        (lambda state, functions: 3.0, "gives 3.0, which does not depend on the state"),
        (lambda state: state[0], "It is called as energy.state, functions."),
    ],
)
def test_an_energy_that_is_none_is_refused(energy, message):
    system = Pendulum()
    system.energy = energy
    with pytest.raises(ValueError, match=message):
        energy_balance(system, drawn(system, 3, 0))


@pytest.mark.parametrize("mirror", [None, 3, ((-1, -1),), ((-1, 1), (1, 1)), ((-1, 2), (1,)), "ab"])
def test_a_mirror_that_is_no_signs_is_refused(mirror):
    system = Pendulum()
    system.mirror = mirror
    with pytest.raises(ValueError, match="must be two tuples of 1 and -1: 2 signs of the states"):
        mirrored(system, drawn(system, 3, 0), np.ones((3, 1)))
