"""From worlds of spacecraft to the rows of a published table.

Rates are per agent. Agents of one world are not independent, so that beside Wilson's interval over
agents stands one over worlds; comparisons and efforts have theirs over worlds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.experiment import Row
from lagros_benchmarks.run.metrics import (
    cluster_interval,
    cluster_rate_interval,
    paired_success_difference,
    step_time_statistics,
    wilson_interval,
)
from lagros_benchmarks.run.settings import Case
from lagros_benchmarks.tasks.spacecraft.episodes import WorldRecord
from lagros_benchmarks.tasks.spacecraft.experiment import SpacecraftRun
from lagros_benchmarks.tasks.spacecraft.timing import Timing
from lagros_envs.arrays import BoolArray
from lagros_envs.tasks.spacecraft.scenarios import preset_named
from lagros_envs.tasks.spacecraft.task import settings_for


def figures(run: SpacecraftRun, case: Case) -> Row:
    """Return the figures of a policy, filtered or not, under one bound and number of agents."""
    worlds = run.episodes[case]
    return {
        **_limits(run, case),
        **_outcomes(worlds),
        **_efforts(worlds),
        **_times(run.timing[case], run.control_period),
        **_tracking(worlds),
        **_guarantees(worlds),
        "counters": dict(run.counters[case]),
    }


def _limits(run: SpacecraftRun, case: Case) -> Row:
    """Return what the preset makes of the task for this many agents."""
    preset = preset_named(run.settings.preset or "paper").for_agents(case.agents)
    task = settings_for(preset)
    return {
        "horizon_s": task.horizon,
        "time_limit_s": task.time_limit,
        "goal_radius_m": task.goal_radius,
        "arena_m": preset.arena,
    }


def episode_objects(run: SpacecraftRun) -> Iterable[dict[str, Any]]:
    """Yield every agent of every world as an object."""
    for case, worlds in run.episodes.items():
        for world in worlds:
            for index, agent in enumerate(world.agents):
                yield {
                    "policy": case.policy,
                    "safety_filter": case.safety_filter,
                    "disturbance": case.condition.kind,
                    "bound": case.condition.bound,
                    "agents": len(world.agents),
                    "seed": world.seed,
                    "agent": index,
                    **asdict(agent),
                    "planned": world.planned,
                    "error": world.error,
                }


def _each(worlds: Sequence[WorldRecord], name: str) -> NDArray[Any]:
    """Return a flag or number of every agent, shape (worlds, agents)."""
    return np.array([[getattr(agent, name) for agent in world.agents] for world in worlds])


def _rate(name: str, flags: BoolArray) -> Row:
    """Return a rate over agents with both of its intervals."""
    return {
        f"{name}_rate": float(flags.mean()),
        f"{name}_ci95": wilson_interval(int(flags.sum()), flags.size),
        f"{name}_world_ci95": cluster_rate_interval(
            flags.sum(axis=1).tolist(), np.full(len(flags), flags.shape[1]).tolist()
        ),
    }


def _outcomes(worlds: Sequence[WorldRecord]) -> Row:
    times = [a.success_time for w in worlds for a in w.agents if a.success_time is not None]
    success = _each(worlds, "success")
    planned = [world.planned for world in worlds]
    with_plan = np.array([bool(one) for one in planned])
    row: Row = {
        **_rate("success", success),
        **_rate("strict_success", _each(worlds, "strict_success")),
        **_rate("paper_success", _each(worlds, "paper_success")),
        **_rate("collision", _each(worlds, "collided")),
        **_rate("safe", ~_each(worlds, "collided")),
        **_rate("reached", _each(worlds, "reached")),
        **_rate("safe_reached", _each(worlds, "reached") & ~_each(worlds, "collided")),
        "world_success_rate": float(success.all(axis=1).mean()),
        "success_time_median_s": float(np.median(times)) if times else None,
        "plan_rate": None if None in planned else float(with_plan.mean()),
        "success_rate_where_planned": None,
    }
    if None not in planned and with_plan.any():
        row["success_rate_where_planned"] = float(success[with_plan].mean())
    return row


def _efforts(worlds: Sequence[WorldRecord]) -> Row:
    """Efforts of all agents but those whose world raised before they had succeeded."""
    whole = np.array([world.error is None for world in worlds])
    known = whole[:, None] | _each(worlds, "success")
    efforts = np.where(known, _each(worlds, "effort"), 0.0)
    solved = _each(worlds, "success")
    totals = _each(worlds, "effort_total")[whole]
    return {
        "effort_mean": float(efforts.sum() / known.sum()) if known.any() else None,
        "effort_ci95": cluster_interval(efforts.sum(axis=1), known.sum(axis=1)),
        "effort_of_successes_mean": float(efforts[solved].mean()) if solved.any() else None,
        "effort_total_mean": float(totals.mean()) if totals.size else None,
        "effort_agents": int(known.sum()),
    }


def _times(timings: Sequence[Timing], deadline: float) -> Row:
    steps, batches, plans = (
        np.concatenate([getattr(timing, name) for timing in timings])
        for name in ("steps", "batches", "plans")
    )
    agents = timings[0].agents
    # Whoever plans for all at the start has planned by the first deadline, or missed it.
    calls = batches if plans.size else steps
    misses = int(np.count_nonzero(calls > deadline))
    alone = step_time_statistics(steps, 0)
    planning = step_time_statistics(plans, 0)
    return {
        "step_time_median_s": alone.median,
        "step_time_p99_s": alone.p99,
        "step_time_max_s": alone.maximum,
        "step_time_of": "all agents" if plans.size else "one agent",
        "step_time_batch_per_agent_s": float(np.median(batches)) / agents if batches.size else None,
        "plan_time_median_s": planning.median if plans.size else None,
        "plan_time_p99_s": planning.p99 if plans.size else None,
        "plan_time_max_s": planning.maximum if plans.size else None,
        "plans_timed": int(plans.size),
        "steps_timed": int(steps.size),
        "timing_raised": sum(timing.raised for timing in timings),
        "deadline_s": deadline,
        "deadline_misses": step_time_statistics(calls, misses).deadline_misses,
    }


def _tracking(worlds: Sequence[WorldRecord]) -> Row:
    """Share of agents that left the tubes around x_d; None where there is no x_d."""
    agents = [agent for world in worlds for agent in world.agents]
    paper = [a.left_paper_tube for a in agents if a.left_paper_tube is not None]
    certified = [a.left_certified_tube for a in agents if a.left_certified_tube is not None]
    errors = [a.max_position_error for a in agents if a.max_position_error is not None]
    return {
        "tube_violation_rate": float(np.mean(paper)) if paper else None,
        "certified_violation_rate": float(np.mean(certified)) if certified else None,
        "position_error_max_median": float(np.median(errors)) if errors else None,
        "position_error_max_p95": float(np.percentile(errors, 95.0)) if errors else None,
    }


def _guarantees(worlds: Sequence[WorldRecord]) -> Row:
    """What is proved of the worlds; None where nothing is of a policy's."""
    names = ("guaranteed_rate", "guaranteed_ci95", "guaranteed_arriving_rate")
    row: Row = dict.fromkeys((*names, "bound_over_worst", "guarantees_contradicted"))
    if any(world.guaranteed is None for world in worlds):
        return row
    kept = [world for world in worlds if world.guaranteed]
    row |= {
        "guaranteed_rate": len(kept) / len(worlds),
        "guaranteed_ci95": wilson_interval(len(kept), len(worlds)),
        "guaranteed_arriving_rate": sum(bool(world.arriving) for world in worlds) / len(worlds),
        "guarantees_contradicted": sum(map(_contradicts, worlds)),
    }
    worst = max((_worst(world) for world in kept), default=0.0)
    bounds = [one.position_error_bound for one in kept if one.position_error_bound is not None]
    if worst > 0.0 and len(bounds) == len(kept):
        row["bound_over_worst"] = float(max(bounds) / worst)
    return row


