"""Models of stable-baselines3 by file: detection that unpickles nothing, and what is refused."""

import base64
import json
import os
import pickle
import sys
import tracemalloc
import zipfile
from contextlib import contextmanager, suppress
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from typer.testing import CliRunner

import lagros_policies
from lagros_benchmarks.commands.cli import app
from lagros_benchmarks.training.sb3_parallel import ParallelVecEnv
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_envs.tasks.spacecraft.single import SpacecraftEnv
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
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


@pytest.fixture(scope="module")
def spacecraft_zip(tmp_path_factory):
    """Return a model that three spacecraft share."""
    worlds = ParallelVecEnv([spacecraft_v0.parallel_env(3, "paper")])
    path = tmp_path_factory.mktemp("spacecraft") / "shared.zip"
    PPO("MlpPolicy", worlds, policy_kwargs={"net_arch": [8]}, device="cpu", seed=2).save(path)
    return path


def test_a_model_of_spacecraft_flies_all_agents_of_all_worlds(spacecraft_zip):
    env = SpacecraftVectorEnv(12, 3, "paper", "uniform", 0.4)
    rows, _ = env.reset(seed=1)
    expected, _ = PPO.load(spacecraft_zip, device="cpu").predict(rows, deterministic=True)
    assert np.ptp(expected) > 0.01
    for name in (str(spacecraft_zip), f"ppo:{spacecraft_zip}"):
        policy = lagros_policies.make(name, spacecraft_v0.parallel_env(3, "paper"))
        actions, state = policy.predict(rows)
        np.testing.assert_array_equal(actions, expected)
        assert actions.dtype == np.float32
        assert state is None
        np.testing.assert_allclose(policy.predict(rows[4])[0], expected[4], atol=1e-6)


def test_a_model_of_a_single_spacecraft_is_one_of_worlds_of_one_agent(tmp_path):
    path = tmp_path / "one.zip"
    PPO("MlpPolicy", SpacecraftEnv("open"), policy_kwargs={"net_arch": [8]}, device="cpu").save(
        path
    )
    env = spacecraft_v0.parallel_env(1, "open")
    observations, _ = env.reset(seed=0)
    action, _ = lagros_policies.make(str(path), env).predict(observations["agent_0"])
    assert env.action_space("agent_0").contains(action)


def test_a_model_of_spacecraft_is_refused_where_it_does_not_fit(spacecraft_zip, zips):
    for env, text in (
        (spacecraft_v0.parallel_env(2, "paper"), "worlds of 2 agents and at most 6 obstacles"),
        (spacecraft_v0.parallel_env(3, "open"), "worlds of 3 agents and at most 0 obstacles"),
        (CartPoleEnv(), "lagros/CartPole-v0 has"),
    ):
        with pytest.raises(ValueError, match=text):
            lagros_policies.make(str(spacecraft_zip), env)
    with pytest.raises(ValueError, match=r"observations of shape \(13,\)"):
        lagros_policies.make(str(zips["SAC"]), spacecraft_v0.parallel_env(3, "paper"))
    with pytest.raises(ValueError, match="preset"):
        load_stable_baselines3(spacecraft_zip, preset="nowhere")


def test_models_of_both_tasks_are_rows_of_the_benchmark(zips, spacecraft_zip, tmp_path):
    file = tmp_path / "rows.json"
    few = ["--episodes", "1", "--timing-episodes", "1", "--bound", "0.4", "--json", str(file)]
    for task, model in (
        (["cartpole"], zips["TD3"]),
        (["spacecraft", "--agents", "3", "--safety-filter", "none"], spacecraft_zip),
    ):
        result = CliRunner().invoke(app, ["bench", *task, "--policies", str(model), *few])
        assert result.exit_code == 0, result.output
        rows = json.loads(file.read_text())
        assert {row["policy"] for row in rows} == {str(model)}
        assert [row["errors"] for row in rows] == [[]] * len(rows)


