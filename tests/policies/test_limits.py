"""Limits of force and thrust bind the plans; where there is none for that, it is counted."""

from typing import Any

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies import make
from lagros_policies.planning.joint.planner import (
    JointPlanner,
    JointPlannerSettings,
)
from lagros_policies.planning.local.motion import Discs
from lagros_policies.planning.local.plan import LocalPlanner
from lagros_policies.planning.local.problem import LocalPlannerSettings
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy
from lagros_policies.tasks.spacecraft.distributed import DistributedTubeMpcPolicy
from lagros_policies.tasks.spacecraft.setup import plan_force_limit
from lagros_policies.tasks.spacecraft.thrusters import allocate, to_body

LEANING, GOAL = np.array([0.0, 0.6, 0.0, 0.0]), np.array([2.0, 0.0, 0.0, 0.0])


def planned(limit, lean=LEANING):
    return CartPolePlanner(CartPoleSettings(force_limit=limit)).plan(lean, GOAL)


def test_a_plan_of_the_cart_pole_keeps_the_force_limit(oracle):
    free, limited = planned(None), planned(12.0)
    assert np.max(np.abs(free.controls)) > 13.0
    assert limited.solved
    assert np.max(np.abs(limited.controls)) <= 12.0 + 1e-6
    assert limited.effort > free.effort
    state = LEANING
    for control, expected in zip(limited.controls, limited.states[1:], strict=True):
        state = oracle.step(state, control)
        assert np.allclose(state, expected, atol=1e-5)
        state = expected
    assert np.allclose(limited.states[-1], GOAL, atol=1e-6)


def test_a_limit_that_no_plan_reaches_changes_no_bit():
    free, limited = planned(None), planned(39.0)
    assert np.array_equal(free.controls, limited.controls)
    assert np.array_equal(free.states, limited.states)


def test_a_force_too_small_to_catch_the_pole_leaves_no_plan():
    plan = planned(5.0)
    assert not plan.solved
    assert "failed" in plan.status or "trust" in plan.status


def test_where_the_feedback_meets_the_limit_is_counted():
    env = CartPoleEnv(settings=CartPoleSettings(force_limit=8.0))
    policy: Any = make("tube-mpc", env, deadline=1e9)
    observation, _ = env.reset(options={"initial_state": [0, 0.3, 0, 0], "goal": 0.5})
    action, state = policy.predict(observation)
    assert policy.counters(state)["saturated_steps"] == 0
    observation, *_ = env.step(action)
    observation[1] += 0.5  # the angle, as after a push
    action, state = policy.predict(observation, state)
    assert policy.counters(state)["saturated_steps"] == 1
    assert abs(float(action[0])) * 40.0 == pytest.approx(8.0)
    plain: Any = make("tube-mpc", CartPoleEnv(), deadline=1e9)
    assert "saturated_steps" not in plain.counters(plain.predict(observation)[1])


@pytest.mark.parametrize("limit", [5.0, 20.0])
def test_who_falls_for_want_of_force_has_failed_plans(limit):
    env = CartPoleEnv(settings=CartPoleSettings(force_limit=limit))
    policy = make("tube-mpc", env, deadline=1e9, replan_every=10)
    for angle in (0.2, 0.9):
        observation, _ = env.reset(
            seed=0, options={"initial_state": [0.0, angle, 0.0, 0.0], "goal": 1.0}
        )
        state, over = None, False
        while not over:
            action, state = policy.predict(observation, state)
            assert abs(float(action[0])) * 40.0 <= limit * (1.0 + 1e-6)
            observation, _, fallen, late, info = env.step(action)
            over = fallen or late
        assert info["fallen"] == (policy.counters(state)["failed_plans"] > 0)
        assert info["fallen"] == (limit == 5.0 and angle == 0.9)


STARTS, GOALS = np.array([[0.0, 0.0], [4.0, 0.3]]), np.array([[4.0, 0.0], [0.0, 0.2]])
BLOCK = np.array([[2.0, 0.1]])


def joint(limit):
    settings = JointPlannerSettings(force_limit=limit, margins=(0.1,))
    return JointPlanner(settings).plan(STARTS, GOALS, BLOCK, 0.5, 0.25)


def test_a_joint_plan_keeps_the_force_limit():
    free, limited = joint(None), joint(0.022)
    assert free.solved
    assert limited.solved
    assert np.max(np.abs(free.forces)) > 0.025
    assert np.max(np.abs(limited.forces)) <= 0.022 + 1e-6
    assert not joint(0.01).solved


