"""`compare`: the digits of `lagros bench`, whatever a policy is given as."""

from __future__ import annotations

import builtins
import json
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks import Comparison, EpisodeRecord, compare
from lagros_benchmarks.commands import cli
from lagros_benchmarks.run.files import plain
from lagros_benchmarks.run.library import SetupError
from lagros_envs.registry import task_named
from lagros_policies.baselines import LqrPolicy
from lagros_policies.sb3_model import StableBaselines3Policy, load_stable_baselines3
from tests.benchmarks import fakes, toys

TASK = task_named("cartpole")
# Of the clock, and of who has asked.
TIMED = ("step_time", "forward_time", "deadline", "command", "threads", "machine", "counters")


def untimed(rows):
    return [
        {name: value for name, value in plain(row).items() if not name.startswith(TIMED)}
        for row in rows
    ]


def records(result):
    return [replace(record, policy="") for record in result.episodes]


def test_it_has_the_digits_of_the_command(tmp_path):
    path = tmp_path / "rows.json"
    words = ["bench", "cartpole", "--policies", "lqr,lagros", "--episodes", "4", "--seed", "3"]
    words += ["--disturbance", "uniform,constant", "--bound", "0.3", "--initial-error", "0.05"]
    result = CliRunner().invoke(cli.app, [*words, "--json", str(path)])
    assert result.exit_code == 0, result.output
    ours = compare(
        "cartpole",
        {"lqr": "lqr", "lagros": "lagros"},
        episodes=4,
        seed=3,
        disturbance=("uniform", "constant"),
        bound=0.3,
        initial_error=0.05,
    )
    assert untimed(ours.rows) == untimed(json.loads(path.read_text()))
    printed = ours.table().splitlines()
    assert max(map(len, printed)) <= 80
    for line in printed:
        # Times differ; all the rest of the text is what the command prints.
        assert not line.startswith(("Against", "  (c)")) or line in result.output


def test_what_a_policy_is_given_as_changes_nothing():
    def made(task):
        return LqrPolicy(task)

    result = compare(
        "lagros/CartPole-v0",
        {
            "lqr": "lqr",
            "alias": "lqr",
            "object": LqrPolicy(TASK),
            "class": LqrPolicy,
            "function": made,
            "partial": partial(LqrPolicy, state_weights=None),
            "module": "lagros_policies.baselines:LqrPolicy",
            "pair": ("lqr", {"state_weights": None}),
        },
        episodes=3,
    )
    assert isinstance(result, Comparison)
    assert all(isinstance(record, EpisodeRecord) for record in result.episodes)
    first = records(result)[:3]
    assert len(result.episodes) == 8 * 3
    for begin in range(0, 24, 3):
        assert records(result)[begin : begin + 3] == first
    other = compare("cartpole", {"heavy": ("lqr", {"control_weights": 100.0})}, episodes=3)
    assert records(other) != first
    assert records(compare("cartpole", ["lqr"], episodes=3, jobs=2)) == first


def test_a_task_may_be_given_itself_and_with_settings_of_its_own():
    slide = toys.Slide()
    result = compare(slide, {"straight": toys.Straight(slide), "lqr": "lqr"}, episodes=3)
    assert [row["task"] for row in result.rows] == ["slider", "slider"]
    assert result.rows[0]["bound"] == 0.1
    short = compare(replace(TASK, time_limit=2.0), ["lqr"], episodes=2, bound=0.2)
    assert len(short.rows[0]["time_s"]) == 21
    assert short.run.settings.description.time_limit == 2.0
    wrong = toys.Slide()
    object.__setattr__(wrong, "control_scale", (1.0,))
    with pytest.raises(ValueError, match="control_scale"):
        compare(wrong, ["lqr"])


def test_it_is_shown_as_table_frame_and_figure(tmp_path, monkeypatch):
    result = compare("cartpole", {"a [b]": fakes.LinearPolicy(), "lqr": "lqr"}, episodes=2)
    assert str(result) == result.table()
    assert "a [b]" in result.table()
    path = tmp_path / "errors.svg"
    assert result.figure(path) == path
    assert path.stat().st_size > 1000
    assert len(result.figure().axes) == 1
    pandas = pytest.importorskip("pandas")
    frame = result.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert frame["success_rate"].tolist() == [row["success_rate"] for row in result.rows]
    assert frame["success_ci95_low"][0] == result.rows[0]["success_ci95"].low
    assert frame["certified_violation_rate"].isna().all()

    def missing(name, *rest):
        if name == "pandas":
            raise ImportError(name)
        return original(name, *rest)

    original = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match=r"pip install 'lagros\[pandas\]'"):
        result.to_pandas()


