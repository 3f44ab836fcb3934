"""`lagros attack`: what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands.attack import verdict
from lagros_benchmarks.commands.cli import app
from lagros_benchmarks.worst_case.replay import load_worst_cases, save_worst_cases

RUNNER = CliRunner()


def test_attack_writes_its_figures_and_flies_them_again(tmp_path: Path) -> None:
    figures, sequences = tmp_path / "worst.json", tmp_path / "worst.npz"
    options = ["--policy", "lqr", "--goal", "clearance", "--bound", "0.3", "--method", "random"]
    files = ["--json", str(figures), "--npz", str(sequences)]
    done = RUNNER.invoke(
        app, ["attack", "cartpole", "--episodes", "2", "--budget", "60", *options, *files]
    )
    assert done.exit_code == 0, done.output
    assert "goal clearance" in done.output
    row = json.loads(figures.read_text())
    assert done.stdout.splitlines()[0] == row["verdict"] == verdict(row)
    left = sum(not one["measures"]["in_region"] for one in row["outcomes"])
    assert f"{left} of 2 flights left the region of the metric" in done.output
    assert (row["task"], row["policy"], row["bound"]) == ("cartpole", "lqr", 0.3)
    assert len(row["outcomes"]) == len(row["random_outcomes"]) == 2
    assert row["score_worst"] == max(one["score"] for one in row["outcomes"])

    again = RUNNER.invoke(app, ["attack", "cartpole", "--replay", str(sequences)])
    assert again.exit_code == 0, again.output
    assert again.output.count("as stored") == 2

    cases = load_worst_cases(sequences)
    assert cases.outcomes[0].measures["certified_radius"] is None
    # Files of earlier versions hold what is claimed no longer; it is not compared.
    claiming = [
        replace(one, measures={**one.measures, "certified_radius": 9.0}) for one in cases.outcomes
    ]
    save_worst_cases(replace(cases, outcomes=tuple(claiming)), sequences)
    older = RUNNER.invoke(app, ["attack", "cartpole", "--replay", str(sequences)])
    assert older.exit_code == 0, older.output

    # A figure that the sequence does not give is found out.
    first = replace(cases.outcomes[0], score=cases.outcomes[0].score + 1e-12)
    save_worst_cases(replace(cases, outcomes=(first, *cases.outcomes[1:])), sequences)
    wrong = RUNNER.invoke(app, ["attack", "cartpole", "--replay", str(sequences)])
    assert wrong.exit_code == 1
    assert "1 of 2 differ" in wrong.output

    # So are pushes that the stated bound does not allow.
    save_worst_cases(replace(cases, pushes=1.01 * cases.pushes), sequences)
    outside = RUNNER.invoke(app, ["attack", "cartpole", "--replay", str(sequences)])
    assert outside.exit_code == 2
    assert "above the bound 0.3" in outside.output


def test_the_verdict_claims_what_the_figures_do_and_no_more() -> None:
    row = {
        "policy": "lqr",
        "safety_filter": True,
        "goal": "success",
        "bound": 0.3,
        "episodes": 7,
        "flights_per_episode": 90,
        "score_worst": 1.5,
        "random_score_worst": -2.0,
        "broken_rate": 3 / 7,
        "random_broken_rate": 1 / 7,
    }
    assert verdict(row) == (
        "lqr+filter is broken in 3 of 7 episodes by a disturbance within d̄ = 0.3 (90 flights for "
        "each), and in 1 by a random one."
    )
    kept = verdict(row | {"broken_rate": 0.0, "random_broken_rate": 0.0, "safety_filter": False})
    assert kept.startswith("lqr was not broken in any of 7 episodes by the search")
    assert kept.endswith("observed, and no proof.")
    # Random disturbance alone may break what the search did not.
    lucky = verdict(row | {"broken_rate": 0.0})
    assert "random" in lucky
    unsaid = verdict(row | {"goal": "return", "broken_rate": None, "random_broken_rate": None})
    assert "-1.5" in unsaid
    assert "2 under a random one" in unsaid
    for text in (verdict(row), kept, lucky, unsaid):
        assert "\n" not in text
        assert text.endswith(".")


POLICIES = """
import numpy as np


class Unbuilt:
    pass


class Single:
    def __init__(self, settings):
        pass

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.float32([observation[..., 1]]), state
"""


@pytest.mark.parametrize(
    ("name", "status", "message"),
    [
        ("Unbuilt", 1, "policy 'mine_only:Unbuilt' cannot be built: TypeError: "),
        ("Single", 2, "it must be (2, 1). A search flies many episodes at a time"),
    ],
)
def test_a_class_that_cannot_be_searched_is_explained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, status: int, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "mine_only.py").write_text(POLICIES)
    options = ["--policy", f"mine_only:{name}", "--episodes", "2", "--budget", "10"]
    done = RUNNER.invoke(app, ["attack", "cartpole", *options])
    assert done.exit_code == status, done.output
    assert message in done.output
    assert isinstance(done.exception, SystemExit)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["spacecraft", "--method", "cma"], "leave --method out"),
        (["cartpole", "--replay", "none.npz"], "there is no file none.npz"),
        (["canoe"], "unknown task 'canoe'"),
        (["cartpole", "--goal", "speed"], "goal='speed'"),
        (["cartpole", "--method", "annealing"], "method='annealing'"),
        (["cartpole", "--bound", "-1"], "bound=-1.0"),
        (["cartpole", "--safety-filter"], "for worlds of many agents"),
        (["spacecraft", "--policy", "lqr"], "unknown policy 'lqr'"),
        (["cartpole", "--replay", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_attack_says_what_is_wrong(options: list[str], message: str) -> None:
    done = RUNNER.invoke(app, ["attack", *options])
    assert done.exit_code == 2
    assert message in done.output
    assert "Traceback" not in done.output


def test_a_file_names_no_code_that_is_not_named_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fit = POLICIES.replace("np.float32([observation[..., 1]])", "observation[..., 1:2]")
    (tmp_path / "mine_of_a_file.py").write_text(fit)
    options = ["--episodes", "1", "--budget", "4", "--npz", "x.npz"]
    done = RUNNER.invoke(app, ["attack", "cartpole", "--policy", "mine_of_a_file:Single", *options])
    assert done.exit_code == 0, done.output
    # Whoever is given the file does not run what it names.
    sys.modules.pop("mine_of_a_file")
    (tmp_path / "mine_of_a_file.py").write_text("raise SystemError('ran')")
    refused = RUNNER.invoke(app, ["attack", "cartpole", "--replay", "x.npz"])
    assert refused.exit_code == 2
    assert "--policy mine_of_a_file:Single, if you trust it" in refused.output
