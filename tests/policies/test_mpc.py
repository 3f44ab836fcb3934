"""MPC without a metric: what it applies, and what it does where a plan fails."""

from dataclasses import replace

import numpy as np
import pytest

from lagros_envs.env import TaskEnv
from lagros_envs.registry import task_named
from lagros_policies import make
from lagros_policies.expert import Expert
from lagros_policies.mpc import MpcPolicy
from lagros_policies.planning.planner import planner_of


@pytest.fixture(params=["cartpole", "pvtol"])
def task(request):
    return task_named(request.param)


def begun(task, steps, policy):
    """Fly the first steps of an episode; return the next observation and the memory."""
    env = TaskEnv("uniform", task.defaults.bound, task=task)
    row, _ = env.reset(seed=5)
    memory = None
    for _ in range(steps):
        action, memory = policy.predict(row, memory)
        row, *_ = env.step(action)
    return row, memory


def test_it_applies_the_first_control_of_a_plan_from_where_it_is(task):
    policy = MpcPolicy(task, deadline=1e9)
    row, memory = begun(task, 3, policy)
    action, memory = policy.predict(row, memory)
    state = np.asarray(row[task.layout.state], np.float64)
    plan = memory[0].plan
    np.testing.assert_array_equal(plan.states[0], state)
    np.testing.assert_allclose(task.control(action), plan.controls[0], rtol=1e-5)
    # Roughly iterated, and yet nearly what a plan from nothing begins with.
    discs = task.layout.discs_of(row) if task.most_discs else None
    exact = planner_of(task).plan(state, row[task.layout.goal], 3, discs=discs)
    spread = np.array(task.control_spread or (1.0,) * task.system.control_dim)
    far = np.abs(plan.controls[0] - exact.controls[0]) / spread
    assert exact.solved
    assert far.max() < 0.1 * max(1.0, np.abs(exact.controls / spread).max())
    assert policy.counters(memory)["plans"] == 4


def test_where_plans_fail_a_regulator_follows_the_last_one_and_it_is_counted(task, monkeypatch):
    policy = MpcPolicy(task, deadline=1e9)
    row, memory = begun(task, 3, policy)
    solved = policy._rough.plan
    monkeypatch.setattr(policy._rough, "plan", lambda *asked: replace(solved(*asked), solved=False))
    action, after = policy.predict(row, memory)
    counted = policy.counters(after)
    assert counted["failed_plans"] == 1
    assert counted["plans"] == 4
    assert after[0].plan is memory[0].plan
    expert, state = Expert(task, law="lqr"), np.asarray(row[None, task.layout.state], np.float64)
    tracked = expert.track(memory[0].plan.states[None], memory[0].plan.controls[None], 2)
    wanted = expert.control(tracked, np.zeros(1, int), np.full(1, 3), state)
    np.testing.assert_allclose(task.control(action), wanted[0], rtol=1e-4, atol=1e-4)


def test_near_the_end_the_last_plan_is_followed(task):
    policy = make("mpc", TaskEnv(task=task), deadline=1e9, last_plan=task.time_limit - 0.2)
    assert policy.name == "mpc"
    _, memory = begun(task, 6, policy)
    assert policy.counters(memory)["plans"] == 3
