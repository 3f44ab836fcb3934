"""The metrics and networks that come with tasks of one body."""

import json

import numpy as np
import pytest

from lagros_envs import find_task
from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.numbers import functions
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_policies.contraction import load_metric, search_violation
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learned import LearnedPolicy
from lagros_policies.learning.rounds import flown, padded_discs
from lagros_policies.planning.planner import planner_of
from lagros_policies.room import shipped_file

TASKS = ["pvtol", "car", "quadrotor", "quadrotor-10", "arm"]
_TEST = 17  # namespace of episodes that were neither trained on nor published


@pytest.fixture(params=TASKS)
def task(request):
    return find_task(request.param)


def test_metric_is_what_the_task_describes_and_holds_where_it_says(task):
    metric = load_metric(shipped_file(task, "metric.json"), task.system.state_dim)
    assert metric.contraction_rate == task.metric.rate
    assert metric.phi.terms == task.metric.basis
    assert metric.point == task.metric.point
    assert (metric.region.low, metric.region.high) == (task.metric.low, task.metric.high)
    assert metric.verification.violations == 0
    assert search_violation(task.system, metric, seed=5)[1] < 0.0


def test_plans_reach_the_goal_within_the_limits_and_clear_of_the_discs(task):
    drawn = task.sample(np.random.default_rng(5))
    plan = planner_of(task).plan(drawn.initial_state, drawn.goal, discs=drawn.discs)
    assert plan.solved
    np.testing.assert_allclose(plan.states[-1], drawn.goal, atol=1e-6)
    assert np.all(plan.states >= np.array(task.state_low) - 1e-6)
    assert np.all(plan.states <= np.array(task.state_high) + 1e-6)
    gaps = np.linalg.norm(plan.states[:, None, :2] - drawn.discs[:, :2], axis=-1)
    assert np.all(gaps >= drawn.discs[:, 2] + task.body_radius + task.margin - 1e-5)


@pytest.mark.parametrize("policy", [LagrosPolicy, LearnedPolicy])
def test_networks_belong_to_the_task_and_to_their_policy(task, policy):
    built = policy(task)
    path = shipped_file(task, f"{policy.name}.safetensors")
    assert path.stat().st_size < 400_000
    assert built.network.metadata["inputs"] == ", ".join(built.see.names)
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["policy"] == policy.name
    assert record["learning_error"]["kind"] == "observed"
    with pytest.raises(ValueError, match="was made for"):
        policy(type(task)(time_limit=2.0 * task.time_limit))


@pytest.mark.parametrize("kind", ["uniform", "constant"])
def test_one_evaluation_flies_to_the_goal_clear_of_the_discs(task, kind):
    seeds = episode_seeds(0, 60, _TEST)
    episodes = [task.sample(episode_streams(seed).scenario) for seed in seeds]
    size = task.steps, task.system.state_dim, task.control_period
    pushes = np.stack(
        [OPEN_LOOP[kind].realise(episode_streams(one).disturbance, *size) for one in seeds]
    )
    states = flown(task, LagrosPolicy(task).network, episodes, task.defaults.bound * pushes)
    fine = np.linspace(states[:, :-1, :2], states[:, 1:, :2], 10, axis=2)
    discs = np.stack([padded_discs(task, episode) for episode in episodes])[:, None, None]
    gaps = np.linalg.norm(fine[..., None, :] - discs[..., :2], axis=-1) - discs[..., 2]
    hit = ((gaps < task.body_radius) & (discs[..., 2] > 0.0)).any(axis=(1, 2, 3))
    goals = np.stack([episode.goal for episode in episodes]).T[..., None]
    away = task.goal_distance([*np.moveaxis(states[:, 1:], -1, 0)], [*goals], functions)
    assert np.mean(~hit & (np.min(away, axis=1) <= task.goal_radius)) >= 0.9
