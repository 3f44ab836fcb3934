"""Timing by turns, so that a busy moment of the machine meets every candidate alike."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
# Does the work of one round; the round's number says which of the prepared problems it is.
Candidate = Callable[[int], Any]


@dataclass(frozen=True)
class Scale:
    """How often everything is repeated.

    Attributes:
        steps: Control steps of the planned episodes.
        plans: Episodes whose plans are timed, one per round.
        episodes: Random episodes behind the share of solved plans.
        samples: Numbers of samples of the CV-STEM programs.
        designs: Rounds of these programs.
        rounds: Rounds of what takes microseconds.
        calls: Calls in a row in such a round.
        tracked_episodes: Episodes in which the tube MPC is timed.
        worlds: Worlds of the vectorised environments.
    """

    steps: int = 90
    plans: int = 100
    episodes: int = 1000
    samples: tuple[int, ...] = (50, 200)
    designs: int = 5
    rounds: int = 100
    calls: int = 100
    tracked_episodes: int = 20
    worlds: int = 1024


FULL = Scale()
QUICK = Scale(plans=15, episodes=200, samples=(50,), designs=2, rounds=20, tracked_episodes=4)


@dataclass(frozen=True)
class Times:
    """What one candidate took.

    Attributes:
        seconds: Time of one call, one entry per round [s].
        results: What the last call of each round returned.
        single: Whether each entry is one call and not the mean of several.
        cpu_seconds: Processor time of one call, over all threads [s]: what the clock would show if
            no other process ran. None where it was not measured.
    """

    seconds: FloatArray
    results: list[Any]
    single: bool = True
    cpu_seconds: FloatArray | None = None

    @property
    def median(self) -> float:
        """Median over the rounds [s]."""
        return float(np.median(self.seconds))

    @property
    def p99(self) -> float | None:
        """99th percentile of single calls [s]; None where too few calls were timed, or means."""
        enough = self.single and self.seconds.size >= 100
        return float(np.quantile(self.seconds, 0.99)) if enough else None

    def ratio_to(self, reference: Times) -> float:
        """Return how many times as long as the reference it took, the median over the rounds."""
        if self.seconds.size != reference.seconds.size:
            return self.median / reference.median
        return float(np.median(self.seconds / reference.seconds))


def interleave(
    candidates: Mapping[str, Candidate], rounds: int, calls: int = 1, warm_up: bool = True
) -> dict[str, Times]:
    """Time candidates by turns: A B A B ...

    Args:
        candidates: What to time; each is called with the number of the round.
        rounds: Rounds.
        calls: Calls of one candidate in a row; one round gives their mean.
        warm_up: Whether to begin with one round that does not count.

    Returns:
        The times of each candidate.
    """
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    cpu_seconds: dict[str, list[float]] = {name: [] for name in candidates}
    results: dict[str, list[Any]] = {name: [] for name in candidates}
    if warm_up:
        for candidate in candidates.values():
            candidate(0)
    clock, cpu_clock = time.perf_counter, time.process_time
    gc.collect()
    # As in timeit: the collector would charge one candidate for the litter of another.
    gc.disable()
    try:
        for index in range(rounds):
            for name, candidate in candidates.items():
                cpu_begun, begun = cpu_clock(), clock()
                for _ in range(calls):
                    result = candidate(index)
                seconds[name].append((clock() - begun) / calls)
                cpu_seconds[name].append((cpu_clock() - cpu_begun) / calls)
                results[name].append(result)
    finally:
        gc.enable()
    return {
        name: Times(
            np.asarray(seconds[name]), results[name], calls == 1, np.asarray(cpu_seconds[name])
        )
        for name in candidates
    }