@pytest.mark.parametrize(
    ("policies", "message"),
    [
        ("lqr", "must be a dictionary of policies by name, or a list of names"),
        ({}, "must be a dictionary of policies by name"),
        (["lqrr"], "unknown policy 'lqrr'"),
        ({"mine": "nowhere.zip"}, "there is no file 'nowhere.zip'"),
        ({"mine": ("lqr", 3)}, "a pair is a name and a dictionary of settings"),
        ({"lqr": fakes.IdlePolicy()}, "'lqr' is a policy of this package"),
    ],
)
def test_what_names_no_policies_is_refused(policies, message):
    with pytest.raises(ValueError, match=message):
        compare("cartpole", policies, episodes=2)


def test_what_cannot_be_built_or_fly_is_said_with_its_name():
    def broken(task):
        raise RuntimeError("no weights")

    for policy, message in ((broken, "no weights"), (object(), "has no method predict")):
        with pytest.raises(SetupError, match=rf"policy 'mine'.*{message}"):
            compare("cartpole", {"mine": policy}, episodes=2)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A model that has learned nothing, plain and behind a normalisation that has seen a little."""
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    folder = tmp_path_factory.mktemp("models")
    worlds = DummyVecEnv([lambda: gym.make("lagros/CartPole-v0")])
    small = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 16, "batch_size": 16, "device": "cpu"}
    bare = sb3.PPO("MlpPolicy", worlds, seed=0, **small)
    normal = VecNormalize(worlds, norm_reward=False, clip_obs=3.0)
    behind = sb3.PPO("MlpPolicy", normal, seed=0, **small)
    behind.learn(64)
    bare.save(folder / "bare.zip")
    behind.save(folder / "behind.zip")
    normal.save(str(folder / "normal.pkl"))
    return folder, bare, behind, normal


def test_models_of_stable_baselines3_fly_as_objects_and_as_files(models):
    folder, bare, behind, normal = models
    asked = {"vecnormalize": str(folder / "normal.pkl")}
    result = compare(
        "cartpole",
        {
            "bare": bare,
            "bare file": folder / "bare.zip",
            "behind": behind,
            "behind file": (str(folder / "behind.zip"), asked),
            "as it is": folder / "behind.zip",
        },
        episodes=2,
    )
    episodes = records(result)
    assert episodes[0:2] == episodes[2:4]
    assert episodes[4:6] == episodes[6:8]
    # The pickle lies beside the zip, and is not looked at unless it is asked for.
    assert episodes[8:10] != episodes[6:8]
    policy = load_stable_baselines3(folder / "behind.zip", settings=TASK, **asked)
    seen = np.random.default_rng(0).normal(0.0, 3.0, (5, 13)).astype(np.float32)
    shown = normal.normalize_obs(seen)
    np.testing.assert_allclose(policy.normalisation.seen(seen), shown, rtol=1e-6)
    np.testing.assert_allclose(
        policy.predict(seen)[0], behind.predict(shown, deterministic=True)[0], rtol=1e-4, atol=1e-6
    )


def test_a_normalisation_of_something_else_is_refused(models, tmp_path):
    folder, bare, _, _ = models
    (tmp_path / "not.pkl").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="no VecNormalize of this model's observations"):
        load_stable_baselines3(
            folder / "behind.zip", settings=TASK, vecnormalize=tmp_path / "not.pkl"
        )
    with pytest.raises(FileNotFoundError):
        load_stable_baselines3(folder / "behind.zip", settings=TASK, vecnormalize="nowhere.pkl")
    wrong = load_stable_baselines3(
        folder / "behind.zip", settings=TASK, vecnormalize=folder / "normal.pkl"
    ).normalisation._replace(mean=np.zeros(3))
    with pytest.raises(ValueError, match=r"normalised by means of shape \(3,\)"):
        StableBaselines3Policy(bare.policy, "wrong", TASK, wrong)