def _worst(world: WorldRecord) -> float:
    return max(agent.max_position_error or 0.0 for agent in world.agents)


def _contradicts(world: WorldRecord) -> bool:
    """Return whether a world did what was proved to be impossible."""
    beyond = world.position_error_bound is not None and _worst(world) > world.position_error_bound
    collided = world.guaranteed and any(agent.collided for agent in world.agents)
    missed = world.arriving and not all(agent.success for agent in world.agents)
    return bool(beyond or collided or missed)


def comparison(ours: Sequence[WorldRecord], theirs: Sequence[WorldRecord]) -> Row:
    """Return the difference in success and the ratio of efforts of the agents that both solve."""
    mine = _each(ours, "success")
    other = _each(theirs, "success")
    success = paired_success_difference(mine.ravel().tolist(), other.ravel().tolist())
    counts = np.full(len(mine), mine.shape[1])
    change = (mine.astype(int) - other.astype(int)).sum(axis=1)
    # Where all worlds differ alike, resampling them shows no spread: the interval over agents then
    # stands for both.
    alike = bool(np.all(change == change[0]))
    both = mine & other
    spent = np.where(both, _each(ours, "effort"), 0.0)
    reference = np.where(both, _each(theirs, "effort"), 0.0)
    measurable = reference.sum() > 0.0
    # Over the same time: of all agents, of worlds that neither policy ended early.
    whole = np.array(
        [a.error is None and b.error is None for a, b in zip(ours, theirs, strict=True)]
    )
    totals = [_each(worlds, "effort_total")[whole].sum() for worlds in (ours, theirs)]
    return {
        "success_difference": success.difference,
        "success_difference_ci95": success.interval,
        "success_difference_world_ci95": success.interval
        if alike
        else cluster_interval(change, counts),
        "effort_ratio": float(spent.sum() / reference.sum()) if measurable else None,
        "effort_ratio_ci95": cluster_interval(spent.sum(axis=1), reference.sum(axis=1))
        if measurable
        else None,
        "effort_total_ratio": float(totals[0] / totals[1]) if totals[1] > 0.0 else None,
        "agents_both_solve": int(both.sum()),
    }
