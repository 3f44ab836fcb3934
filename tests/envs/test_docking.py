"""Docking: the solution of Clohessy and Wiltshire in closed form, Kepler's motion, the limit."""

import gymnasium as gym
import numpy as np
import pytest

from lagros_envs.dynamics import check_system, hold_step, vector_field
from lagros_envs.numbers import functions
from lagros_envs.tasks.docking.physics import Chaser
from lagros_envs.tasks.docking.task import DockingSettings


def drifted(state, time, rate):
    """The motion without thrust in closed form (Clohessy & Wiltshire 1960)."""
    x, y, vx, vy = state
    sine, cosine = np.sin(rate * time), np.cos(rate * time)
    return np.array(
        [
            (4 - 3 * cosine) * x + sine / rate * vx + 2 / rate * (1 - cosine) * vy,
            6 * (sine - rate * time) * x
            + y
            - 2 / rate * (1 - cosine) * vx
            + (4 * sine - 3 * rate * time) / rate * vy,
            3 * rate * sine * x + cosine * vx + 2 * sine * vy,
            -6 * rate * (1 - cosine) * x - 2 * sine * vx + (4 * cosine - 3) * vy,
        ]
    )


def test_free_motion_is_the_one_in_closed_form():
    body, rng = Chaser(), np.random.default_rng(0)
    for state in rng.normal(size=(20, 4)) * [100.0, 100.0, 0.2, 0.2]:
        moved = state
        for _ in range(120):
            moved = hold_step(body, moved, np.zeros(2), 5.0)
        np.testing.assert_allclose(
            moved, drifted(state, 600.0, body.mean_motion), rtol=1e-9, atol=1e-9
        )


def test_a_neighbour_on_a_kepler_orbit_moves_so_to_first_order():
    """A circle 10 m farther out has the rate n (1 - 3 x / (2 r)) by Kepler's third law."""
    body, radius, away = Chaser(), 7.0e6, 10.0
    rate = body.mean_motion * (1.0 + away / radius) ** -1.5
    # Along its circle, seen from axes that turn by n, at first order in away / radius.
    speed = (rate - body.mean_motion) * (radius + away)
    rates = vector_field(body, np.array([away, 0.0, 0.0, speed]), np.zeros(2))
    assert abs(rates[2]) < 1e-5 * 3.0 * body.mean_motion**2 * away
    assert rates[3] == 0.0


def test_thrust_is_force_over_mass():
    pushed = vector_field(Chaser(), np.zeros(4), np.array([0.6, -1.2]))
    np.testing.assert_allclose(pushed, [0.0, 0.0, 0.05, -0.1])


def test_every_kind_of_number_takes_the_equation():
    check_system(Chaser())


@pytest.mark.parametrize("bad", [{"mass": 0.0}, {"mean_motion": -1.0}])
def test_unphysical_bodies_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Chaser(**bad)


def limit(task, states):
    return 0.2 + 2.0 * task.system.mean_motion * np.linalg.norm(states[..., :2], axis=-1)


def test_the_rule_is_the_published_limit_of_speed():
    task, rng = DockingSettings(), np.random.default_rng(0)
    states = rng.normal(size=(500, 4)) * [60.0, 60.0, 0.3, 0.3]
    true = np.linalg.norm(states[:, 2:], axis=-1) - limit(task, states)
    found = task.excess(list(states.T), functions)
    # What makes it smooth makes it stricter, and by no more than is said.
    assert np.all((found >= true) & (found <= true + 1e-3))
    assert task.excess([0.0, 0.0, 0.0, 0.0], functions) < -0.19
    kept = task.keep(list(states.T), functions)[0]
    np.testing.assert_allclose(kept, (found + task.spare_speed) / 0.2, atol=1e-12)


def test_episodes_begin_around_the_target_within_the_limit():
    task = DockingSettings()
    drawn = task.sample_many(np.random.default_rng(0), 500)
    distance = np.linalg.norm(drawn.initial_state[:, :2], axis=1)
    share = np.linalg.norm(drawn.initial_state[:, 2:], axis=1) / limit(task, drawn.initial_state)
    assert 100.0 <= distance.min() < 102.0
    assert 148.0 < distance.max() <= 150.0
    assert share.max() <= 0.8 < share.max() + 0.02
    bearings = np.arctan2(drawn.initial_state[:, 1], drawn.initial_state[:, 0])
    assert np.all(np.histogram(bearings, 8, (-np.pi, np.pi))[0] > 30)
    assert not np.any(drawn.goal)


def test_whoever_is_too_fast_has_failed():
    env = gym.make("lagros/Docking-v0")
    start = np.array([10.0, 0.0, -0.2, 0.0])
    env.reset(seed=0, options={"initial_state": start})
    *_, over, _, info = env.step(np.array([-0.1, 0.0], np.float32))
    # 0.2 + 0.1 / 12 * 5 = 0.24 m/s, 9 m from the target: allowed are 0.22.
    assert over
    assert info["fallen"]
    assert not info["success"]


def test_a_chaser_that_touches_slowly_has_docked():
    env = gym.make("lagros/Docking-v0")
    env.reset(seed=0, options={"initial_state": np.array([1.0, 0.0, -0.12, 0.0])})
    *_, over, _, info = env.step(np.zeros(2, np.float32))
    assert info["goal_distance"] == pytest.approx(0.4, abs=1e-3)
    assert info["success"]
    assert not over
