"""What is guaranteed of the episodes that a policy flies, and how near a search comes to it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from lagros_benchmarks.evidence.loops import Loop
from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.worst_case.flights import Flights, fly, parts_of, random_pushes
from lagros_benchmarks.worst_case.search import SearchSettings, search
from lagros_benchmarks.worst_case.single import SingleTarget
from lagros_envs.arrays import BoolArray, FloatArray, IntArray
from lagros_envs.numbers import functions
from lagros_envs.task import Task
from lagros_policies.contraction.certificate import Stopwatch
from lagros_policies.proof.guarantee import Guarantees, guarantees
from lagros_policies.proof.plan_tube import PlanTubes

# Flights that a search may spend on each episode, and how many sequences climb side by side.
SEARCH = SearchSettings("gradient", budget=240, restarts=3)
# A smaller bound is looked for down to this one, and until it is good for this share of episodes.
_LEAST, _MOST = 1e-4, 0.9
# Above the rounding of a flight, relative to the bound and as such.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Worst:
    """The worst that flights of each of e episodes did.

    Attributes:
        error: The largest ||x - x_d||, shape (e,).
        outputs: The largest |x - x_d| by coordinate, shape (e, n).
        crossed: Whether a flight left its tube, at any instant in any coordinate, shape (e,).
        failed: Whether one fell, touched a disc or missed the goal at the time limit, shape (e,).
        flights: Flights of each episode.
    """

    error: FloatArray
    outputs: FloatArray
    crossed: BoolArray
    failed: BoolArray
    flights: int


@dataclass(frozen=True)
class Evidence:
    """What is proved of episodes, and what a search found in them.

    Attributes:
        asked: Episodes, with those that have no plan.
        tubes: The tubes; None where there are none.
        proved: What they guarantee; None likewise.
        smaller: A smaller d_bar at which episodes are guaranteed, and how many, where none is at
            the one that was asked for; None where that was not looked for, or not found.
        worst: What the search found, and the flights.
        flights: All episodes under each kind of random disturbance.
        proof_seconds: Time of tubes and guarantees [s].
        search_seconds: Time of the search [s].
        flight_seconds: Time of the flights [s].
    """

    asked: int
    tubes: PlanTubes | None
    proved: Guarantees | None
    smaller: tuple[float, int] | None
    worst: Worst
    flights: tuple[Flights, ...]
    proof_seconds: float
    search_seconds: float
    flight_seconds: float

    @property
    def count(self) -> int:
        """Episodes with a guarantee."""
        return 0 if self.proved is None else int(np.count_nonzero(self.proved.holds))

    @property
    def shares(self) -> FloatArray:
        """The largest ||x - x_d|| found over its bound, of each guaranteed episode."""
        if self.proved is None:
            return np.empty(0)
        kept = self.proved.holds
        return np.asarray(self.worst.error[kept] / self.proved.norm.max(axis=1)[kept])

    @property
    def contradicted(self) -> int:
        """Episodes in which a flight did what is proved to be impossible."""
        if self.proved is None:
            return 0
        crossed = self.worst.crossed & self.proved.closed
        return int(np.count_nonzero(crossed | (self.worst.failed & self.proved.holds)))


@dataclass
class _Record:
    """What flights of a search came to so far, by episode; see `Worst`."""

    error: FloatArray
    outputs: FloatArray
    crossed: BoolArray
    failed: BoolArray


@dataclass(frozen=True)
class TubeTarget(SingleTarget):
    """Episodes whose every flight of a search is held against tubes.

    Attributes:
        tubes: The tubes; None for none.
    """

    tubes: PlanTubes | None = None
    record: _Record = field(init=False)

    def __post_init__(self) -> None:
        count, n = self.episodes, self.channels
        flags = np.zeros((2, count), bool)
        record = _Record(np.zeros(count), np.zeros((count, n)), *flags)
        object.__setattr__(self, "record", record)

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the largest ||x - x_d|| of the flights (b,), and note what they did."""
        flights = fly(self.flown, self.law, episode, self.bound * sequences)
        return self.note(episode, flights)

    def note(self, episode: IntArray, flights: Flights) -> FloatArray:
        """Hold flights of some episodes against the tubes; return the largest errors (b,)."""
        task, record = self.flown.settings, self.record
        error = np.abs(flights.states - self.flown.plans[episode])
        error = np.where(flights.alive[..., None], error, 0.0)
        norm = np.linalg.norm(error, axis=-1)
        np.maximum.at(record.error, episode, norm.max(axis=1))
        np.maximum.at(record.outputs, episode, error.max(axis=1))
        end = parts_of(flights.states[:, -1])
        distance = task.goal_distance(end, parts_of(self.flown.goals[episode]), functions)
        missed = ~(distance <= task.success_radius(task.time_limit))
        np.logical_or.at(record.failed, episode, missed | flights.lost)
        if self.tubes is not None:
            left = _beyond(error, self.tubes.outputs[episode][..., : self.channels]).any(axis=-1)
            left |= _beyond(norm, self.tubes.norm[episode])
            np.logical_or.at(record.crossed, episode, left.any(axis=1))
        return np.asarray(norm.max(axis=1))


