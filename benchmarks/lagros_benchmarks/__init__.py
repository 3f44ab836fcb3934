"""Paired episodes, intervals, tables, figures and the command line `lagros`.

`BenchmarkSettings` says what to run, `run_benchmark` runs it, with policies that are built by their
names or are objects of your own (with `kept_in` it goes on where it was killed), and `summarise`
turns the episodes into the rows of the published tables. `lagros_benchmarks.commands` is the same
from a terminal.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lagros_benchmarks.report.records import summarise
    from lagros_benchmarks.run.episodes import EpisodeRecord, run_episode
    from lagros_benchmarks.run.library import Policy
    from lagros_benchmarks.run.runner import BenchmarkRun, kept_in, run_benchmark
    from lagros_benchmarks.run.settings import BenchmarkSettings

__all__ = [
    "BenchmarkRun",
    "BenchmarkSettings",
    "EpisodeRecord",
    "Policy",
    "kept_in",
    "run_benchmark",
    "run_episode",
    "summarise",
]

_HOMES = {
    "BenchmarkRun": "run.runner",
    "BenchmarkSettings": "run.settings",
    "EpisodeRecord": "run.episodes",
    "Policy": "run.library",
    "kept_in": "run.runner",
    "run_benchmark": "run.runner",
    "run_episode": "run.episodes",
    "summarise": "report.records",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for, and only that: `lagros --help` must not wait for SciPy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
