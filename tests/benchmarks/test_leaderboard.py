"""A submission to the leaderboard is as it should be, or is refused in a sentence."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands.cli import app
from lagros_benchmarks.report import leaderboard
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run.files import json_text
from lagros_benchmarks.run.metrics import wilson_interval
from lagros_benchmarks.run.runner import run_benchmark
from lagros_envs.registry import find_task
from lagros_envs.seeding import EVALUATION, episode_seeds

NAME = "2026-12-01_some-body.json"
ROOT = Path(__file__).parents[2]
BOARD = sorted((ROOT / "benchmarks" / "leaderboard").glob("*.json"))
Rows = list[dict[str, Any]]


@pytest.fixture(scope="module")
def flown() -> Rows:
    """Rows of four episodes, as `lagros bench` writes them; everybody flies four here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(leaderboard, "EPISODES", 4)
        settings = leaderboard.settings_of(find_task("cartpole"), ["lqr", "learned"])
    rows = summarise(run_benchmark(settings), ["lagros", "bench", "cartpole"])
    found: Rows = json.loads(json_text(rows))
    return found


@pytest.fixture
def rows(flown: Rows, monkeypatch: pytest.MonkeyPatch) -> Rows:
    monkeypatch.setattr(leaderboard, "EPISODES", 4)
    return deepcopy(flown)


def written(folder: Path, rows: object, name: str = NAME) -> Path:
    path = folder / name
    path.write_text(rows if isinstance(rows, str) else json.dumps(rows), encoding="utf-8")
    return path


def run(*words: object) -> Any:
    return CliRunner().invoke(app, ["leaderboard", *map(str, words)])


def test_what_the_benchmark_writes_is_as_it_should_be(rows: Rows, tmp_path: Path) -> None:
    path = written(tmp_path, rows)
    found = leaderboard.read_submission(path)
    assert (found.who, found.when.isoformat(), found.code) == ("some-body", "2026-12-01", [])
    assert len(found.rows) == 4
    done = run(path, "--rerun", "2", "--markdown", tmp_path / "board.md")
    assert done.exit_code == 0, done.output
    assert (
        f"{NAME}: as it should be, 4 rows; 8 flights flown again, 0 ended otherwise" in done.output
    )
    text = (tmp_path / "board.md").read_text(encoding="utf-8")
    # The best first: of constant disturbance the strict successes.
    pushed = [row for row in rows if row["disturbance"] == "constant"]
    rates = {row["policy"]: row["strict_success_rate"] for row in pushed}
    assert rates["lqr"] > rates["learned"]
    assert text.index("| lqr |") < text.index("learned |")
    assert text.count("| some-body |") == 2


def test_seeds_are_those_of_evaluation_and_outcomes_those_of_the_episodes(
    rows: Rows,
) -> None:
    settings = leaderboard.settings_of(find_task("cartpole"), ["lqr", "learned"])
    assert settings.episode_seeds() == episode_seeds(0, 4, EVALUATION)
    for row in rows:
        outcomes = row["evidence"]["outcomes"]
        assert len(outcomes) == 4
        assert sum(one in "12" for one in outcomes) == round(4 * row["success_rate"])
        assert outcomes.count("2") == round(4 * row["strict_success_rate"])
    weights = {row["policy"]: row["evidence"]["policy_sha256"] for row in rows}
    assert weights["lqr"] is None
    assert len(str(weights["learned"])) == 64


def put(*path: Any, value: Any) -> Callable[[Rows], object]:
    """Return the forgery that puts a value at a place in the rows."""

    def forge(rows: Rows) -> object:
        place: Any = rows
        for name in path[:-1]:
            place = place[name]
        place[path[-1]] = value
        return rows

    return forge


def better(rows: Rows) -> object:
    """Success with the rates and intervals to it, and not the outcomes and comparisons."""
    row = next(row for row in rows if row["success_rate"] < 1.0)
    for name in ("success", "strict_success"):
        row[f"{name}_rate"], row[f"{name}_ci95"] = 1.0, list(wilson_interval(4, 4))
    return rows


def better_throughout(rows: Rows) -> object:
    """And the outcomes with them."""
    row = next(row for row in rows if row["success_rate"] < 1.0)
    row["evidence"]["outcomes"] = "2222"
    return better(rows)


