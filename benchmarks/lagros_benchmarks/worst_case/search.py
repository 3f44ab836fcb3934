"""Search for the bounded disturbance that a policy stands worst.

A target flies any number of sequences of any of its episodes in one batch and says how bad each
flight was. Every method spends the same currency, flights per episode, and all episodes are
searched side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.worst_case.optimisers import OPTIMISERS, make_search
from lagros_benchmarks.worst_case.sequences import PARAMETRISATIONS
from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.balls import into_unit_ball, onto_unit_sphere
from lagros_envs.checks import check_fields, check_name, check_whole

MOST = 10**9  # of all that is counted
METHODS = (*OPTIMISERS, "gradient", "hybrid")
# Shares of the way to the pushes that the slopes ask for, tried side by side.
_WAYS = (1.0, 0.5, 0.2, 0.05)
# Further starts of a climb: a direction of the episode with some noise per step.
_START_NOISE = 0.3
# Share of the budget at which "hybrid" stops to explore and climbs.
_EXPLORED = 0.5
# Where the rest does not pay for one round of all, so few climb that it pays for as many.
_ROUNDS = 3


class Target(Protocol):
    """What is attacked: episodes of one policy under one bound, with one goal."""

    @property
    def episodes(self) -> int:
        """Number of episodes."""

    @property
    def steps(self) -> int:
        """Control steps of an episode."""

    @property
    def channels(self) -> int:
        """Coordinates of d."""

    @property
    def slope_cost(self) -> int:
        """Flights that the slopes of one flight cost; 0 if there are none."""

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return how bad the flights (b,) under d/d_bar (b, steps, channels) are; more is worse."""

    def slopes(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the slopes of the scores by the sequences, of their shape, up to a factor."""

    def starts(self) -> FloatArray:
        """Return sequences worth trying first, shape (episodes, k, steps, channels)."""


@dataclass(frozen=True)
class SearchSettings:
    """How to search.

    Attributes:
        method: One of `METHODS`; "hybrid" lets an optimiser explore and climbs from its best.
        optimiser: What explores in "hybrid".
        parametrisation: One of `PARAMETRISATIONS`.
        pieces: Its pieces.
        budget: Flights per episode.
        population: Flights per question of an optimiser.
        restarts: Sequences that climb side by side, fewer where the budget is small.

    Raises:
        ValueError: A name is unknown or a number is out of range.
    """

    method: str = "hybrid"
    optimiser: str = "cross-entropy"
    parametrisation: str = "switching"
    pieces: int = 6
    budget: int = 1000
    population: int = 30
    restarts: int = 8

    def __post_init__(self) -> None:
        check_fields(self)
        for name, valid in (
            ("method", METHODS),
            ("optimiser", OPTIMISERS),
            ("parametrisation", tuple(PARAMETRISATIONS)),
        ):
            check_name(name, getattr(self, name), valid)
        for name, least in (("pieces", 1), ("budget", 1), ("population", 2), ("restarts", 1)):
            check_whole(name, getattr(self, name), least, MOST)


@dataclass(frozen=True)
class Found:
    """The worst sequence that a search found for one episode.

    Attributes:
        sequence: d/d_bar, shape (steps, channels).
        score: How bad its flight was in the search.
        flights: Flights spent on the episode.
    """

    sequence: FloatArray
    score: float
    flights: int


class _Pool:
    """The best sequences so far of every episode, best first, and what they cost."""

    def __init__(self, target: Target, size: int, budget: int, tell: Progress) -> None:
        self.size, self.flights = size, 0
        self._budget, self._tell = budget, tell
        tell("search", 0, budget)
        self.sequences = [np.empty((0, target.steps, target.channels))] * target.episodes
        self.scores = [np.empty(0)] * target.episodes

    def add(self, sequences: FloatArray, scores: FloatArray) -> None:
        """Take sequences (episodes, k, steps, channels) with their scores (episodes, k)."""
        self.spend(scores.shape[1])
        for index, (fresh, values) in enumerate(zip(sequences, scores, strict=True)):
            joined = np.concatenate([self.scores[index], values])
            best = np.argsort(-joined, kind="stable")[: self.size]
            self.scores[index] = joined[best]
            self.sequences[index] = np.concatenate([self.sequences[index], fresh])[best]

    def spend(self, flights: int) -> None:
        """Count flights of each episode, and tell of them."""
        self.flights += flights
        self._tell("search", min(self.flights, self._budget), self._budget)


def search(
    target: Target, settings: SearchSettings, seed: int = 0, tell: Progress = untold
) -> list[Found]:
    """Search the worst sequence of every episode of a target, each with its own stream of the seed.

    Args:
        target: What is attacked.
        settings: How.
        seed: Of the streams.
        tell: Called with the flights per episode that are spent, and the budget.

    Raises:
        ValueError: The method is "gradient" and the target has no slopes.
    """
    climbs = settings.method in ("gradient", "hybrid") and target.slope_cost > 0
    if settings.method == "gradient" and not climbs:
        raise ValueError("method='gradient' needs a target with slopes; use 'hybrid'")
    children = np.random.SeedSequence(seed).spawn(target.episodes)
    streams = [np.random.default_rng(child) for child in children]
    pool = _Pool(target, settings.restarts, settings.budget, tell)
    _try(target, pool, target.starts()[:, : settings.budget])
    if settings.method == "gradient":
        _try(target, pool, _random_starts(target, settings.restarts, streams))
    else:
        name = settings.optimiser if settings.method == "hybrid" else settings.method
        share = _EXPLORED if climbs else 1.0
        _explore(target, settings, name, pool, streams, share * settings.budget)
    if climbs:
        _climb(target, pool, settings.budget)
    tell("search", settings.budget, settings.budget)
    return [
        Found(sequences[0], float(scores[0]), pool.flights)
        for sequences, scores in zip(pool.sequences, pool.scores, strict=True)
    ]


def fly_all(target: Target, sequences: FloatArray) -> FloatArray:
    """Return the scores (episodes, k) of sequences (episodes, k, steps, channels), in one batch."""
    count, each = sequences.shape[:2]
    episode = np.repeat(np.arange(count), each)
    flat = sequences.reshape(count * each, *sequences.shape[2:])
    return target.scores(episode, flat).reshape(count, each)


def _try(target: Target, pool: _Pool, sequences: FloatArray) -> None:
    if sequences.shape[1]:
        pool.add(sequences, fly_all(target, sequences))


def _explore(
    target: Target,
    settings: SearchSettings,
    name: str,
    pool: _Pool,
    streams: Sequence[np.random.Generator],
    budget: float,
) -> None:
    """Let one optimiser per episode ask, until the budget is spent."""
    kind = PARAMETRISATIONS[settings.parametrisation](
        target.steps, target.channels, settings.pieces
    )
    searches = [make_search(name, kind.dimension, settings.population, rng) for rng in streams]
    while pool.flights + settings.population <= budget:
        points = [one.ask() for one in searches]
        sequences = np.stack([kind.sequences(asked) for asked in points])
        scores = fly_all(target, sequences)
        pool.add(sequences, scores)
        for one, asked, values in zip(searches, points, scores, strict=True):
            one.tell(asked, values)


def _random_starts(
    target: Target, count: int, streams: Sequence[np.random.Generator]
) -> FloatArray:
    shape = (count, target.steps, target.channels)
    rays = []
    for rng in streams:
        direction = rng.standard_normal((count, 1, target.channels))
        rays.append(direction + _START_NOISE * rng.standard_normal(shape))
    return into_unit_ball(np.stack(rays) / _START_NOISE)


def _climb(target: Target, pool: _Pool, budget: int) -> None:
    """Move the best sequences of every episode along their slopes, until nothing is gained.

    A linear function on a product of balls is largest where every push has length one and lies
    along its slope; the next sequences lie between the present ones and that (conditional
    gradient), so that they never leave the balls.
    """
    ways = np.array(_WAYS)
    price = target.slope_cost + len(ways)
    rest = budget - pool.flights
    climbers = pool.size if pool.size * price <= rest else max(1, rest // (_ROUNDS * price))
    while True:
        count = min(climbers, *(len(values) for values in pool.scores))
        cost = count * price
        if count == 0 or pool.flights + cost > budget:
            return
        before = np.stack([values[:count] for values in pool.scores])
        here = np.stack([sequences[:count] for sequences in pool.sequences])
        flat = here.reshape(-1, target.steps, target.channels)
        slopes = target.slopes(np.repeat(np.arange(target.episodes), count), flat)
        # A push without influence stays as it is.
        rays = onto_unit_sphere(slopes, flat).reshape(here.shape)
        shares = ways[:, None, None]
        between = (1.0 - shares) * here[:, :, None] + shares * rays[:, :, None]
        moved = into_unit_ball(between.reshape(target.episodes, -1, target.steps, target.channels))
        scores = fly_all(target, moved)
        # Every climber keeps its best, so that one does not crowd out the others.
        each = scores.reshape(target.episodes, count, len(ways))
        best = np.argmax(each, axis=2)
        rows, columns = np.ogrid[: target.episodes, :count]
        chosen = moved.reshape(*each.shape, target.steps, target.channels)[rows, columns, best]
        gained = each[rows, columns, best] > before + 1e-9
        pool.spend(cost)
        for index in range(target.episodes):
            kept = np.where(gained[index][:, None, None], chosen[index], here[index])
            values = np.where(
                gained[index], each[index, np.arange(count), best[index]], before[index]
            )
            order = np.argsort(-values, kind="stable")
            pool.sequences[index][:count], pool.scores[index][:count] = kept[order], values[order]
        if not gained.any():
            return
