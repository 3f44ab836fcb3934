"""Expert demonstrations: they are what the environment did, from seeds that no evaluation meets."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs
import lagros_policies
from lagros_benchmarks.run.demonstrations import (
    DemonstrationSettings,
    demonstrate,
    fly,
    make_expert,
)
from lagros_envs.dynamics import hold_step
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.cartpole import task
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from lagros_policies.tube_mpc import TubeMpcPolicy

SETTINGS = DemonstrationSettings("cartpole", episodes=2, seed=4, disturbance="gust", bound=0.5)
CARTPOLE = task.CartPoleSettings()


@pytest.fixture(scope="module")
def run():
    return demonstrate(SETTINGS)


@pytest.fixture(scope="module")
def flown(run):
    return run[0]


def resimulate(identifier, episode, **settings):
    """Check every number of an episode against a fresh environment fed the recorded actions."""
    assert lagros_envs.__version__  # its import registers the identifiers
    env = gym.make(identifier, **settings)
    observation, info = env.reset(seed=episode.seed)
    for step in range(len(episode.actions) + 1):
        np.testing.assert_array_equal(observation, episode.observations[step])
        for name, value in info.items():
            np.testing.assert_array_equal(value, episode.infos[name][step], err_msg=name)
        if step == len(episode.actions):
            break
        observation, reward, terminated, truncated, info = env.step(episode.actions[step])
        assert reward == episode.rewards[step]
        assert terminated == episode.terminations[step]
        assert truncated == episode.truncations[step]
    assert terminated or truncated
    assert not np.any(episode.terminations[:-1] | episode.truncations[:-1])


def test_a_fresh_environment_repeats_every_number_from_seed_and_actions(flown):
    assert len(flown) == 2
    for episode in flown:
        resimulate("lagros/CartPole-v0", episode, disturbance="gust", disturbance_bound=0.5)


def test_the_disturbance_is_the_one_that_was_asked_for(flown):
    sizes = np.linalg.norm(flown[0].infos["disturbance"], axis=1)
    assert 0.0 < sizes.max() <= 0.5
    undisturbed = replace(SETTINGS, disturbance="none")
    assert undisturbed.disturbance_bound == 0.0
    assert replace(SETTINGS, bound=None).disturbance_bound == 0.75
    assert replace(SETTINGS, bound=None, task="spacecraft").disturbance_bound == 0.4


def test_the_effort_is_that_of_the_actions(flown):
    for episode in flown:
        effort = 0.1 * np.sum((40.0 * episode.actions.astype(float)) ** 2)
        assert episode.infos["effort"][-1] == pytest.approx(effort, rel=1e-9)


def test_a_run_depends_on_its_seed_alone_and_begins_with_a_shorter_one(flown):
    (again,), _ = demonstrate(replace(SETTINGS, episodes=1))
    first, second = flown
    assert again.seed == first.seed
    for name in ("observations", "actions", "rewards"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for name, values in first.infos.items():
        np.testing.assert_array_equal(again.infos[name], values)
    assert not np.array_equal(first.observations, second.observations)


def test_seeds_are_those_of_training_and_never_of_an_evaluation():
    for seed in range(5):
        seeds = DemonstrationSettings("cartpole", episodes=500, seed=seed).seeds()
        assert seeds == episode_seeds(seed, 500)
        assert len(set(seeds)) == 500
        for other in range(20):
            assert not set(seeds) & set(episode_seeds(other, 500, EVALUATION))


def test_the_plan_leads_from_start_to_goal_by_the_dynamics(flown):
    for episode in flown:
        states, controls = episode.infos["nominal_state"], episode.infos["nominal_control"]
        np.testing.assert_allclose(states[0], episode.observations[0, task.STATE], atol=1e-6)
        np.testing.assert_allclose(states[-1], episode.observations[0, task.GOAL], atol=1e-5)
        following = hold_step(CARTPOLE.system, states[:-1], controls[:-1], 0.1)
        np.testing.assert_allclose(following, states[1:], atol=1e-6)
        assert np.isnan(controls[-1]).all()


def test_one_plan_does_what_policy_b_does_with_several(flown):
    env = SETTINGS.make_env()
    policy = TubeMpcPolicy(replan_every=30, deadline=math.inf)
    observation, _ = env.reset(seed=flown[0].seed)
    state = None
    for action in flown[0].actions:
        chosen, state = policy.predict(observation, state)
        np.testing.assert_array_equal(chosen, action)
        observation = env.step(chosen)[0]
    assert policy.counters(state)["plans"] == 3


def test_a_failed_plan_is_counted_and_shown_as_missing(monkeypatch):
    plan, calls = CartPolePlanner.plan, []

    def fails_once(self, *arguments):
        calls.append(arguments)
        made = plan(self, *arguments)
        return made if len(calls) > 1 else replace(made, solved=False)

    monkeypatch.setattr(CartPolePlanner, "plan", fails_once)
    env = SETTINGS.make_env()
    episode = fly(env, make_expert(SETTINGS, env), SETTINGS.seeds()[0])
    assert episode.counters == {"plans": 2, "failed_plans": 1}
    assert episode.actions[0] == 0.0
    states = episode.infos["nominal_state"]
    assert np.isnan(states[0]).all()
    assert np.isfinite(states[1:]).all()
    np.testing.assert_allclose(states[1], episode.observations[1, task.STATE], atol=1e-6)


def test_an_episode_that_ends_early_is_kept_as_it_was():
    rough = DemonstrationSettings(
        "cartpole", episodes=1, seed=1, disturbance="constant", bound=30.0
    )
    (episode,), _ = demonstrate(rough)
    steps = len(episode.rewards)
    assert steps < 90
    assert episode.terminations[-1]
    assert len(episode.observations) == steps + 1
    assert all(len(values) == steps + 1 for values in episode.infos.values())
    resimulate("lagros/CartPole-v0", episode, disturbance="constant", disturbance_bound=30.0)


def test_the_record_says_which_metric_and_planner(run):
    record = json.loads(json.dumps(run[1]))
    place = Path(lagros_policies.__file__).parent / "pretrained" / "cartpole_metric.json"
    shipped = json.loads(place.read_text())
    digest = hashlib.sha256(np.array(shipped["coefficients"], np.float64).tobytes()).hexdigest()
    assert record["metric"]["sha256"] == digest
    for name in ("alpha", "chi", "nu", "region", "verification"):
        assert record["metric"][name] == shipped[name]
    assert record["planner"]["angle_margin"] == CartPolePlanner().settings.angle_margin
    assert record["run"] == {
        "task": "cartpole",
        "episodes": 2,
        "seed": 4,
        "disturbance": "gust",
        "bound": 0.5,
    }
    assert record["task_settings"]["time_limit"] == 9.0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"task": "cartpol"}, "unknown task 'cartpol'. Did you mean 'cartpole'?"),
        ({"episodes": 0}, "episodes=0 must be a whole number"),
        ({"seed": -1}, "seed=-1 must be a non-negative integer"),
        ({"disturbance": "worst"}, "disturbance='worst' must be one of none, uniform"),
        ({"bound": -0.1}, "bound=-0.1 must be finite and >= 0"),
        ({"bound": math.nan}, "bound=nan must be a finite number"),
    ],
)
def test_a_wrong_setting_is_named_with_the_remedy(wrong, message):
    with pytest.raises(ValueError, match=message):
        DemonstrationSettings(**{"task": "cartpole", **wrong})


@pytest.mark.slow
def test_the_spacecraft_repeats_too_and_its_plan_ends_at_the_goal():
    (episode,), record = demonstrate(DemonstrationSettings("spacecraft", 1, seed=2))
    resimulate("lagros/Spacecraft-v0", episode, disturbance="uniform", disturbance_bound=0.4)
    assert episode.counters == {"plans": 1, "failed_plans": 0}
    env = gym.make("lagros/Spacecraft-v0")
    env.reset(seed=episode.seed)
    goal = env.unwrapped.episode.world.scenarios[0].goals[0]
    states = episode.infos["nominal_state"]
    np.testing.assert_allclose(states[-1, :2], goal[:2], atol=0.01)
    np.testing.assert_allclose(states[0], env.unwrapped.state, atol=1e-5)
    # Position by x_d(k+1) = x_d(k) + T v + T^2 a / 2: the acceleration is u_d.
    push = episode.infos["nominal_control"][:-1, :2]
    moved = states[:-1, :2] + 0.1 * states[:-1, 3:5] + 0.005 * push
    np.testing.assert_allclose(moved, states[1:, :2], atol=1e-5)
    assert json.loads(json.dumps(record))["metric"]["plane"]["alpha"] == pytest.approx(2.0)
