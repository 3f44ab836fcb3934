"""The adapter for PettingZoo's parallel environments, against the batched route and SB3's rules."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from lagros_benchmarks.training.sb3_parallel import ParallelVecEnv
from lagros_benchmarks.training.sb3_vector import SB3VectorEnv
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

AGENTS, WORLDS = 3, 4
SHORT = SpacecraftSettings(time_limit=1.5)


def parallel(worlds=WORLDS, agents=AGENTS, **options):
    options = {"preset": "paper", "settings": SHORT, "disturbance": "uniform", **options}
    return ParallelVecEnv([spacecraft_v0.parallel_env(agents, **options) for _ in range(worlds)])


def batched(worlds=WORLDS, agents=AGENTS, **options):
    options = {"preset": "paper", "settings": SHORT, "disturbance": "uniform", **options}
    return SB3VectorEnv(
        SpacecraftVectorEnv(worlds * agents, agents, autoreset_mode="same_step", **options)
    )


@pytest.mark.parametrize("build", [parallel, batched])
def test_options_that_no_world_would_get_are_refused(build):
    env = build()
    for options in ({"goal": 1.0}, [{}, {"goal": 1.0}]):
        with pytest.raises(ValueError, match="starts its worlds without options"):
            env.set_options(options)
    env.set_options()
    env.set_options([{}] * env.num_envs)
    env.reset()


@pytest.mark.parametrize("seed", [-1, 1.5, "3", True, 1 << 200])
@pytest.mark.parametrize("build", [parallel, batched])
def test_seeds_that_are_none_are_refused(build, seed):
    with pytest.raises(ValueError, match=r"seed=.* must be a non-negative integer"):
        build().seed(seed)


@pytest.mark.parametrize("thing", [None, 3, "lagros/CartPole-v0", [object()], CartPoleEnv()])
def test_what_is_no_environment_of_many_is_refused(thing):
    with pytest.raises(ValueError, match="must be a vector environment"):
        SB3VectorEnv(thing)
    with pytest.raises(ValueError, match="must be a parallel environment"):
        ParallelVecEnv(thing)


def test_rows_are_those_of_the_batched_world():
    """Over several episodes, some of which end because every agent has collided."""
    ours, theirs = parallel(preset="released"), batched(preset="released")
    for env in (ours, theirs):
        assert env.seed(7) == [7 + world for world in range(WORLDS) for _ in range(AGENTS)]
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    early = late = 0
    for step in range(50):
        actions = rng.uniform(0.0, 1.0, (WORLDS * AGENTS, 8)).astype(np.float32)
        if step > 20:
            # A thrust too large to integrate counts as a collision.
            actions[AGENTS : 2 * AGENTS, 4:6] = 1e16 if step % 7 == 0 else 0.0
        (observation, reward, done, infos), expected = ours.step(actions), theirs.step(actions)
        np.testing.assert_allclose(observation, expected[0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(reward, expected[1], rtol=1e-5, atol=1e-6)
        assert reward.dtype == np.float32
        np.testing.assert_array_equal(done, expected[2])
        for info, other, over in zip(infos, expected[3], done, strict=True):
            assert info.keys() == other.keys()
            assert bool(info) == over
            if not over:
                continue
            early += not info["TimeLimit.truncated"]
            late += info["TimeLimit.truncated"]
            assert info["TimeLimit.truncated"] == other["TimeLimit.truncated"]
            assert info["episode"]["l"] == other["episode"]["l"]
            assert info["episode"]["r"] == pytest.approx(other["episode"]["r"], abs=1e-6)
            for name in ("terminal_observation", "disturbance", "effort", "goal_distance"):
                np.testing.assert_allclose(info[name], other[name], rtol=1e-6, atol=1e-6)
            assert info["collided"] == other["collided"]
    assert early > 0
    assert late > 0


def test_the_observation_after_the_end_belongs_to_the_next_episode():
    env = parallel(worlds=1)
    env.seed(3)
    first = env.reset()
    time = env.worlds[0].episode.layout.slices["time"].start
    returns = np.zeros(AGENTS)
    for step in range(1, 16):
        observation, reward, done, infos = env.step(np.full((AGENTS, 8), 0.1, np.float32))
        returns += reward
        assert done.all() == done.any() == (step == 15)
    assert np.all(observation[:, time] == 0.0)
    assert np.all(np.any(observation != first, axis=1))
    for agent, info in enumerate(infos):
        assert info["terminal_observation"][time] == pytest.approx(1.5)
        assert info["episode"] == {"r": pytest.approx(returns[agent], abs=1e-5), "l": 15}
    assert [set(info) >= {"success", "collided"} for info in env.reset_infos] == [True] * AGENTS
    # The next one counts from zero.
    for _ in range(15):
        _, _, _, infos = env.step(np.zeros((AGENTS, 8), np.float32))
    assert infos[0]["episode"]["l"] == 15


def test_seeds_repeat_and_worlds_and_episodes_differ():
    env = parallel(worlds=5)

    def episodes(seed):
        env.seed(seed)
        return np.stack([env.reset(), env.reset()])

    first = episodes(1)
    np.testing.assert_array_equal(episodes(1), first)
    everything = np.concatenate([*first, *episodes(20)])
    assert len(np.unique(everything[:, 0])) == 4 * 5 * AGENTS


def test_what_stable_baselines3_asks_of_a_vectorised_environment():
    env = parallel()
    rows = WORLDS * AGENTS
    assert env.num_envs == rows
    observation = env.reset()
    assert observation.shape == (rows, *env.observation_space.shape)
    assert observation.dtype == env.observation_space.dtype
    for _ in range(16):
        actions = np.stack([env.action_space.sample() for _ in range(rows)])
        observation, reward, done, infos = env.step(actions)
        assert all(env.observation_space.contains(row) for row in observation)
        assert reward.shape == done.shape == (rows,)
        assert done.dtype == np.bool_
        assert isinstance(infos, list)
        assert all(isinstance(info, dict) for info in infos)
        for over, info in zip(done, infos, strict=True):
            assert over == ("terminal_observation" in info)
    wrapped = VecNormalize(parallel())
    wrapped.reset()
    for _ in range(15):
        _, _, done, infos = wrapped.step(np.zeros((rows, 8), np.float32))
    assert done.all()
    assert infos[0]["terminal_observation"].shape == env.observation_space.shape
    with pytest.raises(RuntimeError, match="step_async"):
        env.step_wait()


def test_a_model_learns_and_is_evaluated_through_the_adapter():
    env = parallel(preset="open")
    model = PPO("MlpPolicy", env, n_steps=30, batch_size=60, n_epochs=1, device="cpu", seed=0)
    assert model.get_env() is env
    before = model.policy.state_dict()["action_net.weight"].clone()
    model.learn(720)
    assert not np.allclose(before, model.policy.state_dict()["action_net.weight"])
    # 2 episodes of 12 rows in each rollout of 30 steps.
    assert len(model.ep_info_buffer) == 48
    returns, lengths = evaluate_policy(
        model, parallel(worlds=2, preset="open"), n_eval_episodes=6, return_episode_rewards=True
    )
    assert lengths == [15] * 6
    assert len(set(returns)) == 6


def test_attributes_and_methods_reach_the_worlds():
    env = parallel(worlds=2)
    env.reset()
    assert env.get_attr("time", [0, AGENTS]) == [0.0, 0.0]
    worlds = env.get_attr("unwrapped", [AGENTS - 1, AGENTS])
    assert worlds == env.worlds
    states = env.env_method("state", indices=[1, 2, 5])
    assert states[0] is states[1]
    np.testing.assert_array_equal(states[2], env.worlds[1].state())
    env.set_attr("label", "x")
    assert env.get_attr("label") == ["x"] * 6
    with pytest.raises(ValueError, match="all of them"):
        env.set_attr("label", "y", [0])
    assert env.env_is_wrapped(Monitor) == [True] * 6
    assert env.env_is_wrapped(VecMonitor, 0) == [False]


def test_it_draws_all_its_worlds():
    pytest.importorskip("pygame")
    env = parallel(worlds=2, render_mode="rgb_array")
    env.reset()
    assert env.render().shape == (2 * 640, 840, 3)
    env.close()


class Uneven(ParallelEnv):
    """Agent b leaves at once; its observation has another size if asked for."""

    metadata = {"name": "uneven"}
    render_mode = None

    def __init__(self, size=2):
        self.possible_agents, self.agents, self.size = ["a", "b"], [], size

    def observation_space(self, agent):
        return spaces.Box(-1, 1, (2 if agent == "a" else self.size,))

    def action_space(self, agent):
        return spaces.Box(-1, 1, (1,))

    def reset(self, seed=None, options=None):
        self.agents = ["a", "b"]
        return dict.fromkeys(self.agents, np.zeros(2, np.float32)), {"a": {}, "b": {}}

    def step(self, actions):
        self.agents = ["a"]
        both = dict.fromkeys("ab", np.zeros(2, np.float32))
        flags = {"a": False, "b": True}
        return both, dict.fromkeys("ab", 0.0), flags, dict.fromkeys("ab", False), {"a": {}, "b": {}}


def test_environments_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="worlds is empty"):
        ParallelVecEnv([])
    with pytest.raises(ValueError, match="b of world 0 has other spaces"):
        ParallelVecEnv(Uneven(3))
    with pytest.raises(ValueError, match="all worlds must have the same"):
        ParallelVecEnv([spacecraft_v0.parallel_env(2), spacecraft_v0.parallel_env(3)])
    with pytest.raises(ValueError, match="agent_0 of world 1 has other spaces"):
        ParallelVecEnv([spacecraft_v0.parallel_env(1, name) for name in ("open", "paper")])
    env = ParallelVecEnv(Uneven())
    env.reset()
    with pytest.raises(RuntimeError, match="end together"):
        env.step(np.zeros((2, 1)))
