"""`lagros data export`: what Minari reads back, what the metadata say, and the errors."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import tempfile

import gymnasium as gym
import numpy as np
import pytest
from typer.testing import CliRunner

import lagros_envs
from lagros_benchmarks.commands import cli, data
from lagros_benchmarks.run.demonstrations import DemonstrationSettings, demonstrate
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy

minari = pytest.importorskip("minari")
pytest.importorskip("pyarrow")

IDENTIFIER = "lagros/cartpole/expert-v0"
ARGUMENTS = ("--minari", "--episodes", "2", "--seed", "9", "--disturbance", "sinusoid")


def export(*arguments):
    return CliRunner().invoke(cli.app, ("data", "export", *arguments))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("datasets")
    result = export(*ARGUMENTS, "--bound", "0.6", "--out", str(folder))
    assert result.exit_code == 0, result.output
    return folder, result


@pytest.fixture
def dataset(exported, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(exported[0]))
    return minari.load_dataset(IDENTIFIER)


@pytest.fixture
def grounded(monkeypatch):
    """No episode is flown."""

    def refuse(*arguments):
        raise AssertionError("the check must come before the flights")

    monkeypatch.setattr("lagros_benchmarks.run.demonstrations.demonstrate", refuse)


def test_minari_reads_back_what_the_environment_does_again(dataset):
    assert lagros_envs.__version__  # its import registers the identifiers
    assert (dataset.total_episodes, dataset.total_steps) == (2, 180)
    env = gym.make("lagros/CartPole-v0", disturbance="sinusoid", disturbance_bound=0.6)
    assert dataset.observation_space == env.observation_space
    assert dataset.action_space == env.action_space
    stored = list(dataset.storage.get_episode_metadata([0, 1]))
    for episode, about in zip(dataset.iterate_episodes(), stored, strict=True):
        observation, info = env.reset(seed=about["seed"])
        total = 0.0
        for step, action in enumerate(episode.actions):
            np.testing.assert_array_equal(observation, episode.observations[step])
            assert episode.infos["goal_distance"][step] == info["goal_distance"]
            np.testing.assert_array_equal(episode.infos["disturbance"][step], info["disturbance"])
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == episode.rewards[step]
            assert (terminated, truncated) == (
                episode.terminations[step],
                episode.truncations[step],
            )
            total += reward
        np.testing.assert_array_equal(observation, episode.observations[-1])
        assert truncated
        assert about["rewards_sum"] == pytest.approx(total, rel=1e-12)
        assert about["success"] == info["success"]


def test_what_is_written_is_what_was_flown(dataset):
    flown, _ = demonstrate(DemonstrationSettings("cartpole", 1, 9, "sinusoid", 0.6))
    episode = next(dataset.iterate_episodes())
    np.testing.assert_array_equal(episode.actions, flown[0].actions)
    assert episode.actions.dtype == np.float32
    assert set(episode.infos) == set(flown[0].infos)
    for name, values in flown[0].infos.items():
        np.testing.assert_array_equal(episode.infos[name], values, err_msg=name)


def test_the_episodes_are_those_of_training(dataset):
    seeds = [about["seed"] for about in dataset.storage.get_episode_metadata([0, 1])]
    assert seeds == episode_seeds(9, 2)
    assert not set(seeds) & set(episode_seeds(9, 1000, EVALUATION))


def test_the_metadata_name_metric_planner_and_command(dataset):
    about = dataset.storage.metadata
    record = about["lagros"]
    assert about["license"] == "MIT"
    assert about["author"] == {"lagros contributors"}
    assert about["requirements"] == [f"lagros=={lagros_envs.__version__}"]
    assert "sinusoid" in about["description"]
    assert record["versions"]["lagros"] == lagros_envs.__version__
    assert set(record["metric"]) >= {"sha256", "alpha", "chi", "nu"}
    assert record["planner"]["scp"]["max_iterations"] >= 1
    assert record["run"]["disturbance"] == "sinusoid"
    assert record["run"]["bound"] == 0.6
    assert isinstance(record["command"], list)
    assert record["outcome"]["failed_plans"] == 0
    beyond = sum(int(np.sum(np.abs(e.actions) > 1.0)) for e in dataset.iterate_episodes())
    assert record["outcome"]["actions_outside_space"] == beyond


def test_minari_lists_the_dataset_and_nothing_is_left_over(exported, dataset):
    folder, result = exported
    assert list(minari.list_local_datasets()) == [IDENTIFIER]
    assert [path.name for path in folder.iterdir()] == ["lagros"]
    assert f"wrote {folder / IDENTIFIER} (2 episodes, 180 steps" in result.stdout
    assert "success in 2 of 2 episodes" in result.stdout


def test_a_reader_who_imports_minari_alone_recovers_the_environment(exported):
    script = (
        "import minari, sys; env = minari.load_dataset(sys.argv[1]).recover_environment();"
        "print(env.unwrapped.disturbance.kind, env.unwrapped.disturbance.bound)"
    )
    read = subprocess.run(
        [sys.executable, "-W", "error", "-c", script, IDENTIFIER],
        env=os.environ | {"MINARI_DATASETS_PATH": str(exported[0])},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert read.stdout == "sinusoid 0.6\n", read.stderr


def test_the_default_folder_is_below_the_current_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = export("--minari", "--episodes", "1")
    assert result.exit_code == 0, result.output
    monkeypatch.setenv("MINARI_DATASETS_PATH", "runs/minari")
    (episode,) = minari.load_dataset(IDENTIFIER).iterate_episodes()
    assert len(episode) == 90
    assert [path.name for path in (tmp_path / "runs" / "minari").iterdir()] == ["lagros"]


@pytest.mark.slow
def test_the_spacecraft_is_read_back_with_its_metric_and_repeats(tmp_path, monkeypatch):
    result = export("--minari", "--task", "spacecraft", "--episodes", "1", "--out", str(tmp_path))
    assert result.exit_code == 0, result.output
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("lagros/spacecraft/expert-v0")
    record = dataset.storage.metadata["lagros"]
    for axis in ("plane", "turning"):
        tracking = make_tracking(axis)
        assert record["metric"][axis]["alpha"] == tracking.rate
        np.testing.assert_array_equal(record["metric"][axis]["dual"], tracking.dual)
    assert record["planner"]["control_period"] == 0.1
    (about,) = dataset.storage.get_episode_metadata([0])
    (episode,) = dataset.iterate_episodes()
    env = dataset.recover_environment()
    observation, _ = env.reset(seed=about["seed"])
    for step, action in enumerate(episode.actions):
        np.testing.assert_array_equal(observation, episode.observations[step])
        observation, reward, *_ = env.step(action)
        assert reward == episode.rewards[step]
    np.testing.assert_array_equal(observation, episode.observations[-1])


def make_tracking(axis):
    settings = gym.make("lagros/Spacecraft-v0").unwrapped.settings
    return getattr(CentralizedPolicy(settings, num_agents=1).tracking, axis)


def test_a_dataset_that_is_there_is_never_written_over(exported, grounded):
    folder, _ = exported
    place = folder / IDENTIFIER / "data" / "metadata.json"
    before = place.read_bytes()
    result = export(*ARGUMENTS, "--out", str(folder))
    assert result.exit_code == 2
    assert "is already there; name another folder with --out, or remove it" in result.stderr
    assert place.read_bytes() == before


def test_an_export_that_breaks_off_leaves_nothing(tmp_path, monkeypatch):
    settings = DemonstrationSettings("cartpole", 1, disturbance="none")
    create = data._create

    def breaks_off(*arguments):
        create(*arguments)
        raise OSError("no space left")

    flown, record = demonstrate(settings)
    monkeypatch.setattr(data, "_create", breaks_off)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "elsewhere")
    with pytest.raises(OSError, match="no space left"):
        data.write_minari(tmp_path, settings, flown, record)
    assert list(tmp_path.iterdir()) == []
    assert os.environ["MINARI_DATASETS_PATH"] == "elsewhere"
    monkeypatch.setattr(data, "_create", create)
    written = data.write_minari(tmp_path, settings, flown, record)
    assert json.loads((written.place / "data" / "metadata.json").read_text())["total_episodes"] == 1


def test_a_dataset_that_cannot_be_written_is_kept_elsewhere(tmp_path, monkeypatch):
    write = data.write_minari

    def full(folder, *arguments):
        if folder == tmp_path / "out":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(folder, *arguments)

    monkeypatch.setattr(data, "write_minari", full)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    result = export("--minari", "--episodes", "1", "--out", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert "No space left on device; it is kept as " in result.stderr
    (kept,) = tmp_path.glob("lagros-*/expert-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(kept))
    assert minari.load_dataset(IDENTIFIER).total_episodes == 1


def test_what_killed_exports_left_is_removed(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for pid in (ended.pid, os.getpid()):
        (tmp_path / f".export-{pid}-x").mkdir()
    data._remove_stale(tmp_path)
    assert os.listdir(tmp_path) == [f".export-{os.getpid()}-x"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "name the format to write: pass --minari"),
        (("--minari", "--task", "cartpol"), "unknown task 'cartpol'. Did you mean 'cartpole'?"),
        (("--minari", "--episodes", "0"), "episodes=0 must be a whole number"),
        (("--minari", "--seed", "-1"), "seed=-1 must be a non-negative integer"),
        (("--minari", "--disturbance", "worst"), "disturbance='worst' must be one of none,"),
        (("--minari", "--bound", "-1"), "bound=-1.0 must be finite and >= 0"),
        (("--minari", "--out", "/proc/none/x"), "--out: cannot write '/proc/none/x"),
    ],
)
def test_a_mistake_is_explained_with_status_2_before_any_flight(grounded, arguments, message):
    result = export(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert isinstance(result.exception, SystemExit)