def test_a_local_plan_keeps_the_force_limit_and_takes_longer():
    discs = Discs(BLOCK, np.zeros((1, 2)), np.array([0.75]), np.array([0.1]), np.zeros(1, bool))
    start, goal = np.array([0.0, 0.0, 0.2, 0.1]), np.array([4.0, 0.0])

    def plan(limit, left):
        settings = LocalPlannerSettings(force_limit=limit)
        return LocalPlanner(settings).plan(start, goal, discs, left)

    free = plan(None, 10.0)
    assert np.max(np.abs(free.forces)) > 0.2
    for limit in (0.15, 0.04, 0.005):
        limited = plan(limit, 10.0)
        assert limited.solved
        assert np.max(np.abs(limited.forces)) <= limit + 1e-6
        assert limited.duration > free.duration
        places, speeds = limited.at(np.array([limited.duration]))
        assert np.allclose(places[0], goal, atol=1e-4)
        assert np.allclose(speeds[0], 0.0, atol=1e-4)
    generous = plan(10.0, 10.0)
    assert generous.duration == free.duration
    assert np.allclose(generous.forces, free.forces, atol=1e-4)


@pytest.mark.parametrize("heading", [0.0, 0.3, np.pi / 4, 2.0])
def test_what_plans_may_use_keeps_every_thruster_within_its_limit(heading):
    settings = SpacecraftSettings(thrust_limit=0.3)
    force = plan_force_limit(settings, 0.4)
    assert force is not None
    corners = force * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 0.0]])
    # With a push of the disturbance, in the worst direction, on top.
    pushed = corners * (1.0 + 0.4 / np.linalg.norm(corners, axis=1, keepdims=True))
    wrench = np.hstack([to_body(pushed, np.full(4, heading)), np.zeros((4, 1))])
    assert np.max(allocate(settings.system, wrench)) <= 0.3 + 1e-12


@pytest.mark.parametrize("name", ["centralized", "tube-mpc"])
def test_a_thrust_limit_below_the_disturbance_is_refused(name):
    env = spacecraft_v0.parallel_env(2, settings=SpacecraftSettings(thrust_limit=0.03))
    with pytest.raises(ValueError, match=r"thrust_limit=0\.03 N leaves plans no force"):
        make(name, env, disturbance_bound=0.4)
    assert make(name, env, disturbance_bound=0.0).name == name


@pytest.mark.parametrize("name", ["centralized", "tube-mpc"])
def test_weak_thrusters_are_not_asked_for_more_in_a_calm_world(name):
    settings = SpacecraftSettings(thrust_limit=0.03)
    env = spacecraft_v0.parallel_env(2, disturbance_bound=0.0, settings=settings)
    policy = make(name, env)
    observations, info = env.reset(seed=1)
    state, most = None, 0.0
    for _ in range(settings.steps):
        rows = env.state() if policy.observes == "global" else np.stack([*observations.values()])
        action, state = policy.predict(rows, state)
        most = max(most, float(np.max(action)))
        actions = dict(zip(env.possible_agents, action.reshape(2, 8), strict=True))
        observations, _, _, _, info = env.step(actions)
    assert most <= 0.03 + 2e-3
    assert all(one["strict_success"] for one in info.values())
    assert policy.counters(state)["failed_plans"] == 0


def test_a_planner_of_the_users_must_keep_the_limit():
    settings = SpacecraftSettings(thrust_limit=0.3)
    for limit in (None, 0.5):
        planner = JointPlannerSettings(force_limit=limit)
        with pytest.raises(ValueError, match=r"force_limit=.*thrust_limit leaves plans"):
            CentralizedPolicy(settings, planner=planner)
        local = LocalPlannerSettings(force_limit=limit)
        with pytest.raises(ValueError, match=r"force_limit=.*thrust_limit leaves plans"):
            DistributedTubeMpcPolicy(settings, planner=local)
    assert CentralizedPolicy(settings, planner=JointPlannerSettings(force_limit=0.1))


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf])
def test_a_limit_must_be_a_positive_number(limit):
    for kind in (JointPlannerSettings, LocalPlannerSettings):
        with pytest.raises(ValueError, match="force_limit="):
            kind(force_limit=limit)
