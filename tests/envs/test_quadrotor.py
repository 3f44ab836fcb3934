"""The quadrotor in space: its equation against rotations, published limits, presets, episodes."""

from __future__ import annotations

import json

import gymnasium as gym
import numpy as np
import pytest

from lagros_envs.dynamics import hold_step, vector_field
from lagros_envs.registry import find_task, in_preset, task_named
from lagros_envs.tasks.quadrotor.physics import HeadingQuadrotor, Quadrotor
from lagros_envs.tasks.quadrotor.task import HeadingQuadrotorSettings, QuadrotorSettings


def turn(axis: int, angle: float):
    """Return the rotation by an angle around a coordinate axis."""
    matrix = np.eye(3)
    first, second = [one for one in range(3) if one != axis]
    sign = -1.0 if axis == 1 else 1.0
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[first, second], matrix[second, first] = -sign * np.sin(angle), sign * np.sin(angle)
    return matrix


def test_the_thrust_is_along_the_axis_of_a_body_that_rolls_and_then_pitches():
    rng = np.random.default_rng(0)
    for heading in (False, True):
        body = HeadingQuadrotor(9.5) if heading else Quadrotor(9.5)
        for _ in range(20):
            state, control = rng.normal(size=body.state_dim), rng.normal(size=body.control_dim)
            rates = vector_field(body, state, control)
            # A turn around its own axis, at the end, leaves that axis where it is.
            posture = turn(0, state[7]) @ turn(1, state[8]) @ turn(2, rng.normal())
            force = 9.5 * (state[6] * posture[:, 2] - np.array([0.0, 0.0, 1.0]))
            np.testing.assert_allclose(rates[3:6], force, atol=1e-12)
            np.testing.assert_array_equal(rates[:3], state[3:6])
            np.testing.assert_array_equal(rates[6:], control)


def test_is_c3m_with_axes_reversed_and_the_thrust_over_the_weight():
    rng, body = np.random.default_rng(1), Quadrotor()
    for _ in range(20):
        state = rng.normal(size=9)
        thrust, roll, pitch = 9.81 * state[6], state[7], state[8]
        published = [
            -thrust * np.sin(pitch),
            thrust * np.cos(pitch) * np.sin(roll),
            9.81 - thrust * np.cos(pitch) * np.cos(roll),
        ]
        ours = vector_field(body, state, np.zeros(3))[3:6]
        np.testing.assert_allclose(-ours, published, atol=1e-12)


def test_hovers_at_rest_and_falls_freely_without_thrust():
    hover = np.array([1.0, 2.0, 3.0, 0, 0, 0, 1.0, 0, 0])
    assert not np.any(vector_field(Quadrotor(), hover, np.zeros(3)))
    falling = np.array([0.0, 0, 0, 1.0, 2.0, 3.0, 0.0, 0.4, -0.2])
    later = hold_step(Quadrotor(), falling, np.zeros(3), 0.5)
    np.testing.assert_allclose(later[:3], [0.5, 1.0, 1.5 - 0.125 * 9.81])


def test_starts_and_limits_are_those_of_c3m():
    task = QuadrotorSettings()
    assert task.time_limit == 6.0
    np.testing.assert_allclose(task.state_high[3:], [1.5, 1.5, 1.5, 2.0, np.pi / 3, np.pi / 3])
    np.testing.assert_allclose(task.state_low[3:], [-1.5] * 3 + [0.5, -np.pi / 3, -np.pi / 3])
    starts = np.stack([task.sample(np.random.default_rng(k)).initial_state for k in range(300)])
    assert 4.5 < np.abs(starts[:, :3]).max() <= 5.0
    assert 0.9 < np.abs(starts[:, 3:6]).max() <= 1.0
    np.testing.assert_array_equal(starts[:, 6:], np.tile([1.0, 0.0, 0.0], (300, 1)))


def test_the_preset_10_is_the_task_that_has_a_heading():
    task = in_preset(find_task("quadrotor"), "10")
    assert task is task_named("quadrotor-10")
    assert in_preset(find_task("quadrotor"), "9") is find_task("quadrotor")
    env = gym.make("lagros/Quadrotor-v0", settings={"preset": "10", "time_limit": 3.0})
    assert env.unwrapped.settings == HeadingQuadrotorSettings(time_limit=3.0)
    assert env.observation_space.shape == (31,)
    assert env.action_space.shape == (4,)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(env.reset(seed=1)[0], again.reset(seed=1)[0])
    worlds = gym.make_vec("lagros/Quadrotor-v0", 2, settings={"preset": "10"})
    assert worlds.single_action_space.shape == (4,)
    json.dumps(env.spec.kwargs)


@pytest.mark.parametrize(
    ("env_id", "preset", "message"),
    [
        ("lagros/Quadrotor-v0", "11", "unknown preset '11' of quadrotor.*Valid: 9, 10"),
        ("lagros/Quadrotor-v0", 10, "unknown preset 10"),
        ("lagros/Arm-v0", "9", "has no entry 'preset'"),
    ],
)
def test_other_presets_are_refused(env_id, preset, message):
    with pytest.raises(ValueError, match=message):
        gym.make(env_id, settings={"preset": preset})


def test_the_heading_moves_nothing_and_counts_at_the_goal():
    task = HeadingQuadrotorSettings()
    plain = QuadrotorSettings()
    drawn, without = task.sample(np.random.default_rng(3)), plain.sample(np.random.default_rng(3))
    np.testing.assert_array_equal(drawn.initial_state[:9], without.initial_state)
    state, goal = np.zeros((2, 10))
    state[[0, 9]] = 3.0, 4.0
    assert task.goal_distance(state.tolist(), goal.tolist(), np) == 5.0
    rng = np.random.default_rng(0)
    states, control = rng.normal(size=(2, 10)), rng.normal(size=4)
    states[1, :9] = states[0, :9]
    rates = vector_field(task.system, states, np.tile(control, (2, 1)))
    np.testing.assert_array_equal(rates[0], rates[1])


def test_ends_when_it_has_turned_over():
    env = gym.make("lagros/Quadrotor-v0")
    env.reset(seed=0)
    over = steps = 0
    while not over:
        _, _, over, truncated, info = env.step(np.array([0.0, 1.0, 0.0], np.float32))
        steps += 1
        assert not truncated
    assert info["fallen"]
    assert steps == 4  # 5 rad/s for 0.1 s each: beyond pi/2 at the fourth
