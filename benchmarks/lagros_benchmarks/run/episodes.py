"""One episode of one policy, and what is written down about it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.run.keeping import Keepable
from lagros_benchmarks.run.library import Environment
from lagros_envs.arrays import FloatArray

# Both tubes begin with radius zero, where a plan's rounding must not count as leaving them. The
# planner promises its plans to the same accuracy.
TUBE_TOLERANCE = 1e-6

# What a policy counts by the clock, which is another number every time.
TIMED_COUNTERS = ("late_plans",)


@dataclass(frozen=True)
class EpisodeRecord(Keepable):
    """What happened in one episode.

    Two records are equal if the same happened; how long it took is left out of the comparison.

    Attributes:
        seed: Seed of the episode.
        policy: Policy, as the run was asked for it.
        disturbance: Kind of disturbance.
        bound: d_bar, in units of the state per second.
        success: The paper's: at some control instant ||x - x_f|| <= r(t).
        success_time: t*, the first such instant [s]; None if there was none.
        strict_success: Inside the tube around the goal at the time limit, never fallen or collided.
        fallen: The state left what the task allows (`Task.fallen`), which ends the episode.
        collided: The body touched a disc, which ends the episode.
        effort: The integral of ||u||^2 from the centre of the control to t*, else to the end.
        effort_total: The same to the end of the episode, successful or not.
        left_paper_tube: ||x - x_d|| exceeded the paper tube, or the episode ended early, or it has
            no plan x_d; None for a task without a published tube.
        left_certified_tube: Whether ||x - x_d|| exceeded what is proved of it at any control
            instant; None where that was not asked, or nothing is.
        max_tracking_error: The largest ||x - x_d||; None without a plan.
        guaranteed: Whether it was proved, for every disturbance up to d_bar, that the episode is a
            strict success; None where that was not asked or no statement is about the policy.
        error_bound: What is proved of max_tracking_error; None where there is no tube.
        error_bounds: Likewise of tracking_error.
        beside_plan: Whether the episode was begun beside its plan, by an initial error.
        counters: What the policy counts, summed over the episode.
        timed_counters: Those of them that depend on the clock; left out of the comparison.
        error: The exception that ended the episode, which is then a failure; None if none did.
        tracking_error: ||x - x_d|| at every control instant; nan after an early end.
        step_times: Time of each call of `predict` [s].
        deadline_misses: Steps whose call took longer than the control period.
    """

    seed: int
    policy: str
    disturbance: str
    bound: float
    success: bool
    success_time: float | None
    strict_success: bool
    fallen: bool
    collided: bool
    effort: float
    effort_total: float
    left_paper_tube: bool | None
    left_certified_tube: bool | None
    max_tracking_error: float | None
    counters: dict[str, int]
    error: str | None
    timed_counters: dict[str, int] = field(compare=False)
    tracking_error: FloatArray = field(compare=False, repr=False)
    step_times: FloatArray = field(compare=False, repr=False)
    deadline_misses: int = field(compare=False)
    guaranteed: bool | None = None
    error_bound: float | None = None
    error_bounds: FloatArray | None = field(default=None, compare=False, repr=False)
    beside_plan: bool = False


def added_up(counters: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Return the sums of what several episodes have counted, by name; zeros are kept."""
    total: dict[str, int] = {}
    for counts in counters:
        for name, count in counts.items():
            total[name] = total.get(name, 0) + count
    return total


def run_episode(
    env: Environment,
    policy: Any,
    seed: int,
    nominal: FloatArray | None,
    *,
    label: str | None = None,
    initial_error: FloatArray | None = None,
    watch: Callable[[ClosedLoop], None] | None = None,
) -> EpisodeRecord:
    """Run one episode in an environment of one body to its end.

    An exception in the policy or the environment ends the episode as a failure that is written
    down with its text; it is never raised and the episode is never dropped. The plan is x_d
    at every control instant, shape (steps + 1, n), or None where there is none. With an initial
    error, shape (n,), the body begins beside the initial state that the policy is told. Who watches
    is shown the loop at every control instant.
    """
    loop = ClosedLoop(env, policy)
    errors: list[float] = []
    counters: dict[str, int] = {}
    given = {"nominal": nominal, "initial_error": initial_error}
    options = {name: value for name, value in given.items() if value is not None}
    with Attempt() as attempt:
        for _ in loop.fly(seed, options):
            if watch is not None:
                watch(loop)
            if "tracking_error" in loop.info:
                error = float(loop.info["tracking_error"])
                # A state that overflowed is infinitely far away, not unmeasured.
                errors.append(math.inf if math.isnan(error) else error)
    # A planner's count of failed plans matters most in the episode that raised.
    with Attempt() as counting:
        counters = loop.counters()
    name = label or loop.policy.name
    record = _record(loop, name, seed, errors, counters, attempt.error or counting.error)
    if initial_error is None:
        return record
    # The tubes are about episodes that begin on their plan.
    return replace(record, beside_plan=True, left_paper_tube=None)


def _record(
    loop: ClosedLoop,
    label: str,
    seed: int,
    errors: Sequence[float],
    counters: Mapping[str, int],
    problem: str | None,
) -> EpisodeRecord:
    world, info = loop.env.unwrapped, loop.info
    task = world.settings
    tracking = np.full(task.steps + 1, np.nan)
    tracking[: len(errors)] = errors
    radius = task.tube_radius(task.control_period * np.arange(task.steps + 1))
    reached_limit = bool(loop.truncated and not loop.terminated)
    success = bool(info.get("success", False)) and problem is None
    fallen, collided = bool(info.get("fallen", False)), bool(info.get("collided", False))
    left = None
    if radius is not None:
        # `not all inside`: nan (no plan, or an early end) counts as outside.
        left = fallen or collided or not bool(np.all(tracking <= radius + TUBE_TOLERANCE))
    step_times = np.array(loop.step_times)
    return EpisodeRecord(
        seed=seed,
        policy=label,
        disturbance=str(world.disturbance.kind),
        bound=float(world.disturbance.bound),
        success=success,
        success_time=float(info["success_time"]) if success else None,
        strict_success=problem is None and reached_limit and bool(info["inside_tube"]),
        fallen=fallen,
        collided=collided,
        effort=float(info.get("effort_to_success", 0.0)),
        effort_total=float(info.get("effort", 0.0)),
        left_paper_tube=left,
        left_certified_tube=None,
        max_tracking_error=max(errors) if errors else None,
        counters={n: count for n, count in counters.items() if n not in TIMED_COUNTERS},
        error=problem,
        timed_counters={n: count for n, count in counters.items() if n in TIMED_COUNTERS},
        tracking_error=tracking,
        step_times=step_times,
        deadline_misses=int(np.count_nonzero(step_times > task.control_period)),
    )
