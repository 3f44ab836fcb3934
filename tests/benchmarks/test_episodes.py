"""One episode: what is written down, above all when something goes wrong."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs  # noqa: F401
from lagros_benchmarks.run.episodes import run_episode
from tests.benchmarks.fakes import (
    DrawingPolicy,
    IdlePolicy,
    LinearPolicy,
    RaisingPolicy,
    StraightPlanner,
)


@pytest.fixture
def env():
    return gym.make("lagros/CartPole-v0", disturbance="uniform", disturbance_bound=0.3)


def nominal_of(env, seed):
    env.reset(seed=seed)
    scenario = env.unwrapped.scenario
    return StraightPlanner(refuses=False).plan(scenario.initial_state, scenario.goal).states


def seed_with_goal(env, right, start=0):
    seed = start
    while True:
        env.reset(seed=seed)
        if (env.unwrapped.scenario.goal[0] > 0.0) == right:
            return seed
        seed += 1


def by_hand(env, policy, seed, nominal):
    """The episode again, with everything computed here from the states."""
    observation, _ = env.reset(seed=seed)
    world = env.unwrapped
    goal = world.scenario.goal
    efforts, distances, errors = [], [], []
    state, done, first = None, False, True
    while True:
        distances.append(np.linalg.norm(world.state - goal))
        errors.append(np.linalg.norm(world.state - nominal[len(errors)]))
        if done:
            return np.array(efforts), np.array(distances), np.array(errors)
        action, state = policy.predict(observation, state, np.array([first]))
        observation, _, terminated, truncated, _ = env.step(action)
        efforts.append((40.0 * float(action[0])) ** 2 * 0.1)
        done, first = terminated or truncated, False


def test_the_figures_of_a_success_are_those_computed_by_hand(env):
    nominal = nominal_of(env, 3)
    record = run_episode(env, LinearPolicy(), 3, nominal, label="mine")
    efforts, distances, errors = by_hand(env, LinearPolicy(), 3, nominal)
    radius = 3.15 * (1.0 - np.exp(-0.6 * 0.1 * np.arange(91)))
    entry = int(np.argmax(distances <= radius))
    assert record.policy == "mine"
    assert (record.disturbance, record.bound, record.seed) == ("uniform", 0.3, 3)
    assert record.success
    assert record.success_time == pytest.approx(0.1 * entry)
    assert record.strict_success == bool(distances[-1] <= radius[-1])
    assert record.effort == pytest.approx(efforts[:entry].sum())
    assert record.effort_total == pytest.approx(efforts.sum())
    assert record.tracking_error == pytest.approx(errors)
    assert record.max_tracking_error == pytest.approx(errors.max())
    assert record.left_paper_tube == bool(np.any(errors > radius + 1e-6))
    assert record.step_times.shape == (90,)
    assert np.all(record.step_times > 0.0)
    assert record.counters == {"calls": 90, "episodes": 1, "failures": 0}
    assert record.error is None


def test_a_fall_ends_the_episode_as_a_failure(env):
    record = run_episode(env, IdlePolicy(), 3, nominal_of(env, 3))
    assert record.policy == "idle"
    assert record.fallen
    assert not record.success
    assert not record.strict_success
    assert record.success_time is None
    assert record.left_paper_tube
    assert record.error is None
    assert 0 < record.step_times.size < 90
    ended = np.isnan(record.tracking_error)
    assert not ended[: record.step_times.size + 1].any()
    assert ended[record.step_times.size + 1 :].all()


def test_an_exception_is_a_failure_with_its_text_on_one_line(env):
    seed = seed_with_goal(env, right=True)
    record = run_episode(env, RaisingPolicy(), seed, nominal_of(env, seed))
    assert record.error == "ArithmeticError: no solution at all [bold]here[/bold]"
    assert not record.success
    assert not record.strict_success
    assert record.left_paper_tube
    assert record.left_certified_tube is None
    assert record.step_times.size == 2
    assert record.counters == {"calls": 2, "episodes": 1, "failures": 0}


def test_an_action_that_the_environment_refuses_is_a_failure(env):
    class Broken(IdlePolicy):
        def predict(self, *args, **kwargs):
            return np.array([math.nan]), None

    record = run_episode(env, Broken(), 0, None)
    assert "not finite" in record.error
    assert not record.success


def test_an_environment_that_cannot_start_is_a_failure():
    env = gym.make("lagros/CartPole-v0", disturbance="worst", metric=np.eye(4))
    record = run_episode(env, LinearPolicy(), 0, None)
    assert "nominal" in record.error
    assert not record.success
    assert record.step_times.size == 0
    assert np.isnan(record.tracking_error).all()


def test_keyboard_interrupt_is_no_failure_of_the_policy(env):
    class Interrupted(IdlePolicy):
        def predict(self, *args, **kwargs):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_episode(env, Interrupted(), 0, None)


def test_an_episode_without_plan_counts_as_leaving_the_paper_tube(env):
    record = run_episode(env, LinearPolicy(), 3, None)
    assert record.success
    assert record.left_paper_tube
    assert record.left_certified_tube is None
    assert record.max_tracking_error is None


def test_a_policy_that_draws_does_so_from_the_stream_of_the_episode(env):
    first = run_episode(env, DrawingPolicy(), 5, None)
    again = run_episode(env, DrawingPolicy(), 5, None)
    other = run_episode(env, DrawingPolicy(), 6, None)
    assert first.error is None
    assert first == again
    assert first.effort_total != other.effort_total


def test_the_time_of_a_slow_step_is_measured_and_its_deadline_missed(env, monkeypatch):
    # A clock that stands still except inside the second call, which takes a second.
    ticks = iter([0.0, 0.01, 1.0, 2.0, *np.repeat(3.0, 400)])
    monkeypatch.setattr("lagros_benchmarks.run.flying.perf_counter", lambda: next(ticks))
    record = run_episode(env, LinearPolicy(), 3, None)
    assert record.step_times[:3].tolist() == [0.01, 1.0, 0.0]
    assert record.deadline_misses == 1


def test_an_exception_after_a_success_is_a_failure_all_the_same(env):
    nominal = nominal_of(env, 3)
    success_time = run_episode(env, LinearPolicy(), 3, nominal).success_time
    assert success_time is not None

    class RaisesAfterwards(LinearPolicy):
        calls = 0

        def predict(self, *arguments):
            self.calls += 1
            if self.calls > round(10 * success_time) + 2:
                raise RuntimeError("too late")
            return super().predict(*arguments)

    record = run_episode(env, RaisesAfterwards(), 3, nominal)
    assert record.error == "RuntimeError: too late"
    assert not record.success
    assert record.success_time is None
    assert not record.strict_success
    assert record.left_paper_tube


def test_what_is_counted_by_the_clock_makes_no_difference(env):
    class Late(LinearPolicy):
        def counters(self, state):
            return {"plans": 3, "late_plans": self.late}

    nominal = nominal_of(env, 3)
    records = []
    for late in (0, 2):
        policy = Late()
        policy.late = late
        records.append(run_episode(env, policy, 3, nominal))
    one, two = records
    assert one == two
    assert (one.counters, two.timed_counters) == ({"plans": 3}, {"late_plans": 2})