def _beyond(found: FloatArray, bound: FloatArray) -> BoolArray:
    return np.asarray(found > bound * (1.0 + _ROUNDING) + _ROUNDING)


def errors_of(flights: Flights, plans: FloatArray) -> FloatArray:
    """Return ||x - x_d|| at every instant before an end, zero after, shape (b, steps + 1)."""
    error = np.linalg.norm(flights.states - plans, axis=-1)
    return np.where(flights.alive, error, 0.0)


def _proved(
    loop: Loop, bound: float, tell: Callable[[int, int], None] | None = None
) -> tuple[PlanTubes, Guarantees] | None:
    if loop.tubes is None:
        return None
    flown, tubes = loop.episodes, loop.tubes(bound, tell)
    found = guarantees(flown.settings, flown.goals, flown.discs, flown.plans, flown.controls, tubes)
    return tubes, found


def _smaller(
    loop: Loop, bound: float, most_seconds: float, tell: Progress
) -> tuple[float, int] | None:
    """Halve d_bar until most episodes are guaranteed, or time is up; return the last with any."""
    begun, found = time.monotonic(), None
    most = _MOST * (len(loop.episodes.seeds) + len(loop.episodes.unplanned))
    while (spent := time.monotonic() - begun) < most_seconds and bound > _LEAST:
        tell("smaller d̄, s", round(spent), round(most_seconds))
        bound = 0.5 * bound
        made = _proved(loop, bound)
        count = 0 if made is None else int(np.count_nonzero(made[1].holds))
        if count:
            found = bound, count
        if count >= most:
            break
    tell("smaller d̄, s", round(most_seconds), round(most_seconds))
    return found


def evidence_of(
    loop: Loop,
    bound: float,
    kinds: Sequence[str],
    settings: SearchSettings = SEARCH,
    most_seconds: float = 0.0,
    tell: Progress = untold,
) -> Evidence:
    """Prove what can be proved of the episodes of a loop, and look for what contradicts it.

    Args:
        loop: Policy and episodes.
        bound: d_bar, in units of the state per second.
        kinds: Kinds of random disturbance that are flown besides.
        settings: Of the search.
        most_seconds: Time to look for a smaller bound where nothing is guaranteed at this one [s].
        tell: Called with what is being done, how much of it is, and of how much.
    """
    watch = Stopwatch()
    flown = loop.episodes
    tubes, proved = _proved(loop, bound, partial(tell, "proof")) or (None, None)
    smaller = None
    if proved is not None and not proved.holds.any():
        smaller = _smaller(loop, bound, most_seconds, tell)
    proof_seconds = watch.lap()
    target = TubeTarget(flown, loop.law, "error", bound, tubes=tubes)
    found = search(target, settings, 0, tell)
    search_seconds = watch.lap()
    every = np.arange(len(flown.seeds))
    flights: list[Flights] = []
    for kind in kinds:
        tell("flights", len(flights), len(kinds))
        one = fly(flown, loop.law, every, random_pushes(flown, kind, bound))
        target.note(every, one)
        flights.append(one)
    tell("flights", len(flights), len(kinds))
    return Evidence(
        asked=len(flown.seeds) + len(flown.unplanned),
        tubes=tubes,
        proved=proved,
        smaller=smaller,
        worst=Worst(**vars(target.record), flights=max(one.flights for one in found)),
        flights=tuple(flights),
        proof_seconds=proof_seconds,
        search_seconds=search_seconds,
        flight_seconds=watch.lap(),
    )


