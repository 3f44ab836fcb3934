"""From episodes of one body to the rows of a published table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from lagros_benchmarks.run.convergence import (
    convergence_rates,
    error_areas,
    tightest_envelope,
)
from lagros_benchmarks.run.episodes import TUBE_TOLERANCE, EpisodeRecord, added_up
from lagros_benchmarks.run.experiment import Row
from lagros_benchmarks.run.metrics import (
    carry_forward,
    effort_ratio,
    mean_interval,
    median_ratio,
    paired_success_difference,
    step_time_statistics,
    wilson_interval,
)
from lagros_benchmarks.run.settings import Case
from lagros_benchmarks.run.single import SingleRun
from lagros_envs.arrays import FloatArray
from lagros_envs.task import Task

# Above the rounding of a distance, relative.
_ROUNDING = 1e-9
_BAND = (10.0, 90.0)  # percentiles of the tracking error over the episodes


def figures(run: SingleRun, case: Case) -> Row:
    """Return the figures of a policy under one condition."""
    records = run.episodes[case]
    return {
        **_outcomes(records),
        **_efforts(records),
        **_times(run, case),
        **_tracking(run, case),
        **_convergence(run, case),
        "guarantee": run.settings.guarantee,
        **_guarantees(records),
        "units": _units(run.task),
        "counters": added_up({**r.counters, **r.timed_counters} for r in records),
    }


def episode_objects(run: SingleRun) -> Iterable[dict[str, Any]]:
    """Yield every episode as an object, without the time of each step."""
    for records in run.episodes.values():
        for record in records:
            fields = asdict(record)
            fields["counters"] |= fields.pop("timed_counters")
            times = step_time_statistics(fields.pop("step_times"), record.deadline_misses)
            yield {**fields, "step_time_median_s": times.median, "step_time_max_s": times.maximum}


def _units(task: Task) -> Row:
    """Return the units of the effort and of the state; "" where there is none."""
    states = [name.partition("[")[2].rstrip("]") for name in task.state_names]
    return {
        "effort": task.squared_unit and f"{task.squared_unit}s",
        "state": ", ".join(states) if all(states) else "",
    }


def _outcomes(records: Sequence[EpisodeRecord]) -> Row:
    count = len(records)
    successes = sum(record.success for record in records)
    strict = sum(record.strict_success for record in records)
    times = [r.success_time for r in records if r.success_time is not None]
    return {
        "success_rate": successes / count,
        "success_ci95": wilson_interval(successes, count),
        "strict_success_rate": strict / count,
        "strict_success_ci95": wilson_interval(strict, count),
        "fall_rate": sum(record.fallen for record in records) / count,
        "collision_rate": sum(record.collided for record in records) / count,
        "success_time_median_s": float(np.median(times)) if times else None,
    }


def _efforts(records: Sequence[EpisodeRecord]) -> Row:
    ran = [record for record in records if record.error is None]
    efforts = [record.effort for record in ran]
    return {
        "effort_mean": float(np.mean(efforts)) if ran else None,
        "effort_ci95": mean_interval(efforts),
        "effort_total_mean": float(np.mean([r.effort_total for r in ran])) if ran else None,
        "effort_episodes": len(ran),
    }


def _times(run: SingleRun, case: Case) -> Row:
    timed = run.timing[case]
    alone = _step_times(timed)
    contended = None if run.timing is run.episodes else _step_times(run.episodes[case])
    return {
        **alone,
        "step_time_episodes": len(timed),
        "step_time_while_contended": contended,
        "timing_raised": 0
        if contended is None
        else sum(record.error is not None for record in timed),
        "forward_time_median_s": run.forward_times[case.policy],
        "deadline_s": run.control_period,
    }


def _step_times(records: Sequence[EpisodeRecord]) -> Row:
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


def _tracking(run: SingleRun, case: Case) -> Row:
    records, tube = run.episodes[case], run.paper_tube
    left = [record.left_paper_tube for record in records if record.left_paper_tube is not None]
    measured = [r.tracking_error for r in records if r.max_tracking_error is not None]
    row: Row = {
        "tube_violation_rate": sum(left) / len(left) if left else None,
        **_certified(records),
        "plans_failed": sum(plan.states is None for plan in run.plans),
        "time_s": _rounded(run.times),
        "paper_tube": None if tube is None else _rounded(tube),
        "tracking_episodes": len(measured),
        "tracking_error_mean_below_tube": None if tube is None else False,
        "mean_tracking_error": None,
        "tracking_error_p10": None,
        "tracking_error_p90": None,
    }
    if not measured:
        return row
    curves = carry_forward(np.array(measured))
    mean = curves.mean(axis=0)
    low, high = np.percentile(curves, _BAND, axis=0, method="nearest")
    if tube is not None:
        raised = any(record.error is not None for record in records)
        below = not raised and bool(np.all(mean <= tube + TUBE_TOLERANCE))
        row["tracking_error_mean_below_tube"] = below
    return {
        **row,
        "mean_tracking_error": _rounded(mean),
        "tracking_error_p10": _rounded(low),
        "tracking_error_p90": _rounded(high),
    }


def _convergence(run: SingleRun, case: Case) -> Row:
    """Return the area under the error and, where episodes begin beside plans, how it dies out."""
    found = _dying_out(run.episodes[case])
    areas = found.areas * run.control_period
    row: Row = {
        "initial_error": run.settings.initial_error,
        **_mean("error_area", areas[~np.isnan(areas)]),
    }
    if not run.settings.initial_error:
        return row
    curves, peaks = found.normalised, found.overshoots[~np.isnan(found.overshoots)]
    overshoot, rates = None, np.zeros(0)
    if len(curves) and np.isfinite(peaks).all():
        overshoot = tightest_envelope(curves[np.argmax(peaks)], run.control_period).overshoot
        rates = convergence_rates(curves, overshoot, run.control_period)
    return {
        **row,
        **_mean("normalised_area", error_areas(curves, run.control_period)),
        **_mean("overshoot", peaks),
        "envelope_overshoot": overshoot,
        **_mean("convergence_rate", rates),
    }


class _DyingOut(NamedTuple):
    """Errors of episodes; one that ended early counts on with its largest.

    Attributes:
        areas: Integral of ||x - x_d|| over the control steps, shape (episodes,); nan without plan.
        normalised: e(t) / e(0) of those that begin beside their plan, shape (k, instants).
        overshoots: Largest e(t) / e(0), shape (episodes,); nan without.
    """

    areas: FloatArray
    normalised: FloatArray
    overshoots: FloatArray


def _dying_out(records: Sequence[EpisodeRecord]) -> _DyingOut:
    with np.errstate(invalid="ignore"):
        curves = carry_forward(np.array([record.tracking_error for record in records]))
    beside = np.array([record.beside_plan for record in records]) & (curves[:, 0] > 0.0)
    normalised = curves[beside] / curves[beside, :1]
    overshoots = np.full(len(records), np.nan)
    overshoots[beside] = normalised.max(axis=1)
    return _DyingOut(error_areas(curves, 1.0), normalised, overshoots)


def _mean(name: str, values: Sequence[float] | FloatArray) -> Row:
    mean = float(np.mean(values)) if len(values) else None
    return {f"{name}_mean": mean, f"{name}_ci95": mean_interval(values)}


def _certified(records: Sequence[EpisodeRecord]) -> Row:
    """Return the widest tube of the guaranteed episodes, and how many flights left their own."""
    known = [r.left_certified_tube for r in records if r.left_certified_tube is not None]
    tubes = [r.error_bounds for r in records if r.guaranteed and r.error_bounds is not None]
    return {
        "certified_violation_rate": sum(known) / len(known) if known else None,
        "certified_tube": _rounded(np.max(tubes, axis=0)) if tubes else None,
    }


def _guarantees(records: Sequence[EpisodeRecord]) -> Row:
    """Return what is proved of the episodes; None where no statement is about them."""
    row: Row = dict.fromkeys(
        ("guaranteed_rate", "guaranteed_ci95", "bound_over_worst", "guarantees_contradicted")
    )
    if any(record.guaranteed is None for record in records):
        return row
    kept = [record for record in records if record.guaranteed]
    bounds = [record.error_bound for record in kept if record.error_bound is not None]
    found = [r.max_tracking_error for r in kept if r.max_tracking_error is not None]
    return row | {
        "guaranteed_rate": len(kept) / len(records),
        "guaranteed_ci95": wilson_interval(len(kept), len(records)),
        "bound_over_worst": max(bounds) / max(found) if bounds and max(found) > 0.0 else None,
        "guarantees_contradicted": sum(map(_contradicts, records)),
    }


def _contradicts(record: EpisodeRecord) -> bool:
    """Return whether an episode did what is proved to be impossible."""
    bound, error = record.error_bound, record.max_tracking_error
    beyond = bound is not None and error is not None and error > bound * (1.0 + _ROUNDING)
    return bool(beyond or (record.guaranteed and not record.strict_success))


def _rounded(curve: FloatArray) -> list[float]:
    # Six decimals are more than a curve is good for, and keep the files small.
    return [round(float(value), 6) for value in curve]


def comparison(ours: Sequence[EpisodeRecord], theirs: Sequence[EpisodeRecord]) -> Row:
    """Compare a policy with another on the same episodes."""
    solved, their_solved = ([record.success for record in one] for one in (ours, theirs))
    success = paired_success_difference(solved, their_solved)
    effort = effort_ratio(
        [r.effort for r in ours], solved, [r.effort for r in theirs], their_solved
    )
    error, their_error = _dying_out(ours), _dying_out(theirs)
    ratios = _ratio("error_area", error.areas, their_error.areas)
    if any(record.beside_plan for record in ours):
        ratios |= _ratio("overshoot", error.overshoots, their_error.overshoots)
    return {
        "success_difference": success.difference,
        "success_difference_ci95": success.interval,
        "effort_ratio": None if effort is None else effort.ratio,
        "effort_ratio_ci95": None if effort is None else effort.interval,
        "episodes_both_solve": 0 if effort is None else effort.episodes,
        **ratios,
    }


def _ratio(name: str, ours: FloatArray, theirs: FloatArray) -> Row:
    found = median_ratio(ours, theirs)
    return {
        f"{name}_ratio": None if found is None else found.ratio,
        f"{name}_ratio_ci95": None if found is None else found.interval,
    }
