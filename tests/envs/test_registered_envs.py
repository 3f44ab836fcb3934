"""Every environment that is registered, by the checkers of other libraries and at random."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import lagros_envs  # noqa: F401 - registers the ids

IDS = sorted(name for name in gym.registry if name.startswith("lagros/"))


def test_the_registry_holds_the_cartpole():
    assert "lagros/CartPole-v0" in IDS


@pytest.mark.parametrize("name", IDS)
# Positions and rates have no bound; Gymnasium warns so of its own environments, too.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is -?infinity")
def test_gymnasium_checks_the_environment_without_another_warning(name):
    # Warnings are errors in this suite, and Gymnasium's logger warns through `warnings`.
    check_env(gym.make(name).unwrapped)
    check_env(gym.make(name, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
# Thrusters only push: their actions lie in [0, 1].
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric")
def test_stable_baselines3_checks_the_environment_without_a_warning(name):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(gym.make(name, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("name", IDS)
def test_random_episodes_stay_in_the_observation_space_and_end(name):
    env = gym.make(name)
    env.action_space.seed(0)
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        ended = False
        for _ in range(1000):
            assert env.observation_space.contains(observation)
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            assert math.isfinite(reward)
            assert isinstance(info, dict)
            ended = terminated or truncated
            if ended:
                break
        assert ended
        assert env.observation_space.contains(observation)


@pytest.mark.parametrize("name", IDS)
def test_an_environment_can_be_made_again_from_its_spec(name):
    env = gym.make(name, disturbance="uniform", disturbance_bound=0.3)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    first, second = (made.reset(seed=3)[0] for made in (env, again))
    np.testing.assert_array_equal(first, second)
    assert again.unwrapped.disturbance == env.unwrapped.disturbance
