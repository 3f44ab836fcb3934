"""Paired episodes, intervals, tables, figures and the command line `lagros`.

`compare` puts policies beside each other on the same episodes, in one call. `BenchmarkSettings`
says in full what to run, `run_benchmark` runs it (with `kept_in` it goes on where it was killed),
and `summarise` turns the episodes into the rows of the published tables.
`lagros_benchmarks.commands` is the same from a terminal.
"""

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lagros_benchmarks.report.comparison import Comparison, compare
    from lagros_benchmarks.report.records import summarise
    from lagros_benchmarks.run.episodes import EpisodeRecord, run_episode
    from lagros_benchmarks.run.runner import BenchmarkRun, kept_in, run_benchmark
    from lagros_benchmarks.run.settings import BenchmarkSettings
    from lagros_policies.policy import Policy

__all__ = [
    "BenchmarkRun",
    "BenchmarkSettings",
    "Comparison",
    "EpisodeRecord",
    "Policy",
    "compare",
    "kept_in",
    "run_benchmark",
    "run_episode",
    "summarise",
]

_HOMES = {
    "BenchmarkRun": "lagros_benchmarks.run.experiment",
    "BenchmarkSettings": "lagros_benchmarks.run.settings",
    "Comparison": "lagros_benchmarks.report.comparison",
    "EpisodeRecord": "lagros_benchmarks.run.episodes",
    "Policy": "lagros_policies.policy",
    "compare": "lagros_benchmarks.report.comparison",
    "kept_in": "lagros_benchmarks.run.runner",
    "run_benchmark": "lagros_benchmarks.run.runner",
    "run_episode": "lagros_benchmarks.run.episodes",
    "summarise": "lagros_benchmarks.report.records",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for, and only that: `lagros --help` must not wait for SciPy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


class _OldNames:
    """Finds modules that have moved, where nobody else finds any; see `lagros_envs.aliases`."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> Any:
        """Return where a module of this package has moved to; None for any other."""
        if not name.startswith(f"{__name__}."):
            return None
        from lagros_benchmarks.tasks.moved import MOVED
        from lagros_envs.aliases import Moved

        return Moved(MOVED).find_spec(name)


sys.meta_path.append(_OldNames)
