"""The arm of two links: its equation against Lagrange's, published limits, and its episodes."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from lagros_envs.dynamics import hold_step, vector_field
from lagros_envs.numbers import functions
from lagros_envs.tasks.arm.physics import Arm
from lagros_envs.tasks.arm.task import ArmSettings

BODIES = (Arm(), Arm(1.5, 0.4, 0.6, 1.3, 9.81))


def textbook(body: Arm, state, torque):
    """Return the joint accelerations of M(q) d2q + C(q, dq) + G(q) = u, C3M's form of it."""
    alpha = (body.first_mass + body.second_mass) * body.first_length**2
    beta = body.second_mass * body.second_length**2
    eta = body.second_mass * body.first_length * body.second_length
    pull = body.gravity / body.first_length
    q1, q2, v1, v2 = state
    outer = beta + eta * np.cos(q2)
    mass = np.array([[alpha + beta + 2.0 * eta * np.cos(q2), outer], [outer, beta]])
    assert np.linalg.eigvalsh(mass).min() > 0.0
    swing = eta * np.sin(q2) * np.array([-(2.0 * v1 * v2 + v2 * v2), v1 * v1])
    weight = eta * pull * np.cos(q1 + q2) + np.array([alpha * pull * np.cos(q1), 0.0])
    return np.linalg.solve(mass, torque - swing - weight)


@pytest.mark.parametrize("body", BODIES)
def test_accelerations_solve_the_published_equation_with_a_positive_mass_matrix(body):
    rng = np.random.default_rng(0)
    for _ in range(50):
        state, torque = rng.uniform(-3.0, 3.0, 4), rng.uniform(-50.0, 50.0, 2)
        rates = vector_field(body, state, torque)
        np.testing.assert_array_equal(rates[:2], state[2:])
        np.testing.assert_allclose(rates[2:], textbook(body, state, torque), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("body", BODIES)
def test_torques_bring_as_much_power_as_the_energy_gains(body):
    rng = np.random.default_rng(1)
    state, torque = rng.uniform(-1.0, 1.0, 4), rng.uniform(-5.0, 5.0, 2)
    later = hold_step(body, state, torque, 0.2, substeps=200)
    gained = body.energy(later, functions) - body.energy(state, functions)
    assert gained == pytest.approx(float(torque @ (later[:2] - state[:2])), rel=1e-6)


def test_rests_upright_and_hanging_and_falls_from_beside():
    for first in (np.pi / 2.0, -np.pi / 2.0):
        rest = vector_field(Arm(), np.array([first, 0.0, 0.0, 0.0]), np.zeros(2))
        np.testing.assert_allclose(rest, 0.0, atol=1e-12)
    # Both links lean to the right of upright, and gravity turns them further.
    assert vector_field(Arm(), np.array([1.4, 0.0, 0.0, 0.0]), np.zeros(2))[2] < 0.0


def test_starts_and_limits_are_the_published_ones_and_every_goal_is_a_way_off():
    task = ArmSettings()
    assert (task.system, task.time_limit) == (Arm(0.8, 2.3, 1.0, 1.0, 9.8), 2.0)
    np.testing.assert_allclose(task.state_high[2:], np.pi / 3.0)
    for seed in range(100):
        drawn = task.sample(np.random.default_rng(seed))
        upright = np.array([np.pi / 2.0, 0.0])
        assert np.abs(drawn.initial_state[:2] - upright).max() <= 0.3
        assert not np.any(drawn.initial_state[2:])
        assert not np.any(drawn.goal[2:])
        assert np.linalg.norm(task.place(drawn.initial_state) - task.place(drawn.goal)) >= 0.6


def test_success_is_the_tip_at_the_goal_whatever_the_joints_are():
    task = ArmSettings()
    # Mirrored at the line from shoulder to tip, the elbow has the tip where it was.
    pose = np.array([1.2, 0.6, 0.0, 0.0])
    other = np.array([1.8, -0.6, 0.0, 0.0])
    assert task.goal_distance(pose.tolist(), other.tolist(), functions) == pytest.approx(0.0)
    np.testing.assert_allclose(
        task.place(pose), [np.cos(1.2) + np.cos(1.8), np.sin(1.2) + np.sin(1.8)]
    )
    upper, lower = task.outline(pose)
    np.testing.assert_allclose(upper.mean(axis=0), 0.5 * np.array([np.cos(1.2), np.sin(1.2)]))
    np.testing.assert_allclose(0.5 * (lower[1] + lower[2]), task.place(pose))


def test_an_arm_without_torque_falls_below_the_horizontal():
    env = gym.make("lagros/Arm-v0", settings={"time_limit": 5.0}, max_episode_steps=100)
    env.reset(seed=0, options={"initial_state": [1.3, 0.0, 0.0, 0.0], "goal": [1.6, 0.5, 0.0, 0.0]})
    over = False
    while not over:
        _, _, over, truncated, info = env.step(np.zeros(2, np.float32))
        assert not truncated
    assert info["fallen"]
