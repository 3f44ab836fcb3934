"""`lagros bench` and `lagros attack` in environments of somebody else's."""

from __future__ import annotations

import json
import os
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks import compare
from lagros_benchmarks.commands.cli import app
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.report.tables import markdown_text
from lagros_benchmarks.run.fingerprints import fingerprint
from lagros_benchmarks.run.library import Toolbox
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.tasks.foreign.loop import fly
from lagros_benchmarks.worst_case.attack import AttackSettings, run_attack
from lagros_benchmarks.worst_case.replay import load_worst_cases
from lagros_envs import Foreign
from lagros_envs.registry import find_any, find_task
from lagros_policies.sb3_model import StableBaselines3Policy
from tests.envs.foreign_worlds import STEP, Drift, OfDrift

RUNNER = CliRunner()
PENDULUM = "gym:Pendulum-v1"
# Written where the commands find it; its policies are in it, too.
MINE = """
import numpy as np

from lagros_envs import Foreign
from tests.envs.foreign_worlds import Drift, OfDrift, Swing

spring = Foreign(Swing, {}, "spring", steps=60)
task = Foreign(Drift, {"edge": 1.5}, "drift", adapter=OfDrift(), steps=20, bound=0.5)


class Still:
    def __init__(self, settings):
        self.size = settings.facts.action_space.shape

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        rows = np.shape(observation)[:-1]
        return np.zeros((*rows, *self.size), np.float32), state


class Shy(Still):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if np.any(np.linalg.norm(observation, axis=-1) > 0.3):
            raise RuntimeError("too far")
        return super().predict(observation)


class Keeping(Still):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return super().predict(observation)[0], 1


class Half(Still):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros(1, np.float32), state
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Return the file of an environment, in the folder that the command runs in."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, os.getcwd()])
    (tmp_path / "mydrift.py").write_text(MINE)
    monkeypatch.delitem(sys.modules, "mydrift", raising=False)
    yield "./mydrift.py"
    sys.modules.pop("mydrift", None)


def run(*arguments):
    """Return what a command came to."""
    return RUNNER.invoke(app, [str(one) for one in arguments])


def test_policies_meet_the_same_episodes_and_disturbances(mine, tmp_path):
    rows_file, episodes_file = tmp_path / "rows.json", tmp_path / "episodes.jsonl"
    done = run(
        "bench", mine, "--policies", "mydrift:Still,random", "--episodes", 4, "--bound", "0.5,1",
        "--disturbance", "constant,gust", "--json", rows_file, "--episodes-file", episodes_file,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "gym:drift, constant disturbance, d̄ = 0.5, 4 episodes, seed 0" in done.output
    rows = json.loads(rows_file.read_text())
    assert [(row["policy"], row["disturbance"], row["bound"]) for row in rows[:4]] == [
        ("mydrift:Still", "constant", 0.5),
        ("random", "constant", 0.5),
        ("mydrift:Still", "constant", 1.0),
        ("random", "constant", 1.0),
    ]
    episodes = [json.loads(line) for line in episodes_file.read_text().splitlines()]
    seeds = BenchmarkSettings(task=mine, policies=("random",), episodes=4).episode_seeds()
    assert [one["seed"] for one in episodes] == seeds * 8
    # Without control the return follows from start and disturbance alone.
    task = find_any("gym:drift")
    for one in episodes[:4]:
        env = task.make("constant", 0.5)
        where, _ = env.reset(seed=one["seed"])
        push = env.step(np.zeros(2, np.float32))[4]["disturbance"]
        path = where + STEP * np.arange(1, 21)[:, None] * push
        assert one["total_reward"] == pytest.approx(-np.linalg.norm(path, axis=-1).sum())
        assert one["success"] == (np.linalg.norm(path[-1]) < 0.5)
    assert rows[0]["return_mean"] == pytest.approx(
        np.mean([e["total_reward"] for e in episodes[:4]])
    )
    difference = rows[1]["versus"]["mydrift:Still"]["return_difference"]
    assert difference == pytest.approx(rows[1]["return_mean"] - rows[0]["return_mean"])


def test_they_are_compared_from_python(mine):
    task = find_any(mine)
    found = compare("gym:drift", {"still": find_policy(task), "random": "random"}, episodes=3)
    assert "gym:drift, uniform disturbance, d̄ = 0.5, 3 episodes" in str(found)
    assert compare(task, ["random"], episodes=3).rows[0]["return_mean"] == pytest.approx(
        found.rows[1]["return_mean"]
    )


def test_jobs_change_nothing_but_times(mine):
    def flown(jobs):
        settings = BenchmarkSettings(
            task=mine, policies=("random",), episodes=6, bounds=(0.5,), jobs=jobs, chunk=3
        )
        return run_benchmark(settings)

    alone, together = flown(1), flown(2)
    assert alone.episodes == together.episodes
    assert "return" in markdown_text(summarise(together))


def test_what_raises_is_a_failure_and_the_status_says_so(mine, tmp_path):
    file = tmp_path / "rows.json"
    options = ["--disturbance", "constant", "--bound", "3", "--json", file]
    done = run("bench", mine, "--policies", "mydrift:Shy", "--episodes", 3, *options)
    assert done.exit_code == 3
    assert "RuntimeError: too far" in done.output
    row = json.loads(file.read_text())[0]
    assert row["raised"] == 3
    assert row["return_mean"] is None
    assert row["terminated_rate"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["bench", "gym:Pendulm-v1"], 2, "Did you mean: `Pendulum`"),
        (["bench", "gym:nosuch:Env-v0"], 2, "nosuch"),
        (["bench", "gym:FrozenLake-v1"], 2, "no adapter knows"),
        (["bench", "gym:MountainCarContinuous-v0"], 2, "in a file of yours"),
        (["bench", PENDULUM, "--policies", "lagros"], 2, "Valid: random, the .zip"),
        (["bench", PENDULUM, "--disturbance", "worst"], 2, "`lagros attack gym:Pendulum-v1`"),
        (["bench", PENDULUM, "--guarantee"], 2, "has a plan"),
        (["bench", PENDULUM, "--figure", "a.png"], 2, "no figure of gym:Pendulum-v1"),
        (["bench", PENDULUM, "--html", "a.html"], 2, "no page of gym:Pendulum-v1"),
        (["bench", PENDULUM, "--agents", "2"], 2, "is one body"),
        (["bench", PENDULUM, "--channels", "rates"], 1, "which of the 2 coordinates are rates"),
        (["attack", PENDULUM], 2, "unknown policy 'lagros'"),
        (["attack", PENDULUM, "--policy", "random"], 2, "has no worst case"),
        (["attack", "./mydrift.py", "--policy", "mydrift:Still", "--goal", "tube"], 2, "return"),
        (["attack", "./mydrift.py", "--policy", "mydrift:Still", "--safety-filter"], 2, "filter"),
        (["attack", "./mydrift.py", "--policy", "mydrift:Keeping"], 2, "keeps a memory"),
        (["attack", "./mydrift.py", "--policy", "mydrift:Half"], 1, "cannot fly"),
        *(
            ([*words, PENDULUM], 2, "an environment of somebody else's")
            for words in (["certify"], ["train"], ["watch"], ["reproduce"])
        ),
    ],
)
def test_what_is_not_there_is_refused_in_words(mine, arguments, status, said):
    done = run(*arguments)
    assert done.exit_code == status, done.output
    assert said in " ".join(done.output.split())


def test_a_file_says_which_environment_and_needs_a_name_for_it():
    with pytest.raises(ValueError, match="label='' must be a name for tables: period"):
        Foreign("Pendulum-v1", period=0.1)
    with pytest.raises(ValueError, match="a function makes it another"):
        Foreign(Drift)
    with pytest.raises(ValueError, match=r"gym:none makes None; it must be a gymnasium\.Env"):
        _ = Foreign(lambda: None, label="none").facts
    with pytest.raises(ValueError, match="and nothing else"):
        find_task(PENDULUM)
    heavy = Foreign("Pendulum-v1", {"g": 20.0}, "heavy")
    assert heavy.make("none", 0.0).unwrapped.g == 20.0
    assert heavy.name == heavy.title == "gym:heavy"


def test_what_a_run_depends_on_includes_how_the_environment_is_made():
    def number(**changes):
        task = Foreign("Pendulum-v1", changes, "own")
        settings = BenchmarkSettings(task=PENDULUM, policies=("random",))
        settings.__dict__["description"] = task
        return fingerprint(settings, Toolbox())

    assert number() == number()
    assert number() != number(g=9.0)


def drift_attack(**given):
    """Return settings of a small attack on the drifting environment, and its target."""
    return AttackSettings.for_task(
        "./mydrift.py",
        given.pop("method", "hybrid"),
        given.pop("budget", 80),
        **{"policy": "mydrift:Still", "episodes": 3, "bound": 0.5, **given},
    )


def test_an_attack_finds_the_worst_there_is(mine):
    """The worst that can be done to a body that does nothing is to push it straight outwards."""
    found = run_attack(drift_attack(method="cross-entropy", budget=200))
    task = find_any("gym:drift")
    for outcome in found.cases.outcomes:
        start = np.linalg.norm(task.make("none", 0.0).reset(seed=outcome.seed)[0])
        worst = (start + 0.5 * STEP * np.arange(1, 21)).sum()
        assert 0.9 * worst <= outcome.score <= worst * (1 + 1e-9)
    row = found.row
    # Well beyond what chance does, and beyond the first sequences that are tried.
    assert row["score_worst"] > 2.0 * row["random_score_worst"]
    assert row["broken_rate"] is None
    assert np.linalg.norm(found.cases.pushes, axis=-1).max() <= 0.5 * (1 + 1e-12)


def test_an_attack_finds_a_weakness_that_chance_does_not(mine):
    """A spring resounds: its worst sequence turns with it, which no constant push does."""
    options = {"policy": "mydrift:Still", "episodes": 1, "bound": 0.5}
    row = run_attack(
        AttackSettings.for_task("./mydrift.py:spring", "cross-entropy", 300, **options)
    ).row
    task, chance, constant = find_any("gym:spring"), [], []
    for kind, returns, count in (("uniform", chance, 300), ("constant", constant, 100)):
        still = find_policy(task)
        for seed in range(count):
            returns.append(fly(task.make(kind, 0.5), still, seed, "still", kind).total_reward)
    assert row["score_worst"] > -1.5 * min(chance)
    assert row["score_worst"] > -1.2 * min(constant)


def find_policy(task):
    """Return the policy that does nothing."""
    still = np.zeros(task.facts.action_space.shape, np.float32)
    return SimpleNamespace(predict=lambda *_: (still, None), name="still")


def test_an_attack_looks_for_the_earliest_end(mine):
    found = run_attack(drift_attack(goal="termination", bound=1.5))
    assert found.row["broken_rate"] == 1.0
    task = find_any("gym:drift")
    for outcome in found.cases.outcomes:
        start = np.linalg.norm(task.make("none", 0.0).reset(seed=outcome.seed)[0])
        earliest = int(np.floor((1.5 - start) / (1.5 * STEP))) + 1
        assert earliest <= -outcome.score <= earliest + 1
        assert outcome.measures["terminated"]


def test_what_was_found_is_flown_again_to_the_last_bit(mine, tmp_path):
    sequences, figures = tmp_path / "found.npz", tmp_path / "found.json"
    options = ["--policy", "mydrift:Still", "--episodes", 2, "--budget", 30, "--bound", "0.5"]
    done = run("attack", mine, *options, "--npz", sequences, "--json", figures)
    assert done.exit_code == 0, done.output
    assert "goal return" in done.output
    assert "the environment names no return that counts as broken" in done.output
    row = json.loads(figures.read_text())
    assert row["task"] == "gym:drift"
    again = run("attack", mine, "--policy", "mydrift:Still", "--replay", sequences)
    assert again.exit_code == 0, again.output
    assert again.output.count("as stored") == 2
    # In Python, too: each is a kind of `disturb`.
    cases, task = load_worst_cases(sequences), find_any("gym:drift")
    env = task.make(cases.pushes[0], 0.5)
    flown = fly(env, find_policy(task), cases.outcomes[0].seed, "still", "sequence")
    assert -flown.total_reward == cases.outcomes[0].score


def test_a_flight_that_raises_is_as_bad_as_any(mine, tmp_path):
    done = run("attack", mine, "--policy", "mydrift:Shy", "--episodes", 1, "--budget", 20,
               "--bound", "3")  # fmt: skip
    assert done.exit_code == 3
    assert "1 of 1" in done.output


@pytest.mark.parametrize("name", ["Pendulum-v1", "Acrobot-v1"])
def test_models_of_stable_baselines3_fly(name, tmp_path, monkeypatch):
    library = pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    model = library.PPO("MlpPolicy", name, n_steps=8, batch_size=8, seed=0, device="cpu")
    model.save("model.zip")
    file = tmp_path / "rows.json"
    options = ["--episodes", 2, "--json", file]
    done = run("bench", f"gym:{name}", "--policies", "model.zip,random", *options)
    assert done.exit_code == 0, done.output
    # The same as by hand.
    task = find_any(f"gym:{name}")
    seeds = BenchmarkSettings(task=f"gym:{name}", policies=("random",), episodes=2).episode_seeds()
    returns = []
    for seed in seeds:
        env = task.make("uniform", 0.1)
        seen, over, gained = env.reset(seed=seed)[0], False, 0.0
        while not over:
            action, _ = model.predict(seen, deterministic=True)
            seen, reward, terminated, truncated, _ = env.step(action)
            gained, over = gained + float(reward), terminated or truncated
        returns.append(gained)
    assert json.loads(file.read_text())[0]["return_mean"] == pytest.approx(np.mean(returns))
    other = {"Pendulum-v1": "Acrobot-v1", "Acrobot-v1": "Pendulum-v1"}[name]
    with pytest.raises(ValueError, match="was trained on observations of shape"):
        StableBaselines3Policy(model, "model", find_any(f"gym:{other}"))


def test_the_adapter_is_seen_to_work_before_anything_flies():
    class Deaf(OfDrift):
        def set_state(self, env, state):
            """Do nothing."""

    with pytest.raises(ValueError, match="gym:deaf: the adapter Deaf: after set_state"):
        _ = Foreign(Drift, {}, "deaf", adapter=Deaf(), steps=5).facts
