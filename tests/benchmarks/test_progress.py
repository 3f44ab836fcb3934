"""Progress: from nothing to all, with the time left, and seen by nobody who did not ask."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from lagros_benchmarks.commands.terminal import progress_bar
from lagros_benchmarks.evidence.single import Question
from lagros_benchmarks.run.keeping import Kept
from lagros_benchmarks.run.room import room_of
from lagros_benchmarks.run.workers import gather
from lagros_benchmarks.worst_case.attack import AttackSettings, run_attack
from lagros_benchmarks.worst_case.search import SearchSettings
from lagros_envs.registry import find_task

ROOT = Path(__file__).parents[2]


class Told:
    """What a command told, by title."""

    def __init__(self) -> None:
        self.lines: dict[str, list[tuple[int, int]]] = defaultdict(list)

    def __call__(self, title: str, done: int, total: int) -> None:
        self.lines[title].append((done, total))

    def check(self) -> None:
        """Check that each thing begins at nothing, never goes back, and ends whole."""
        assert self.lines
        for title, lines in self.lines.items():
            dones, totals = zip(*lines, strict=True)
            assert dones[0] == 0, title
            assert list(dones) == sorted(dones), title
            assert dones[-1] == totals[-1], title
            assert len(set(totals)) == 1, title


def square(value: int) -> int:
    return value * value


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_item_is_told_whatever_the_jobs(jobs: int) -> None:
    told = Told()
    assert gather("squares", square, range(7), jobs, told) == [n * n for n in range(7)]
    assert told.lines == {"squares": [(done, 7) for done in range(8)]}


def test_who_goes_on_begins_with_what_is_kept(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "run", "key")
    kept.add("squares", 2, 4)
    told = Told()
    assert gather("squares", square, range(3), 1, told, keeper=kept) == [0, 1, 4]
    assert told.lines["squares"] == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize(
    ("task", "policy", "method"),
    [
        ("cartpole", "lqr", "hybrid"),
        ("cartpole", "lqr", "random"),
        ("pvtol", "tube-mpc", "gradient"),
        ("spacecraft", "lagros", "hybrid"),
        ("gym:Pendulum-v1", "mine:Still", "random"),
    ],
)
def test_an_attack_tells_how_far_it_is(
    task: str, policy: str, method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text(
        "import numpy as np\nclass Still:\n    def __init__(self, env):\n        pass\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):\n"
        "        return np.zeros((*observation.shape[:-1], 1), np.float32), state\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    told, search = Told(), SearchSettings(method, budget=40, population=10, restarts=2)
    goal = {"goal": "return"} if ":" in task else {"goal": "success"}
    settings: dict[str, Any] = {"bound": 0.3, "episodes": 2, "search": search, **goal}
    run_attack(AttackSettings(task, policy, **settings), told)
    told.check()
    assert {"prepare", "replay"} < set(told.lines)


@pytest.mark.parametrize(
    ("task", "policy", "bound"),
    [
        ("cartpole", "tube-mpc", 0.1),
        ("cartpole", "tube-mpc", 0.6),
        ("cartpole", "lqr", 0.1),
        ("spacecraft", "lagros", 0.4),
        ("spacecraft", "centralized", 0.2),
    ],
)
def test_a_certificate_tells_how_far_it_is(task: str, policy: str, bound: float) -> None:
    told, described = Told(), find_task(task)
    room_of(described).part("certify")(described, Question(policy, bound, 2, seconds=1.0), told)
    told.check()


def drawn(console: Console, wanted: str) -> bool:
    """Return whether something comes to stand on a terminal, which is drawn by another thread."""
    assert isinstance(console.file, io.StringIO)
    for _ in range(100):
        if wanted in console.file.getvalue():
            return True
        time.sleep(0.05)
    return False


def test_the_time_left_is_drawn_of_chunks_that_take_minutes() -> None:
    now = [0.0]
    console = Console(file=io.StringIO(), force_terminal=True, width=100, get_time=lambda: now[0])
    with progress_bar(console) as tell:
        tell("episodes", 0, 12)
        for done in (1, 2, 3):
            now[0] += 120.0
            tell("episodes", done, 12)
        # Nine chunks of two minutes each.
        assert drawn(console, "3/12")
        assert drawn(console, "0:18:00")


def test_nothing_is_drawn_where_there_is_no_terminal() -> None:
    console = Console(file=io.StringIO(), force_terminal=False)
    with progress_bar(console) as tell:
        tell("episodes", 1, 2)
    assert console.file.getvalue() == ""  # type: ignore[attr-defined]


@pytest.mark.skipif(sys.platform == "win32", reason="it has no pseudo-terminals of this kind")
@pytest.mark.parametrize(("options", "seen"), [((), True), (("--quiet",), False)])
def test_a_command_draws_on_a_terminal_unless_it_is_to_be_quiet(
    options: tuple[str, ...], seen: bool, tmp_path: Path
) -> None:
    command = (sys.executable, "-m", "lagros_benchmarks", "check", "docking", "--episodes", "1")
    ours, theirs = os.openpty()
    env = {name: value for name, value in os.environ.items() if name not in ("TERM", "NO_COLOR")}
    with os.fdopen(ours, "rb", buffering=0) as screen:
        process = subprocess.run(
            (*command, *options),
            cwd=tmp_path,
            env=env | {"TERM": "xterm"},
            stdout=subprocess.PIPE,
            stderr=theirs,
            check=True,
        )
        os.close(theirs)
        try:
            text = screen.read(100_000)
        except OSError:  # how Linux says that nothing was written, and nobody writes
            text = b""
    assert b"docking" in process.stdout
    assert (b"looks" in text) == seen