def without(name: str) -> Callable[[Rows], object]:
    def forge(rows: Rows) -> object:
        del rows[1][name]
        return rows

    return forge


FORGED: dict[str, tuple[Callable[[Rows], object], str]] = {
    "another seed": (put(0, "seed", value=7), "'seed' is 7"),
    "other episodes": (put(1, "evidence", "seeds_sha256", value="0" * 64), "not those of --seed 0"),
    "fewer episodes": (put(0, "episodes", value=3), "'episodes' is 3"),
    "true for one": (put(0, "seed", value=False), "'seed' is False"),
    "missing outcomes": (put(2, "evidence", "outcomes", value="222"), "must be 4 figures"),
    "strange outcomes": (put(2, "evidence", "outcomes", value="22x2"), "must be 4 figures"),
    "edited success": (put(0, "success_rate", value=0.999), "by its outcomes"),
    "edited interval": (put(0, "strict_success_ci95", value=[0.9, 1.0]), "by its outcomes"),
    "success without outcomes": (better, "by its outcomes"),
    "success without comparisons": (better_throughout, "success beside"),
    "a smaller bound": (put(3, "bound", value=0.1), "'bound' is 0.1"),
    "a better kind": (put(0, "disturbance", value="none"), "fly --disturbance"),
    "channels": (put(0, "channels", value="rates"), "'channels'"),
    "another version": (put(0, "versions", "lagros", value="0.0.1"), "fly it again"),
    "other weights": (
        lambda rows: [
            row["evidence"].update(policy_sha256="0" * 64) or row  # type: ignore[func-returns-value]
            for row in rows
        ],
        "other weights",
    ),
    "no weights": (put(0, "policy", value="mine:Mine"), "has no hash of its file"),
    "another task": (put(0, "task", value="../../etc"), "is no task of lagros"),
    "a task of one's own": (put(0, "task", value="./mine.py"), "is no task of lagros"),
    "a policy with two lines": (put(0, "policy", value="a\nb"), "is no name of a policy"),
    "another command": (put(0, "command", value="rm -rf /"), "not `lagros bench`"),
    "one kind only": (
        lambda rows: [row for row in rows if row["disturbance"] == "uniform"],
        "has not flown under 'constant'",
    ),
    "twice": (lambda rows: [*rows, rows[0]], "in the file twice"),
    "raised in silence": (put(0, "raised", value=1), "not the number of its 'errors'"),
    "an error elsewhere": (
        lambda rows: [row | {"raised": 1, "errors": [{"seed": 3, "text": "x"}]} for row in rows],
        "of the seed 3",
    ),
    "no effort": (put(0, "effort_mean", value=-1.0), "'effort_mean' cannot be"),
    "effort as text": (put(0, "effort_mean", value="0"), "must be a number"),
    "edited effort": (put(0, "effort_mean", value=1.0), "outside its own interval"),
    "unknown effort": (put(0, "effort_mean", value=None), "not every episode raised"),
    "no time": (put(0, "step_time_median_s", value=0.0), "'step_time_median_s' cannot be"),
    "no evidence": (without("evidence"), "'evidence'"),
    "no comparison": (without("versus"), "'versus'"),
    "NaN": (lambda rows: json.dumps(rows).replace('"seed": 0', '"seed": NaN', 1), "not finite"),
    "a number too large": (
        lambda rows: json.dumps(rows).replace('"seed": 0', '"seed": 1e999', 1),
        "not finite or too large",
    ),
    "a name twice": (
        lambda rows: json.dumps(rows).replace('"seed": 0', '"seed": 7, "seed": 0', 1),
        "states 'seed' twice",
    ),
    "no list": (lambda rows: {"rows": rows}, "no list of 1 to 1000 rows"),
    "nothing": (lambda rows: [], "no list of 1 to 1000 rows"),
    "too many": (lambda rows: [1] * 1001, "no list of 1 to 1000 rows"),
    "no objects": (lambda rows: [1], "row 1"),
    "half a file": (
        lambda rows: json.dumps(rows)[:1000],
        "is not what `lagros bench --json` writes",
    ),
    "depth": (lambda rows: "[" * 100_000, "nested too deeply"),
    "a pickle": (
        lambda rows: "cos\nsystem\n(S'true'\ntR.",
        "is not what `lagros bench --json` writes",
    ),
}


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_submission_is_refused_and_said_why(name: str, rows: Rows, tmp_path: Path) -> None:
    forge, message = FORGED[name]
    path = written(tmp_path, forge(rows))
    with pytest.raises(ValueError, match=r".") as raised:
        leaderboard.read_submission(path)
    text = str(raised.value)
    assert message in text
    assert len(text.splitlines()) == 1
    done = run(path)
    assert done.exit_code == 1
    assert "refused: " in done.output
    assert "as it should be" not in done.output


