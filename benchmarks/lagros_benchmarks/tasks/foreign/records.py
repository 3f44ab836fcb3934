"""From episodes of an environment of somebody else's to the rows of a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict

import numpy as np

from lagros_benchmarks.run.experiment import BenchmarkRun, Row
from lagros_benchmarks.run.metrics import mean_interval, step_time_statistics, wilson_interval
from lagros_benchmarks.run.settings import Case
from lagros_benchmarks.tasks.foreign.loop import ForeignRecord


def figures(run: BenchmarkRun, case: Case) -> Row:
    """Return the figures of a policy under one condition.

    What plans, goals and tubes are needed for is missing: an environment of somebody else's has
    none.
    """
    records: Sequence[ForeignRecord] = run.episodes[case]
    count = len(records)
    # One that raised has no return, and counts as ended.
    returns = [record.total_reward for record in records if record.error is None]
    ended = sum(record.terminated or record.error is not None for record in records)
    said = [record.success for record in records if record.success is not None]
    # Where the environment says anything of success, an episode without its word has none.
    successes = sum(said)
    return {
        "return_mean": float(np.mean(returns)) if returns else None,
        "return_ci95": mean_interval(returns),
        "return_worst": min(returns, default=None),
        "return_episodes": len(returns),
        "length_mean": float(np.mean([record.length for record in records])),
        "terminated_rate": ended / count,
        "terminated_ci95": wilson_interval(ended, count),
        "success_rate": successes / count if said else None,
        "success_ci95": wilson_interval(successes, count) if said else None,
        **_times(run, case),
    }


def episode_objects(run: BenchmarkRun) -> Iterable[Row]:
    """Yield every episode as an object, without the time of each step."""
    for records in run.episodes.values():
        for record in records:
            fields = asdict(record)
            times = step_time_statistics(fields.pop("step_times"), record.deadline_misses)
            yield {**fields, "step_time_median_s": times.median, "step_time_max_s": times.maximum}


def comparison(ours: Sequence[ForeignRecord], theirs: Sequence[ForeignRecord]) -> Row:
    """Compare a policy with another on the episodes in which neither raised."""
    gained = [
        one.total_reward - other.total_reward
        for one, other in zip(ours, theirs, strict=True)
        if one.error is None and other.error is None
    ]
    return {
        "return_difference": float(np.mean(gained)) if gained else None,
        "return_difference_ci95": mean_interval(gained),
        "episodes_both_ran": len(gained),
    }


def _times(run: BenchmarkRun, case: Case) -> Row:
    timed = run.timing[case]
    contended = run.timing is not run.episodes
    return {
        **_step_times(timed),
        "step_time_episodes": len(timed),
        "step_time_while_contended": _step_times(run.episodes[case]) if contended else None,
        "timing_raised": sum(r.error is not None for r in timed) if contended else 0,
        "deadline_s": run.control_period,
    }


def _step_times(records: Sequence[ForeignRecord]) -> Row:
    statistics = step_time_statistics(
        np.concatenate([record.step_times for record in records]),
        sum(record.deadline_misses for record in records),
    )
    return {
        "step_time_median_s": statistics.median,
        "step_time_p99_s": statistics.p99,
        "step_time_max_s": statistics.maximum,
        "deadline_misses": statistics.deadline_misses,
    }
