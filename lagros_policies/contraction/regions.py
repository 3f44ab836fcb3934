"""Where a metric is claimed to contract: sets of triples (x, x_d, u_d), drawn from and asked about.

`BoxRegion` bounds every coordinate; `PlanRegion` surrounds given plans, on which control and state
go together as they do not in a box. A region of one's own may also say, in `even`, in which
coordinate it is symmetric about zero and how far that reaches: a metric of that one alone, even in
it, is then looked at on a grid; and in `scaling` in which units a condition number is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import BoolArray, FloatArray, IntArray
from lagros_envs.checks import check_fields, check_positive, check_whole, is_number, shown

moved_names(__name__)
Numbers = tuple[float, ...]

# Triples that the search for a maximum begins with, follows, and tries around each.
_BEGIN = 4000
_FOLLOWED = 8
_TRIED = 32
_ROUNDS = 30
_SHRINK = 0.7  # of the moves, from one round to the next


@dataclass(frozen=True)
class Samples:
    """Triples at which the condition is imposed or checked.

    Attributes:
        state: x, shape (s, n).
        nominal: x_d, shape (s, n).
        nominal_control: u_d, shape (s, m).

    Raises:
        ValueError: The shapes do not fit each other, or a number is not finite.
    """

    state: FloatArray
    nominal: FloatArray
    nominal_control: FloatArray

    def __post_init__(self) -> None:
        shapes = [np.shape(getattr(self, item.name)) for item in fields(self)]
        if (
            [len(shape) for shape in shapes] != [2, 2, 2]
            or shapes[0] != shapes[1]
            or shapes[0][0] != shapes[2][0]
        ):
            raise ValueError(
                f"state, nominal and nominal_control of shapes {shapes} must be (s, n), (s, n) and "
                "(s, m)"
            )
        for item in fields(self):
            if not np.all(np.isfinite(getattr(self, item.name))):
                raise ValueError(f"{item.name} must be finite: leave such samples out")

    def take(self, index: IntArray) -> Samples:
        """Return the samples with these indices."""
        return Samples(self.state[index], self.nominal[index], self.nominal_control[index])


def joined(*parts: Samples) -> Samples:
    """Return all samples of several, in order."""
    return Samples(
        np.concatenate([part.state for part in parts]),
        np.concatenate([part.nominal for part in parts]),
        np.concatenate([part.nominal_control for part in parts]),
    )


def even_coordinate(region: Any) -> tuple[int, float] | None:
    """Return in which coordinate a region is symmetric, and how far that reaches; None for none."""
    found: tuple[int, float] | None = getattr(region, "even", None)
    return found


class MetricRegion(Protocol):
    """The triples (x, x_d, u_d) for which a metric is designed and checked."""

    def sample(self, rng: np.random.Generator, count: int) -> Samples:
        """Draw triples of the region."""

    def contains(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> BoolArray:
        """Return which triples of a batch (..., n), (..., n), (..., m) lie inside, shape (...)."""


@dataclass(frozen=True)
class BoxRegion:
    """Bounds of every coordinate of x and x_d, of their difference, and of every control.

    An infinite bound leaves a coordinate free; it is drawn within one unit then.

    Attributes:
        low: Lower bounds of x and x_d, one per state.
        high: Upper bounds.
        error: Largest |x_i - x_d,i|, one per state.
        control_low: Lower bounds of u_d, one per control.
        control_high: Upper bounds.

    Raises:
        ValueError: The lengths differ, or a lower bound is not below its upper bound.
    """

    low: Sequence[float]
    high: Sequence[float]
    error: Sequence[float]
    control_low: tuple[float, ...]
    control_high: tuple[float, ...]

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("low", "high", "error"):
            value = getattr(self, name)
            numbers = isinstance(value, tuple) and all(is_number(one) for one in value)
            if not numbers or np.any(np.isnan(value)):
                raise ValueError(f"{name}={shown(value)} must be a tuple, each entry a number")
        pairs = {"low": "high", "control_low": "control_high", "error": "low"}
        for one, other in pairs.items():
            if len(getattr(self, one)) != len(getattr(self, other)) or not getattr(self, one):
                raise ValueError(
                    f"{one}={getattr(self, one)!r} and {other}={getattr(self, other)!r} must be of "
                    "one length, an entry per state or per control"
                )
        for one, other in (("low", "high"), ("control_low", "control_high")):
            if not np.all(np.less(getattr(self, one), getattr(self, other))):
                raise ValueError(
                    f"{one}={getattr(self, one)!r} must be below {other}={getattr(self, other)!r}"
                )
        if np.any(np.isfinite(self.low) != np.isfinite(self.high)):
            raise ValueError(f"low={self.low!r} must be infinite where high={self.high!r} is")
        for value in self.error:
            if value != np.inf:
                check_positive("error", value)

    def scaled(self, factor: float) -> BoxRegion:
        """Return the box with its sizes about the same middle, and its errors, times a factor."""

        def ends(low: Sequence[float], high: Sequence[float]) -> list[Numbers]:
            sides = np.array([low, high])
            middle = np.where(np.isfinite(sides).all(axis=0), sides, 0.0).mean(axis=0)
            return [tuple(side.tolist()) for side in middle + factor * (sides - middle)]

        low, high = ends(self.low, self.high)
        error = tuple(factor * value for value in self.error)
        return BoxRegion(low, high, error, *ends(self.control_low, self.control_high))

    def sample(self, rng: np.random.Generator, count: int) -> Samples:
        """Draw triples: x_d and u_d uniform in their bounds, x in what the error leaves of them."""
        check_whole("count", count)
        low, high, error = (
            np.where(np.isfinite(end), end, unit)
            for end, unit in ((self.low, -1.0), (self.high, 1.0), (self.error, 1.0))
        )
        nominal = rng.uniform(low, high, (count, len(low)))
        state = rng.uniform(np.maximum(low, nominal - error), np.minimum(high, nominal + error))
        control = rng.uniform(self.control_low, self.control_high, (count, len(self.control_low)))
        return Samples(state, nominal, control)

    def contains(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> BoolArray:
        """Return which triples of a batch (..., n), (..., n), (..., m) lie inside.

        Raises:
            ValueError: They are of other states or controls.
        """
        _check_ends(len(self.low), len(self.control_low), state, nominal, nominal_control)
        inside = _within(nominal_control, self.control_low, self.control_high)
        for point in (state, nominal):
            inside &= _within(point, self.low, self.high)
        error = np.array(self.error)
        # The difference of two numbers rounds; what was drawn at the edge is inside.
        slack = 4.0 * np.spacing(np.maximum(np.abs(state), np.abs(nominal)))
        inside &= np.all(np.abs(state - nominal) <= error + slack, axis=-1)
        return inside


@dataclass(frozen=True, eq=False)
class PlanRegion:
    """A cloud around plans: x_d and u_d near one of their nodes, and x near x_d.

    Attributes:
        nominal: x_d of the nodes, shape (k, n).
        nominal_control: u_d of the nodes, shape (k, m).
        reach: Largest distance of x_d from its node, one per state.
        control_reach: The same of u_d, one per control.
        error: Largest |x_i - x_d,i|, one per state.

    Raises:
        ValueError: The lengths differ, there is no node, or a number is not positive and finite.
    """

    nominal: FloatArray
    nominal_control: FloatArray
    reach: FloatArray
    control_reach: FloatArray
    error: FloatArray

    def __post_init__(self) -> None:
        for item in fields(self):
            array = np.array(getattr(self, item.name), dtype=np.float64)
            object.__setattr__(self, item.name, array)
        Samples(self.nominal, self.nominal, self.nominal_control)
        if len(self.nominal) == 0:
            raise ValueError("nominal: there must be one node or more")
        states, controls = self.nominal.shape[1:], self.nominal_control.shape[1:]
        for name, shape in (("reach", states), ("control_reach", controls), ("error", states)):
            array = getattr(self, name)
            if array.shape != shape:
                raise ValueError(f"{name} of shape {array.shape} must be {shape}")
            for value in array.tolist():
                check_positive(name, value)

    def sample(self, rng: np.random.Generator, count: int) -> Samples:
        """Draw triples: a node, x_d and u_d around it, and x around x_d, each uniform."""
        check_whole("count", count)
        node = rng.integers(len(self.nominal), size=count)
        sizes = self.reach, self.control_reach, self.error
        near, control, error = (rng.uniform(-size, size, (count, len(size))) for size in sizes)
        nominal = self.nominal[node] + near
        return Samples(nominal + error, nominal, self.nominal_control[node] + control)

    def contains(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> BoolArray:
        """Return which triples of a batch (..., n), (..., n), (..., m) lie inside.

        Raises:
            ValueError: They are of other states or controls.
        """
        from scipy.spatial import cKDTree

        _check_ends(len(self.reach), len(self.control_reach), state, nominal, nominal_control)
        units = np.concatenate([self.reach, self.control_reach])
        nodes = np.concatenate([self.nominal, self.nominal_control], axis=1)
        shape = np.broadcast_shapes(nominal.shape[:-1], nominal_control.shape[:-1])
        parts = [
            np.broadcast_to(part, (*shape, part.shape[-1])) for part in (nominal, nominal_control)
        ]
        points = np.concatenate(parts, axis=-1) / units
        distance, _ = cKDTree(nodes / units).query(points, p=np.inf)
        inside = np.asarray(distance <= 1.0 + 1e-9)
        near = np.all(np.abs(state - nominal) <= self.error * (1.0 + 1e-9), axis=-1)
        return np.asarray(inside & near, dtype=np.bool_)


def search_region(
    region: MetricRegion,
    score: Callable[[Samples], FloatArray],
    rng: np.random.Generator,
    begin: int = _BEGIN,
) -> tuple[Samples, FloatArray]:
    """Look for the triples of a region at which a figure is largest (observed).

    Random triples first; then, around the largest of each part of them, ever smaller moves of some
    of their coordinates that stay inside.

    Args:
        region: The region.
        score: From triples to one figure each, shape (s,).
        rng: Random generator.
        begin: Triples to begin with.

    Returns:
        The triples that the search ended at, the largest first, and their figures.
    """
    drawn = region.sample(rng, begin)
    figures = score(drawn)
    # One of each part of them: the largest may all lie beside each other.
    rows = np.array_split(np.arange(begin), min(_FOLLOWED, begin))
    best = np.array([row[np.argmax(figures[row])] for row in rows])
    parts = drawn.nominal, drawn.state - drawn.nominal, drawn.nominal_control
    spread = np.concatenate([np.ptp(part, axis=0) for part in parts])
    found, figures = drawn.take(best), figures[best]
    for level in range(_ROUNDS):
        shape = (len(figures), _TRIED, len(spread))
        # Of few coordinates or of many: at a corner few moves of many stay inside.
        chosen = rng.random(shape) < rng.random((*shape[:2], 1))
        moves = rng.uniform(-1.0, 1.0, shape) * chosen * spread * _SHRINK**level
        tried = _moved(found, moves)
        inside = region.contains(tried.state, tried.nominal, tried.nominal_control)
        reached = np.where(inside, score(tried), -np.inf).reshape(shape[:2])
        every = np.arange(len(figures))
        winner = np.argmax(reached, axis=1)
        better = reached[every, winner] > figures
        reached_by = tried.take(every * _TRIED + winner)
        found = Samples(
            np.where(better[:, None], reached_by.state, found.state),
            np.where(better[:, None], reached_by.nominal, found.nominal),
            np.where(better[:, None], reached_by.nominal_control, found.nominal_control),
        )
        figures = np.where(better, reached[every, winner], figures)
    order = np.argsort(-figures)
    return found.take(order), figures[order]


def _moved(found: Samples, moves: FloatArray) -> Samples:
    """Return the triples moved by (k, tried, n + n + m), shape (k tried, ...)."""
    n = found.state.shape[1]
    nominal = found.nominal[:, None] + moves[..., :n]
    error = (found.state - found.nominal)[:, None] + moves[..., n : 2 * n]
    control = found.nominal_control[:, None] + moves[..., 2 * n :]
    return Samples(
        (nominal + error).reshape(-1, n),
        nominal.reshape(-1, n),
        control.reshape(len(nominal.reshape(-1, n)), -1),
    )


def _within(point: FloatArray, low: Sequence[float], high: Sequence[float]) -> BoolArray:
    inside: BoolArray = np.all((point >= low) & (point <= high), axis=-1)
    return inside


def _check_ends(
    states: int,
    controls: int,
    state: FloatArray,
    nominal: FloatArray,
    nominal_control: FloatArray,
) -> None:
    ends = [np.shape(part)[-1:] for part in (state, nominal, nominal_control)]
    if ends != [(states,), (states,), (controls,)]:
        raise ValueError(
            f"states and control end in {ends}: the region is of {states} states and {controls} "
            "controls"
        )