def test_a_file_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / NAME
    with path.open("wb") as stream:
        os.truncate(stream.fileno(), 1 << 30)
    with pytest.raises(ValueError, match="bytes that are read"):
        leaderboard.read_submission(path)


@pytest.mark.parametrize(
    "name",
    [
        "mine.json",
        "2026-13-01_me.json",
        "2026-01-01_.json",
        "2026-01-01_a b.json",
        "2026-1-1_me.json",
    ],
)
def test_the_name_of_a_file_says_when_and_who(name: str, rows: Rows, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="neither when nor who"):
        leaderboard.read_submission(written(tmp_path, rows, name))


def test_a_forgery_that_agrees_with_itself_is_found_by_flying(rows: Rows, tmp_path: Path) -> None:
    better_throughout(rows)
    rates = {(row["policy"], row["disturbance"]): row["success_rate"] for row in rows}
    for row in rows:
        for other, said in row["versus"].items():
            said["success_difference"] = row["success_rate"] - rates[other, row["disturbance"]]
    path = written(tmp_path, rows)
    found = leaderboard.read_submission(path)
    with pytest.raises(ValueError, match=r"flown again .* end otherwise than it says"):
        leaderboard.fly_again(found, 4)
    done = run(path, "--rerun", "4")
    assert done.exit_code == 1
    assert "end otherwise" in done.output


MINE = """
import numpy as np
from pathlib import Path

Path({mark!r}).touch()

class Mine:
    def __init__(self, settings):
        pass
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((*observation.shape[:-1], 1), np.float32), state
"""


def test_code_of_a_submission_runs_only_where_it_is_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leaderboard, "EPISODES", 2)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    mark = tmp_path / "ran"
    (tmp_path / "handed_in.py").write_text(MINE.format(mark=str(mark)), encoding="utf-8")
    settings = leaderboard.settings_of(find_task("cartpole"), ["handed_in:Mine"])
    rows = summarise(run_benchmark(settings), ["lagros", "bench", "cartpole"])
    path = written(tmp_path, json_text(rows))
    monkeypatch.delitem(__import__("sys").modules, "handed_in")
    mark.unlink()

    assert run(path).exit_code == 0
    refused = run(path, "--rerun", "1")
    assert refused.exit_code == 1
    assert "--trust handed_in:Mine" in refused.output
    assert not mark.exists()

    done = run(path, "--rerun", "1", "--trust", "handed_in:Mine")
    assert done.exit_code == 0, done.output
    assert "2 flights flown again, 0 ended otherwise" in done.output
    assert mark.exists()

    # Another file under the same name is another policy.
    with (tmp_path / "handed_in.py").open("a") as stream:
        stream.write("# better now\n")
    other = run(path, "--rerun", "1", "--trust", "handed_in:Mine")
    assert other.exit_code == 1
    assert "has another file here" in other.output


def test_worlds_of_agents_are_submitted_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leaderboard, "WORLDS", 2)
    settings = leaderboard.settings_of(
        find_task("spacecraft"), ["lagros"], safety_filter="both", timing_episodes=1
    )
    rows = summarise(run_benchmark(settings), ["lagros", "bench", "spacecraft"])
    found = leaderboard.read_submission(written(tmp_path, json_text(rows)))
    assert [len(row["evidence"]["outcomes"]) for row in found.rows] == [12] * 4
    text = leaderboard.table([found])
    assert text.count("| some-body |") == 2
    assert "\\+ filter" in text


@pytest.mark.parametrize("path", BOARD, ids=lambda path: path.stem)
def test_what_is_on_the_board_is_as_it_should_be(path: Path) -> None:
    assert leaderboard.read_submission(path)
