"""All systems x all policies: paired, resumable, merged; and what the page says of the rows."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.report.suite_figure import suite_figure
from lagros_benchmarks.report.suite_page import page_text, printed_tables
from lagros_benchmarks.report.suite_rows import MEASURES, System
from lagros_benchmarks.run.single import SingleExperiment
from lagros_benchmarks.run.suite import SuiteSettings, flyable
from lagros_benchmarks.run.suite_worst import searched, worst_of
from lagros_benchmarks.worst_case.attack import AttackSettings
from lagros_envs.registry import find_task

TOYS = Path(__file__).parent / "toys.py"
POLICIES = "tube-mpc,lqr,sd-lqr,ppo"
SUITE = ["--policies", POLICIES, "--episodes", "3", "--fewer", "lqr=2", "--proved", "1"]
SUITE += ["--seed", "4", "--initial-error", "0.05", "--worst", "2", "--worst-flights", "20"]


def invoke(*words: str):
    result = CliRunner().invoke(cli.app, list(words))
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture(scope="module")
def slide(tmp_path_factory):
    """A task in a file that lies alone: what lies beside it decides what a run is known by, too."""
    place = tmp_path_factory.mktemp("task") / "toys.py"
    # Under a name of its own: the toys themselves may be known already.
    text = TOYS.read_text(encoding="utf-8")
    place.write_text(text.replace("slider", "lone").replace("Slider", "Lone"), encoding="utf-8")
    return f"{place}:Slide"


@pytest.fixture(scope="module")
def flown(tmp_path_factory, slide):
    """A suite of one task and its files."""
    out = tmp_path_factory.mktemp("suite")
    invoke("suite", slide, *SUITE, "--out", str(out))
    return out, json.loads((out / "suite.json").read_text())


def test_the_rows_are_those_of_the_benchmark(flown, slide, tmp_path):
    out, result = flown
    assert (out / "all.png").stat().st_size > 1000
    path = tmp_path / "rows.json"
    words = ["--policies", "tube-mpc,sd-lqr", "--episodes", "3", "--seed", "4"]
    words += ["--disturbance", "uniform,constant", "--bound", "0.1"]
    for error in ("0", "0.05"):
        invoke("bench", slide, *words, "--initial-error", error, "--json", str(path))
        for row in json.loads(path.read_text()):
            (ours,) = (
                one
                for one in result["rows"]
                if (one["policy"], one["disturbance"], one["initial_error"], one["guarantee"])
                == (row["policy"], row["disturbance"], float(error), False)
            )
            for name in ("success_rate", "effort_mean", "error_area_mean", "versus", "episodes"):
                assert ours[name] == row[name]
            assert "mean_tracking_error" not in ours


def test_every_condition_is_there_and_what_is_missing_is_said(flown):
    _, result = flown
    conditions = {
        (row["policy"], row["disturbance"], row["initial_error"], row["episodes"])
        for row in result["rows"]
        if not row["guarantee"]
    }
    assert conditions == {
        (policy, kind, error, 2 if policy == "lqr" else 3)
        for policy in ("tube-mpc", "lqr", "sd-lqr")
        for kind in ("uniform", "constant")
        for error in (0.0, 0.05)
    }
    proved = [row for row in result["rows"] if row["guarantee"]]
    assert [(row["policy"], row["episodes"]) for row in proved] == [("tube-mpc", 1)]
    ((task, policy, reason),) = result["missing"]
    assert (task, policy) == ("lone", "ppo")
    assert reason == "not trained"


def test_the_page_has_a_line_for_every_policy(flown):
    out, _ = flown
    text = (out / "all.md").read_text()
    section = text.partition("### lone")[2]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    assert [line.split("|")[1].strip() for line in lines[2:]] == [
        "(b) tube-mpc",
        "sd-lqr",
        "lqr",
        "ppo",
    ]
    assert len({line.count("|") for line in lines}) == 1
    assert "Not flown: ppo (not trained)." in section
    assert "3 paired episodes (lqr 2)" in text
    # Without one of the rivals nothing is claimed.
    assert "not all of them flew lone" in text


def test_what_is_found_worst_is_what_lagros_attack_finds(flown, slide, tmp_path):
    out, result = flown
    assert [(row["policy"], row["goal"]) for row in result["worst"]] == [
        (policy, goal) for policy in ("tube-mpc", "lqr", "sd-lqr") for goal in ("success", "error")
    ]
    path = tmp_path / "attack.json"
    words = ["--episodes", "2", "--budget", "20", "--seed", "4", "--json", str(path)]
    for row in result["worst"]:
        assert row["refused"] is None
        if row["policy"] == "tube-mpc":
            invoke("attack", slide, "--policy", "tube-mpc", "--goal", row["goal"], *words)
            found = json.loads(path.read_text())
            assert row["success_rate"] == 1.0 - found["broken_rate"]
            assert row["error_per_bound"] == found["max_tracking_error_per_bound"]
            assert row["scores"] == [one["score"] for one in found["outcomes"]]
    text = (out / "all.md").read_text()
    assert "Success [%] of 2 episodes under the worst disturbance" in text
    assert "budget of 20 flights each" in text
    for policy in ("tube-mpc", "lqr"):
        assert f"{policy} {_mean_worst(result, policy):.0f} %" in text.partition("## ")[0]


def _mean_worst(result, policy):
    rows = [row for row in result["worst"] if (row["policy"], row["goal"]) == (policy, "success")]
    return 100.0 * sum(row["success_rate"] for row in rows) / len(rows)


def test_a_policy_with_a_memory_is_not_searched_and_it_is_said(slide):
    row = searched(AttackSettings.for_task(slide, "hybrid", 20, policy="mpc", episodes=1))
    assert "keeps a memory" in row["refused"]
    assert worst_of([row], row["task"], "mpc", "success") is None


@pytest.mark.parametrize("count", [1, 7, 11])
def test_what_is_printed_fits_a_terminal_and_leaves_no_system_out(count):
    rows, searches = [], []
    names = [f"system-x{chr(97 + index)}" for index in range(count)]
    for name in names:
        for policy in ("tube-mpc", "lqr-plan"):
            rows += [made_up(policy, *key, {}) | {"task": name} for key in _keys()]
            for goal in ("success", "error"):
                figures = {"success_rate": 0.4, "error_per_bound": 12.34, "refused": None}
                searches.append({"task": name, "policy": policy, "goal": goal, **figures})
    settings = {"disturbances": ["uniform", "constant"]}
    printed = list(printed_tables({"rows": rows, "worst": searches, "settings": settings}))
    assert len({title for title, _ in printed}) == 2
    console = Console(width=300, file=io.StringIO())
    for _, table in printed:
        console.print(table)
    text = console.file.getvalue()
    assert max(map(len, map(str.rstrip, text.splitlines()))) <= 80
    assert all(text.count(name.partition("-")[2]) == 2 for name in names)
    assert text.count("100/100") == text.count("40, 12.3") == 2 * count


def test_it_goes_on_where_it_was_and_is_drawn_again_without_flying(flown, slide, monkeypatch):
    out, result = flown

    def never(*_):
        raise AssertionError("it flies again")

    monkeypatch.setattr(SingleExperiment, "play", never)
    invoke("suite", slide, *SUITE, "--out", str(out))
    again = json.loads((out / "suite.json").read_text())
    assert again["rows"] == result["rows"]
    (out / "all.md").unlink()
    invoke("suite", "--from", str(out / "suite.json"), "--out", str(out))
    assert (out / "all.md").read_text().startswith("# All systems, all policies\n\nIs the ")
    assert json.loads((out / "suite.json").read_text())["rows"] == result["rows"]
    # A task that is named takes the place of its rows, and the settings are those of the file.
    invoke("suite", slide, "--from", str(out / "suite.json"), "--out", str(out))
    merged = json.loads((out / "suite.json").read_text())
    assert merged["rows"] == result["rows"]
    assert merged["missing"] == result["missing"]
    assert merged["settings"] == result["settings"]
    refused = CliRunner().invoke(
        cli.app, ["suite", "--from", str(out / "suite.json"), "--episodes", "3"]
    )
    assert refused.exit_code == 2
    assert "--from says what the suite is" in refused.output


def made_up(policy, kind, beside, ratios):
    """Return a row with paired ratios to other policies and intervals of a tenth around them."""
    versus = {
        rival: {
            "error_area_ratio": ratio,
            "error_area_ratio_ci95": [0.9 * ratio, 1.1 * ratio],
            "overshoot_ratio": ratio,
            "overshoot_ratio_ci95": [0.9 * ratio, 1.1 * ratio],
        }
        for rival, ratio in ratios.items()
    }
    return {
        "task": "toy",
        "policy": policy,
        "disturbance": kind,
        "initial_error": beside,
        "guarantee": False,
        "bound": 0.5,
        "versus": versus,
        "errors": [],
        "episodes": 9,
        "success_rate": 1.0,
        "success_ci95": [0.7, 1.0],
        "strict_success_rate": 0.5,
        "error_area_mean": 2.0,
        "error_area_ci95": None,
        "normalised_area_mean": 3.0,
        "overshoot_mean": 1.5,
        "envelope_overshoot": 2.0,
        "convergence_rate_mean": 0.3,
        "effort_mean": 1.0,
        "step_time_median_s": 1e-4,
        "safety_filter": False,
    }


def test_ahead_is_a_whole_interval_below_one_under_every_kind_and_of_every_rival():
    ratios = {"c3m": 0.8, "sd-lqr": 0.95, "lqr": 0.1}
    rows = [
        made_up("tube-mpc", kind, beside, ratios)
        for kind in ("uniform", "constant")
        for beside in (0.0, 0.2)
    ]
    system = System(rows)
    for measure in MEASURES:
        assert system.ahead(measure, "tube-mpc", "c3m") is True
        assert system.ahead(measure, "tube-mpc", "sd-lqr") is False
        assert system.ahead(measure, "tube-mpc", "mpc") is None
        assert system.ahead(measure, "lagros", "c3m") is None
    rows[-1] = made_up("tube-mpc", "constant", 0.2, ratios | {"c3m": 0.92})
    assert System(rows).ahead(MEASURES[0], "tube-mpc", "c3m") is True
    assert System(rows).ahead(MEASURES[1], "tube-mpc", "c3m") is False
    assert System(rows).ahead(MEASURES[1], "tube-mpc", "c3m", "uniform") is True
    assert System(rows).ahead(MEASURES[1], "tube-mpc", "c3m", "constant") is False
    best = [made_up("lagros", *key, {**ratios, "sd-lqr": 0.5}) for key in _keys()]
    settings = {"episodes": 9, "fewer": {}, "disturbances": ["uniform", "constant"], "jobs": 1}
    settings |= {"worst_flights": 20}
    result = {
        "rows": [*rows, *best],
        "missing": [],
        "worst": [],
        "command": "lagros suite",
        "settings": settings | {"initial_error": 0.2},
        "machine": {"processor": "a processor", "platform": ""},
    }
    text = page_text(result, Path("all.md"), None)
    assert "- of c3m, sd-lqr, lqr together: on 1 of 1 (toy)" in text
    assert "- of sd-lqr alone: on 1 of 1 (toy)" in text
    assert "**0.500 (0.450–0.550)**" in text
    assert "0.950 (0.855–1.04)" in text


def _keys():
    return [(kind, beside) for kind in ("uniform", "constant") for beside in (0.0, 0.2)]


def test_what_cannot_be_flown_is_refused_or_said_to_be_missing(slide):
    with pytest.raises(ValueError, match="unknown policy 'nonsense'"):
        SuiteSettings(tasks=(slide,), policies=("lqr", "nonsense"))
    with pytest.raises(ValueError, match="names lqr twice"):
        SuiteSettings(tasks=(slide,), policies=("lqr", "lqr"))
    with pytest.raises(ValueError, match="fewer=mpc=7"):
        SuiteSettings(tasks=(slide,), episodes=6, fewer={"mpc": 7})
    there, missing = flyable(find_task(slide), ("lqr", "tube-mpc:least-norm"))
    assert there == ("lqr",)
    assert missing[0].policy == "tube-mpc:least-norm"
    with pytest.raises(ValueError, match="needs a system of one body"):
        suite_figure([], None)
