"""Models of stable-baselines3 by file: detection that unpickles nothing, and what is refused."""

import base64
import json
import pickle
import sys
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3

from lagros_envs.cartpole import CartPoleEnv
from lagros_envs.cartpole_vector import CartPoleVectorEnv
from lagros_policies.sb3_model import (
    ALGORITHMS,
    StableBaselines3Policy,
    detect_algorithm,
    load_stable_baselines3,
)

CLASSES = {"A2C": A2C, "DDPG": DDPG, "PPO": PPO, "SAC": SAC, "TD3": TD3}


@pytest.fixture
def observations():
    env = CartPoleVectorEnv(200, disturbance="sphere", autoreset_mode="disabled")
    observation, _ = env.reset(seed=3)
    rng = np.random.default_rng(4)
    for _ in range(5):
        observation, *_ = env.step(rng.uniform(-1.0, 1.0, (200, 1)))
    return observation


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    """Return one saved model per algorithm, under names that do not tell the algorithm."""
    folder = tmp_path_factory.mktemp("zips")
    paths = {}
    for index, (name, algorithm) in enumerate(CLASSES.items()):
        off_policy = {"buffer_size": 10} if name in ("DDPG", "SAC", "TD3") else {}
        model = algorithm(
            "MlpPolicy", CartPoleEnv(), policy_kwargs={"net_arch": [8]}, device="cpu", **off_policy
        )
        paths[name] = folder / f"model{index}.zip"
        model.save(paths[name])
    return paths


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_saved_model_is_detected_loaded_and_acts_the_same(zips, observations, name):
    assert detect_algorithm(zips[name]) == name
    policy = load_stable_baselines3(zips[name])
    assert isinstance(policy, StableBaselines3Policy)
    assert policy.name == zips[name].stem
    model = CLASSES[name].load(zips[name], device="cpu")
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(policy.predict(observations)[0], expected)
    named = load_stable_baselines3(zips[name], name.lower())
    np.testing.assert_array_equal(named.predict(observations)[0], expected)


class Trap:
    """Unpickling it makes a file."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return (Path.touch, (self.marker,))


def write_zip(path, data):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", data)
    return path


def test_detection_unpickles_nothing(zips, tmp_path, monkeypatch):
    marker = tmp_path / "ran"
    trap = base64.b64encode(pickle.dumps(Trap(marker))).decode()
    with zipfile.ZipFile(zips["PPO"]) as archive:
        data = json.loads(archive.read("data"))
    for entry in data.values():
        if isinstance(entry, dict) and ":serialized:" in entry:
            entry[":serialized:"] = trap
    path = write_zip(tmp_path / "trap.zip", json.dumps(data))
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)  # nor is it needed
    assert detect_algorithm(path) == "PPO"
    assert not marker.exists()
    monkeypatch.undo()
    with pytest.raises(ValueError, match="could not be loaded"):
        load_stable_baselines3(path)
    assert marker.exists(), "the trap does not work, so that the test shows nothing"


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.zip"):
        load_stable_baselines3(tmp_path / "nowhere.zip")
    path = tmp_path / "text.zip"
    path.write_text("not a zip")
    with pytest.raises(ValueError, match=r"text\.zip is not a model"):
        load_stable_baselines3(path)
    for data in ("{", "[]", "{}", '{"policy_class": {"__module__": "sb3_contrib.tqc"}}'):
        with pytest.raises(ValueError, match=r"entry 'data'|prefix, e\.g\. ppo:"):
            load_stable_baselines3(write_zip(path, data))
    with pytest.raises(ValueError, match="could not be loaded as a SAC model"):
        load_stable_baselines3(path, "sac")


def test_algorithms_that_are_not_known_are_named(zips, tmp_path):
    with pytest.raises(ValueError, match=r"'trpo' is not known; use one of a2c, ddpg"):
        load_stable_baselines3(zips["PPO"], "trpo")
    path = tmp_path / "dqn.zip"
    DQN("MlpPolicy", gym.make("CartPole-v1"), buffer_size=10, device="cpu").save(path)
    with pytest.raises(ValueError, match=r"prefix, e\.g\. ppo:"):
        load_stable_baselines3(path)


def test_models_of_other_tasks_are_rejected(tmp_path):
    path = tmp_path / "pendulum.zip"
    PPO("MlpPolicy", gym.make("Pendulum-v1"), device="cpu").save(path)
    with pytest.raises(ValueError, match=r"observations of shape \(3,\)"):
        load_stable_baselines3(path)


def test_the_missing_extra_is_named(zips, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(ImportError, match=r"lagros\[rl\]"):
        load_stable_baselines3(zips["PPO"])
