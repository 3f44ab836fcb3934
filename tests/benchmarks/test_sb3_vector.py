"""Our vector environments as stable-baselines3 takes them, against the environments themselves."""

import numpy as np
import pytest
from stable_baselines3 import A2C
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from lagros_benchmarks.training.sb3_vector import LinearFeatures, SB3VectorEnv
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_policies.actor import goal_frame
from lagros_policies.baselines import LqrPolicy


def test_the_adapter_ends_episodes_as_the_environment_does():
    worlds, steps = 40, 90
    options = {"disturbance": "uniform", "disturbance_bound": 0.75}
    adapter = SB3VectorEnv(CartPoleVectorEnv(worlds, autoreset_mode="same_step", **options))
    plain = CartPoleVectorEnv(worlds, autoreset_mode="disabled", **options)
    adapter.seed(5)
    ours = adapter.reset()
    theirs, _ = plain.reset(seed=5)
    np.testing.assert_array_equal(ours, theirs)
    policy = LqrPolicy()
    # Every other world is felled, at a time of its own.
    falls = np.where(np.arange(worlds) % 2 == 0, np.arange(worlds) * 3 % 60 + 10, steps)
    ended, returns = np.zeros(worlds, bool), np.zeros(worlds)
    outcomes = []
    for step in range(steps):
        action, _ = policy.predict(theirs)
        action[falls <= step] = 20.0
        theirs, reward, terminated, truncated, info = plain.step(action)
        ours, rewards, done, infos = adapter.step(action)
        assert rewards.dtype == np.float32
        returns += np.where(ended, 0.0, reward)
        for world in np.flatnonzero(~ended):
            assert done[world] == (terminated[world] or truncated[world])
            if not done[world]:
                np.testing.assert_array_equal(ours[world], theirs[world])
                assert infos[world] == {}
                continue
            np.testing.assert_array_equal(infos[world]["terminal_observation"], theirs[world])
            assert infos[world]["TimeLimit.truncated"] == (not terminated[world])
            assert infos[world]["episode"]["l"] == step + 1
            assert infos[world]["episode"]["r"] == pytest.approx(returns[world])
            assert infos[world]["success"] == info["success"][world]
            assert ours[world, 12] == 0.0
            assert np.any(ours[world] != theirs[world])
            outcomes.append((bool(terminated[world]), bool(truncated[world])))
        ended |= done
    assert np.all(ended)
    assert {(True, False), (False, True)} <= set(outcomes)


def test_a_fall_at_the_time_limit_is_not_bootstrapped():
    settings = CartPoleSettings(time_limit=0.1)
    env = CartPoleVectorEnv(2, settings=settings, autoreset_mode="same_step")
    adapter = SB3VectorEnv(env)
    adapter.reset()
    _, _, done, infos = adapter.step(np.array([[1e3], [0.0]], np.float32))
    assert done.tolist() == [True, True]
    assert [bool(info["fallen"]) for info in infos] == [True, False]
    assert [info["TimeLimit.truncated"] for info in infos] == [False, True]


def test_the_adapter_seeds_worlds_as_stable_baselines3_does():
    def start(seed):
        adapter = SB3VectorEnv(CartPoleVectorEnv(6, autoreset_mode="same_step"))
        adapter.seed(seed)
        first = adapter.reset()
        assert np.any(adapter.reset() != first)
        return first

    np.testing.assert_array_equal(start(1), start(1))
    dummy = DummyVecEnv([CartPoleEnv] * 6)
    assert SB3VectorEnv(CartPoleVectorEnv(6, autoreset_mode="same_step")).seed(3) == dummy.seed(3)
    np.testing.assert_array_equal(start(3), dummy.reset())
    assert not np.array_equal(start(None), start(None))


def test_the_adapter_needs_the_same_step_mode_and_shares_its_attributes():
    with pytest.raises(ValueError, match='autoreset_mode="same_step"'):
        SB3VectorEnv(CartPoleVectorEnv(2))
    adapter = SB3VectorEnv(CartPoleVectorEnv(3, autoreset_mode="same_step"))
    with pytest.raises(RuntimeError, match="step_async"):
        adapter.step_wait()
    assert adapter.get_attr("num_envs", [0, 2]) == [3, 3]
    adapter.set_attr("label", "x")
    assert adapter.get_attr("label", 1) == ["x"]
    with pytest.raises(ValueError, match="all of them"):
        adapter.set_attr("label", "y", [0])
    assert adapter.env_is_wrapped(Monitor) == [True] * 3
    with pytest.raises(ValueError, match="matrix has shape"):
        LinearFeatures(adapter, np.eye(4))


def test_features_map_the_last_observation_too():
    def adapter():
        settings = CartPoleSettings(time_limit=0.2)
        return SB3VectorEnv(CartPoleVectorEnv(3, settings=settings, autoreset_mode="same_step"))

    plain, mapped = adapter(), LinearFeatures(adapter(), goal_frame(CartPoleSettings()))
    plain.seed(2)
    mapped.seed(2)
    matrix = goal_frame(CartPoleSettings())
    np.testing.assert_allclose(mapped.reset(), plain.reset() @ matrix.T, atol=1e-6)
    for _ in range(2):
        action = np.full((3, 1), 0.1, np.float32)
        expected, _, done, infos = plain.step(action)
        features, _, _, mapped_infos = mapped.step(action)
        np.testing.assert_allclose(features, expected @ matrix.T, atol=1e-6)
    assert done.all()
    for info, mapped_info in zip(infos, mapped_infos, strict=True):
        terminal = info["terminal_observation"]
        assert mapped_info["terminal_observation"] == pytest.approx(matrix @ terminal, abs=1e-6)
        assert matrix @ terminal == pytest.approx(
            [terminal[0] - terminal[4], *terminal[1:4]], abs=1e-6
        )


def test_a_model_learns_through_the_adapter():
    venv = SB3VectorEnv(CartPoleVectorEnv(4, autoreset_mode="same_step"))
    model = A2C("MlpPolicy", venv, n_steps=8, device="cpu")
    model.learn(320)
    assert len(model.ep_info_buffer) > 0
    assert DummyVecEnv not in type(model.get_env()).__mro__
