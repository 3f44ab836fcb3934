"""One episode of one policy, and what is written down about it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_benchmarks.run.flying import Attempt, ask, counted, reseed
from lagros_benchmarks.run.library import Environment, FloatArray, Policy

# Both tubes begin with radius zero, where a plan's rounding must not count as leaving them. The
# planner promises its plans to the same accuracy.
TUBE_TOLERANCE = 1e-6

# Shape of the action.
ACTION = (1,)
# What a policy counts by the clock, which is another number every time.
TIMED_COUNTERS = ("late_plans",)


@dataclass(frozen=True)
class EpisodeRecord:
    """What happened in one episode.

    Two records are equal if the same happened; how long it took is left out of the comparison.

    Attributes:
        seed: Seed of the episode.
        policy: Policy, as the run was asked for it.
        disturbance: Kind of disturbance.
        bound: d_bar, in units of the state per second.
        success: The paper's: at some control instant ||x - x_f|| <= r(t).
        success_time: t*, the first such instant [s]; None if there was none.
        strict_success: Inside the tube around the goal at the time limit, never fallen.
        fallen: The pole fell, which ends the episode.
        effort: The integral of ||u||^2 to t*, else to the end [N^2 s].
        effort_total: The same to the end of the episode, successful or not [N^2 s].
        left_paper_tube: ||x - x_d|| exceeded the paper tube, or the episode ended early, or it has
            no plan x_d.
        left_certified_tube: None: no certified tube of ours is about a flight of this task
            (`claims`).
        max_tracking_error: The largest ||x - x_d||; None without a plan.
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
    effort: float
    effort_total: float
    left_paper_tube: bool
    left_certified_tube: None
    max_tracking_error: float | None
    counters: dict[str, int]
    error: str | None
    timed_counters: dict[str, int] = field(compare=False)
    tracking_error: FloatArray = field(compare=False, repr=False)
    step_times: FloatArray = field(compare=False, repr=False)
    deadline_misses: int = field(compare=False)


@dataclass
class _Trace:
    """What an episode has left behind so far, whole even if the next call raises."""

    info: dict[str, Any] = field(default_factory=dict)
    errors: list[float] = field(default_factory=list)
    step_times: list[float] = field(default_factory=list)
    state: Any = None
    counters: dict[str, int] = field(default_factory=dict)
    reached_limit: bool = False

    def note(self, info: dict[str, Any]) -> None:
        """Keep the info of an instant."""
        self.info = info
        if "tracking_error" in info:
            error = float(info["tracking_error"])
            # A state that overflowed is infinitely far away, not unmeasured.
            self.errors.append(math.inf if math.isnan(error) else error)


def added_up(counters: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Return the sums of what several episodes have counted, by name; zeros are kept."""
    total: dict[str, int] = {}
    for counts in counters:
        for name, count in counts.items():
            total[name] = total.get(name, 0) + count
    return total


def run_episode(
    env: Environment,
    policy: Policy,
    seed: int,
    nominal: FloatArray | None,
    *,
    label: str | None = None,
) -> EpisodeRecord:
    """Run one episode to its end.

    An exception in the policy or the environment ends the episode as a failure that is written
    down with its text; it is never raised and the episode is never dropped.

    Args:
        env: A cart-pole environment.
        policy: The policy.
        seed: Seed of the episode.
        nominal: x_d at every control instant, or None if there is no plan.
        label: What to call the policy; its own name if None.

    Returns:
        The record of the episode.
    """
    trace = _Trace()
    with Attempt() as attempt:
        _play(env, policy, seed, nominal, trace)
    # A planner's count of failed plans matters most in the episode that raised.
    with Attempt() as counting:
        trace.counters = counted(policy, trace.state)
    name = label or str(getattr(policy, "name", policy))
    return _record(env, name, seed, trace, attempt.error or counting.error)


def _play(
    env: Environment, policy: Policy, seed: int, nominal: FloatArray | None, trace: _Trace
) -> None:
    reseed(policy, seed)
    options = {} if nominal is None else {"nominal": nominal}
    # The observation of the cart-pole is all that there is: local and global are the same.
    observation, info = env.reset(seed=seed, options=options)
    trace.note(info)
    terminated = truncated = False
    while not (terminated or truncated):
        first = not trace.step_times
        action, trace.state, seconds = ask(policy, observation, trace.state, [first], ACTION)
        trace.step_times.append(seconds)
        observation, _, terminated, truncated, info = env.step(action)
        trace.note(info)
    trace.reached_limit = truncated and not terminated


def _record(
    env: Environment,
    label: str,
    seed: int,
    trace: _Trace,
    problem: str | None,
) -> EpisodeRecord:
    world: Any = env.unwrapped
    period = world.settings.control_period
    steps = world.settings.steps
    errors = np.full(steps + 1, np.nan)
    errors[: len(trace.errors)] = trace.errors
    times = period * np.arange(steps + 1)
    info = trace.info
    success = bool(info.get("success", False)) and problem is None
    fallen = bool(info.get("fallen", False))
    step_times = np.array(trace.step_times)
    return EpisodeRecord(
        seed=seed,
        policy=label,
        disturbance=str(world.disturbance.kind),
        bound=float(world.disturbance.bound),
        success=success,
        success_time=float(info["success_time"]) if success else None,
        strict_success=problem is None and trace.reached_limit and bool(info["inside_tube"]),
        fallen=fallen,
        effort=float(info.get("effort_to_success", 0.0)),
        effort_total=float(info.get("effort", 0.0)),
        left_paper_tube=fallen or _left(errors, np.asarray(world.settings.tube.radius(times))),
        left_certified_tube=None,
        max_tracking_error=max(trace.errors) if trace.errors else None,
        counters={n: count for n, count in trace.counters.items() if n not in TIMED_COUNTERS},
        error=problem,
        timed_counters={n: count for n, count in trace.counters.items() if n in TIMED_COUNTERS},
        tracking_error=errors,
        step_times=step_times,
        deadline_misses=int(np.count_nonzero(step_times > period)),
    )


def _left(errors: FloatArray, radius: FloatArray) -> bool:
    # `not all inside`: nan (no plan, or an early end) counts as outside.
    return not bool(np.all(errors <= radius + TUBE_TOLERANCE))
