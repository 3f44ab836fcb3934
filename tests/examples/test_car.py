"""The example of a task of one's own: found by its path, checked, flown and planned for."""

from pathlib import Path

import gymnasium as gym
import numpy as np

from lagros_envs import find_task
from lagros_envs.dynamics import vector_field
from lagros_policies.planning.planner import planner_of

CAR = Path(__file__).parents[2] / "examples" / "car.py"


def test_the_file_is_short_and_is_a_task():
    assert len(CAR.read_text().splitlines()) <= 80
    task = find_task(str(CAR))
    assert task.env_id == "lagros/Car-v0"
    env = gym.make(task.env_id)
    observation, _ = env.reset(seed=1)
    assert observation.shape == (3 * 4 + 1 + 3 * 5,)
    # Straight on at the speed of the start.
    heading = observation[2]
    moved, *_ = env.step(np.zeros(2, np.float32))
    step = 0.15 * np.array([np.cos(heading), np.sin(heading)])
    np.testing.assert_allclose(moved[:2] - observation[:2], step, atol=1e-6)


def test_plans_reach_the_goal_within_the_limits_and_clear_of_the_discs():
    task = find_task(str(CAR))
    drawn = task.sample(np.random.default_rng(5))
    plan = planner_of(task).plan(drawn.initial_state, drawn.goal, discs=drawn.discs)
    assert plan.solved
    np.testing.assert_allclose(plan.states[-1], drawn.goal, atol=1e-6)
    assert plan.states[:, 3].min() >= 1.0 - 1e-6
    assert plan.states[:, 3].max() <= 2.0 + 1e-6
    gaps = np.linalg.norm(plan.states[:, None, :2] - drawn.discs[:, :2], axis=-1)
    assert gaps.min() >= 0.5 + 0.2 + 0.25 - 1e-5
    speeds = vector_field(task.system, plan.states[:-1], plan.controls)
    np.testing.assert_allclose(np.hypot(speeds[:, 0], speeds[:, 1]), plan.states[:-1, 3])
