"""What a task brings to the runner, and what every run leaves behind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from lagros_benchmarks.run.keeping import Kept
from lagros_benchmarks.run.settings import BenchmarkSettings, Case
from lagros_benchmarks.run.workers import Progress

__all__ = ["BenchmarkRun", "Experiment", "Progress", "Row"]

# One object of the published results: what a policy did under one condition.
Row = dict[str, Any]


@dataclass(frozen=True)
class BenchmarkRun:
    """All episodes of a benchmark; each task adds what its rows need.

    Attributes:
        settings: What was run.
        episodes: Records of each case, in the order of the seeds.
        timing: What the serial timing pass measured; `episodes` where those were timed themselves.
        control_period: Deadline of a control step [s].
    """

    settings: BenchmarkSettings
    episodes: Mapping[Case, Sequence[Any]]
    timing: Mapping[Case, Sequence[Any]]
    control_period: float


class Experiment(Protocol):
    """The part of a benchmark that depends on its task. It travels to the worker processes.

    A unit is what an episode is begun with: its seed, and a plan where the task has one. Whatever a
    policy raises in an episode is part of the outcome and is never raised here.
    """

    @property
    def timed_apart(self) -> bool:
        """Whether the step times need a serial pass of their own."""
        ...

    def units(self, progress: Progress | None, keeper: Kept | None = None) -> list[Any]:
        """Return one unit per episode, the same for every case; see `gather` for the keeper."""
        ...

    def play(self, case: Case, units: Sequence[Any]) -> Any:
        """Run a chunk of episodes and return its outcome."""
        ...

    def time(self, case: Case, units: Sequence[Any]) -> Any:
        """Measure the step times over the first episodes, alone on the machine."""
        ...

    def finish(
        self,
        units: Sequence[Any],
        outcomes: Mapping[Case, Sequence[Any]],
        timing: Mapping[Case, Any] | None,
    ) -> BenchmarkRun:
        """Put the run together; `timing` is what `time` returned of each case, if asked."""
        ...