def test_the_missing_extra_is_named(zips, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(ImportError, match=r"lagros\[rl\]"):
        load_stable_baselines3(zips["PPO"])


def zipped(path, entries, kind=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return path


def entries_of(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def bomb(tmp_path_factory):
    """Return a zip that expands to 315 MB from a two-hundredth of it, or less."""
    path = tmp_path_factory.mktemp("bomb") / "bomb.zip"
    block = bytes(1 << 20)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("data", "{}")
        with archive.open("policy.pth", "w") as stream:
            for _ in range(300):
                stream.write(block)
    return path


def test_a_zip_that_expands_to_too_much_is_refused_before_it_does(bomb):
    assert bomb.stat().st_size < 2e6
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"bomb\.zip would expand to 315 MB"):
            lagros_policies.make(str(bomb), CartPoleEnv())
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def test_weights_that_expand_to_too_much_are_refused(bomb, zips, tmp_path):
    entries = entries_of(zips["PPO"]) | {"policy.pth": bomb.read_bytes()}
    path = zipped(tmp_path / "outer.zip", entries)
    with pytest.raises(ValueError, match=r"outer\.zip would expand to 3\d\d MB"):
        lagros_policies.make(f"ppo:{path}", CartPoleEnv())


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"../../data": "x"}, "outside"),
        ({"/data": "x"}, "outside"),
        ({"..\\data": "x"}, "outside"),
        ({f"data{index}": "x" for index in range(200)}, "200 entries"),
        ({"data": "[" * 200_000}, "nested"),
        ({"data": "1"}, "algorithm"),
        ({"data": b"\xff\xfe"}, "UTF-8"),
        ({"data": ""}, "empty"),
        ({"else": "x"}, "no readable entry"),
        ({}, "no readable entry"),
    ],
)
def test_a_zip_that_is_no_model_is_refused_in_one_line(tmp_path, entries, reason):
    path = zipped(tmp_path / "odd.zip", entries)
    with pytest.raises(ValueError, match=reason) as caught:
        lagros_policies.make(str(path), CartPoleEnv())
    assert "odd.zip" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_damaged_zips_are_refused_in_one_line(zips, tmp_path):
    whole = zips["PPO"].read_bytes()
    rng = np.random.default_rng(0)
    damaged = [whole[:count] for count in (0, 1, 100, len(whole) // 2, len(whole) - 1)]
    for _ in range(40):
        bytes_ = bytearray(whole)
        for place in rng.integers(0, len(whole), 20):
            bytes_[place] = rng.integers(256)
        damaged.append(bytes(bytes_))
    for data in damaged:
        path = tmp_path / "damaged.zip"
        path.write_bytes(data)
        # What stays loadable may load.
        with suppress(ValueError), refused_in_one_line("damaged.zip"):
            lagros_policies.make(str(path), CartPoleEnv())


@contextmanager
def refused_in_one_line(name):
    try:
        yield
    except ValueError as error:
        if name not in str(error) or "\n" in str(error):
            raise AssertionError(f"not one line that names the file: {error}") from error
        raise


def test_no_file_of_the_kind(tmp_path):
    folder = tmp_path / "folder.zip"
    folder.mkdir()
    with pytest.raises(ValueError, match=r"folder\.zip"):
        lagros_policies.make(str(folder), CartPoleEnv())
    pipe = tmp_path / "pipe.zip"
    os.mkfifo(pipe)
    with pytest.raises(ValueError, match=r"pipe\.zip"):
        lagros_policies.make(str(pipe), CartPoleEnv())


def test_a_model_of_rescaled_actions_is_refused(tmp_path):
    wide = gym.wrappers.RescaleAction(CartPoleEnv(), np.float32(-3.0), np.float32(3.0))
    PPO("MlpPolicy", wide, policy_kwargs={"net_arch": [4]}, device="cpu").save(tmp_path / "wide")
    with pytest.raises(ValueError, match="wide was trained on actions from -3 to 3"):
        lagros_policies.make(str(tmp_path / "wide.zip"), CartPoleEnv())
