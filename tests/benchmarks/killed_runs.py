"""Runs a small benchmark again and again, and kills it each time at a later moment.

Run as a program with the folder of the chunks, so that the interpreter starts once for all moments:
each run is a child process of its own.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lagros_benchmarks.run.runner import kept_in, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs import files
from tests.benchmarks import fakes, spacecraft_fakes

CARTPOLE = BenchmarkSettings(policies=("steady", "drawing", "raising"), episodes=6, chunk=2)
SPACECRAFT = BenchmarkSettings.for_task(
    "spacecraft",
    policies=("spring", "idle"),
    episodes=4,
    chunk=1,
    bounds=(0.4,),
    agents=(2,),
    safety_filter="none",
    timing_episodes=1,
)
RUNS = {"cartpole": (CARTPOLE, fakes.EASY), "spacecraft": (SPACECRAFT, spacecraft_fakes.TOOLBOX)}
# Calls after which a run is killed: of the function that puts a written file in its place (before
# and after it does), and of the progress.
MOMENTS = [(moment, count) for count in (1, 2, 1) for moment in ("before", "after", "progress")]
MOMENTS.append(("progress", 2))


def run(task: str, folder: Path) -> Any:
    """Run a benchmark in this process."""
    settings, toolbox = RUNS[task]
    return run_benchmark(settings, toolbox, kept=kept_in(folder, settings, toolbox))


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _killed(task: str, folder: Path, moment: str, count: int) -> None:
    settings, toolbox = RUNS[task]
    seen = 0
    replace: Callable[..., None] = os.replace

    def counted() -> bool:
        nonlocal seen
        seen += 1
        return seen == count

    def patched(*paths: Any) -> None:
        last = counted()
        if last and moment == "before":
            _die()
        replace(*paths)
        if last:
            _die()

    if moment != "progress":
        files.os.replace = patched  # type: ignore[attr-defined]
    kept = kept_in(folder, settings, toolbox)
    told = None if moment != "progress" else lambda *_: _die() if counted() else None
    run_benchmark(settings, toolbox, told, kept)


def main(task: str, folder: Path) -> None:
    """Kill the run at all moments, one after the other, and print how each child ended."""
    for moment, count in MOMENTS:
        child = os.fork()
        if child == 0:
            try:
                _killed(task, folder, moment, count)
            finally:
                os._exit(0)
        sys.stdout.write(f"{os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\n")
        sys.stdout.flush()  # or the next child would write it once more


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
