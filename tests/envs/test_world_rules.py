"""Rules of the worlds one by one: who counts as touching, what a restart forgets, who stands."""

import pickle

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs  # noqa: F401  registers the environment
from lagros_envs.dynamics.held import HeldBatch
from lagros_envs.rules import StepRules
from lagros_envs.sweep import Path, swept_agents
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.scenarios import Scenario
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

FAR = Scenario([[0.0, 0.0], [0.0, 4.0]], [0.0, 0.0], [[4.0, 0.0], [4.0, 4.0]], [], [])


@pytest.mark.parametrize("curved", [0, 1])
def test_the_curve_of_either_agent_may_touch(curved):
    # Two that stand 0.52 m apart, one on a path that may leave its chord by 3 cm.
    points = np.zeros((2, 2, 1, 2))
    points[:, 0, 0, 1] = 0.52
    bulge = np.zeros((1, 2))
    assert not swept_agents(Path.through(points, bulge), np.array([0.5])).any()
    bulge[0, curved] = 0.03
    assert swept_agents(Path.through(points, bulge), np.array([0.5])).all()


def test_a_new_episode_forgets_every_success_of_the_last():
    # It starts at its goal, at rest.
    there = Scenario([[1.0, 1.0], [0.0, 4.0]], [0.0, 0.0], [[1.0, 1.0], [4.0, 4.0]], [], [])
    env = SpacecraftVectorEnv(2, 2, "open", compiled=False, autoreset_mode="disabled")
    env.reset(seed=0, options={"scenarios": [there]})
    *_, info = env.step(np.zeros((2, 8), np.float32))
    for name in ("success", "paper_success"):
        assert info[name].tolist() == [True, False]
    _, info = env.reset(seed=1, options={"scenarios": [FAR]})
    for name in ("success", "paper_success", "collided"):
        assert info[name].tolist() == [False, False]
    for name in ("success_time", "paper_success_time", "collision_time"):
        assert np.isinf(info[name]).all()


def test_a_world_whose_agents_have_all_collided_starts_anew_and_alone():
    # In the second world two fly at each other; the first one is calm.
    close = Scenario([[0.0, 0.0], [0.6, 0.0]], [0.0, 0.0], [[4.0, 0.0], [-4.0, 0.0]], [], [])
    env = SpacecraftVectorEnv(4, 2, "open", compiled=False, autoreset_mode="same_step")
    env.reset(seed=0, options={"scenarios": [FAR, close]})
    env.world.parts[3, 1] = 1.0, -1.0
    _, _, terminated, truncated, info = env.step(np.zeros((4, 8), np.float32))
    assert terminated.tolist() == [False, False, True, True]
    assert not truncated.any()
    assert info["_final_obs"].tolist() == info["_final_info"].tolist() == terminated.tolist()
    assert info["final_info"]["collided"].tolist() == terminated.tolist()
    # The next episode of the second world has begun, the first world's goes on.
    assert env.world.time.tolist() == [0.1, 0.0]
    assert not info["collided"].any()


def test_a_pickled_batch_measures_what_the_original_does():
    settings = CartPoleSettings()
    rules = StepRules(settings)
    batch = HeldBatch(settings.system, 0.1, (3,), False, measure=rules, given=rules.given)
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(4, 3)), rng.normal(size=(1, 3)), np.zeros((4, 3)), np.ones((9, 3))
    again = pickle.loads(pickle.dumps(batch))
    np.testing.assert_array_equal(batch(*inputs).copy(), again(*inputs))
    np.testing.assert_array_equal(batch.measured, again.measured)
    assert batch.measured.shape == (7, 3)


def test_a_single_agent_takes_its_plan_without_an_axis_of_agents():
    env = gym.make("lagros/Spacecraft-v0")
    plan = np.zeros((env.unwrapped.settings.steps + 1, 6))
    _, flat = env.reset(seed=0, options={"nominal": plan})
    _, nested = env.reset(seed=0, options={"nominal": plan[:, None]})
    assert flat["tracking_error"] == nested["tracking_error"]
    assert flat["tracking_error"] == pytest.approx(np.linalg.norm(env.unwrapped.state))