def coordinates(task: Task) -> tuple[str, ...]:
    """Return the names of the coordinates of the state, without their units."""
    names = task.state_names or tuple(f"x{index}" for index in range(task.system.state_dim))
    return tuple(name.partition(" ")[0] for name in names)


def as_json(evidence: Evidence, task: Task) -> dict[str, Any] | None:
    """Return what is guaranteed as what JSON can hold; None where no statement is about it."""
    proved, names = evidence.proved, coordinates(task)
    if proved is None:
        return None
    kept, shares = proved.holds, evidence.shares
    some = bool(kept.any())

    def largest(values: FloatArray) -> dict[str, float | None] | None:
        if not some:
            return None
        # Of a motion that is not enclosed between the instants nothing is known there.
        ends = [end if np.isfinite(end) else None for end in values[kept].max(axis=0).tolist()]
        return dict(zip(names, ends, strict=True))

    return {
        "episodes": evidence.asked,
        "guaranteed": evidence.count,
        "share": evidence.count / evidence.asked,
        "state_bounds": largest(proved.state),
        "error_bounds": largest(proved.error),
        "norm_bound": float(proved.norm[kept].max()) if some else None,
        "goal_distance_bound": float(proved.goal_distance[kept].max()) if some else None,
        "not_shown": not_shown(evidence),
        "smaller_bound": None
        if evidence.smaller is None
        else dict(zip(("d_bar", "guaranteed"), evidence.smaller, strict=True)),
        "seconds": round(evidence.proof_seconds, 3),
        "search": {
            "flights_per_episode": evidence.worst.flights,
            "largest_error": float(evidence.worst.error.max()),
            "largest_errors": dict(
                zip(names, evidence.worst.outputs.max(axis=0).tolist(), strict=True)
            ),
            "share_of_bound": {
                "least": float(shares.min()),
                "median": float(np.median(shares)),
                "largest": float(shares.max()),
            }
            if some
            else None,
            # Of each coordinate at the control instants, over its own bound.
            "shares_of_bounds": dict(zip(names, _coordinate_shares(evidence).tolist(), strict=True))
            if some
            else None,
            "contradicted": evidence.contradicted,
            "seconds": round(evidence.search_seconds, 3),
        },
    }


def _coordinate_shares(evidence: Evidence) -> FloatArray:
    """Return the largest errors found over their bounds, medians of guaranteed episodes, (n,)."""
    assert evidence.proved is not None
    assert evidence.tubes is not None
    found = evidence.worst.outputs
    bounds = evidence.tubes.outputs[..., : found.shape[1]].max(axis=1)
    kept = evidence.proved.holds
    return np.asarray(np.median(found[kept] / bounds[kept], axis=0))


def not_shown(evidence: Evidence) -> dict[str, int]:
    """Return of how many episodes what is not shown; of one without a tube nothing else is said."""
    proved = evidence.proved
    if proved is None:
        return {}
    missing = {"plan": evidence.asked - len(proved.closed), "tube": _count(~proved.closed)}
    for name, words in (
        ("reaches", "the goal"),
        ("upright", "no fall"),
        ("clear", "no collision"),
    ):
        missing[words] = _count(proved.closed & ~getattr(proved, name))
    return {name: count for name, count in missing.items() if count}


def _count(flags: BoolArray) -> int:
    return int(np.count_nonzero(flags))
