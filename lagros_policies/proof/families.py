"""Families of symmetric matrices that are to be negative definite on a whole set of triples.

For any control-affine system: the condition of Theorem 2, that over a hold of the control, and that
of a state with a deviation that is held. `BoxCondition` gives one of them to `cells.search`, over
the coordinates of a set. Those on which it does not depend are left out; those in which it is
affine are never cut, for their corners decide and nothing remains between.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import check_positive
from lagros_envs.dynamics import System, linearise_hold
from lagros_envs.numbers import Dual, Interval, Series, exact, functions, variable
from lagros_policies.contraction.metric import Metric
from lagros_policies.proof.cells import Examined, remainder
from lagros_policies.proof.enclosures import (
    NOTHING,
    constant,
    enclosed_metric,
    held_slopes,
    indexed,
    product,
    slopes,
    transposed,
    twice_symmetric,
)
from lagros_policies.proof.matrices import matmul
from lagros_policies.proof.sets import ProofSet, Triple

# From series at a triple to one of symmetric matrices (..., n, n).
Matrices = Callable[[Triple], Series]

# Cells along a coordinate in which the matrices are curved, between two cuts.
_FIRST = 4
# Each is looked at before the time of a search begins to count.
_MOST_PIECES = 10_000
# Corners at which a failure is looked for, the worst first.
_LOOKED_AT = 20


@dataclass(frozen=True)
class Violation:
    """A point at which interval arithmetic shows that the condition fails.

    Attributes:
        state: x, shape (n,).
        nominal: y, which may serve as x_d, shape (n,).
        control: u_d, shape (m,).
        place: Where the metric is taken, shape (n,): x, or the x_d of a metric of x_d.
    """

    state: FloatArray
    nominal: FloatArray
    control: FloatArray
    place: FloatArray


class BoxCondition:
    """Symmetric matrices on a set, for `cells.search`.

    Attributes:
        moving: Which coordinates of the set matter; cells are of these alone.

    Raises:
        ValueError: They depend on a coordinate that is not bounded.
    """

    def __init__(self, where: ProofSet, matrices: Matrices) -> None:
        """Find which coordinates matter, and along which the matrices are curved."""
        (self.where, free), self.matrices = _bounded(where), matrices
        lower, upper = self.where.lower, self.where.upper
        self.middle: FloatArray = 0.5 * (lower + upper)
        self.counts = np.ones(len(free), dtype=int)
        self.moving = np.arange(len(free))
        whole, moving = self.where.cells(self.counts.tolist()), []
        if len(whole.lower) > _MOST_PIECES:
            raise ValueError(
                f"the box of {len(free)} coordinates is {len(whole.lower)} pieces before a search "
                f"cuts any, more than {_MOST_PIECES}: there is no proof for so many states"
            )
        for index in np.flatnonzero(lower < upper):
            try:
                parts = self._along(whole, int(index), 2).parts
                slope, bend = (np.abs([part.lower, part.upper]).max() for part in parts[1:])
            except ZeroDivisionError:
                slope = bend = math.inf
            if max(slope, bend) > NOTHING:
                moving.append(index)
                self.counts[index] = _FIRST if bend > NOTHING else 1
        if np.any(free[moving]):
            named = ", ".join(str(index) for index in moving if free[index])
            raise ValueError(
                f"the condition depends on what is not bounded (coordinate {named} of the box): "
                "give it bounds"
            )
        self.moving = np.array(moving, dtype=int)

    def start(self) -> Interval:
        """Return the first cells (k, c) of the coordinates that matter."""
        counts = np.ones_like(self.counts)
        counts[self.moving] = self.counts[self.moving]
        return self.where.cells(counts.tolist())[:, self.moving]

    def examine(self, cells: Interval) -> Examined:
        """Enclose the matrices over cells (k, c)."""
        width = (cells.upper - cells.lower).T
        remainders = [
            remainder(self._along(cells, place, 2).derivative(2), width[place])
            for place in range(len(self.moving))
        ]
        return Examined(self.corners(cells), remainders, self._outside(cells))

    def corners(self, cells: Interval) -> Interval:
        """Enclose the matrices at the corners of cells, shape (k, 2^c, n, n)."""
        ends = np.stack([cells.lower, cells.upper], axis=-1)
        count, size = cells.shape
        shapes = 1 - np.eye(size, dtype=int) + 2 * np.eye(size, dtype=int)
        found = self._at(
            [exact(ends[:, i].reshape(count, *shapes[i])) for i in range(size)],
            [cells.midpoint[:, i].reshape(count, *[1] * size) for i in range(size)],
        )
        shape = count, *[2] * size, *found.shape[-2:]
        lower, upper = (np.broadcast_to(end, shape) for end in (found.lower, found.upper))
        final = count, 2**size, *shape[-2:]
        return Interval(lower.reshape(final), upper.reshape(final))

    def failure(self, cells: Interval) -> Violation | None:
        """Look for a corner at which the condition fails."""
        matrices = self.corners(cells)
        values, vectors = np.linalg.eigh(matrices.midpoint)
        ends = np.stack([cells.lower, cells.upper])
        for index in np.argsort(values[..., -1], axis=None)[::-1][:_LOOKED_AT]:
            cell, corner = np.unravel_index(index, values.shape[:2])
            if values[cell, corner, -1] <= 0.0:
                return None
            direction = exact(vectors[cell, corner, :, -1])
            form = matmul(matmul(direction[None, :], matrices[cell, corner]), direction[:, None])
            side = np.unravel_index(corner, [2] * len(self.moving))
            place = ends[np.array(side, dtype=int), cell, np.arange(len(self.moving))]
            if form.lower[0, 0] > 0.0 and not self._outside(Interval(place[None], place[None]))[0]:
                return self._point(place, cells.midpoint[cell])
        return None

    def _point(self, place: FloatArray, middle: FloatArray) -> Violation:
        """Return the triple at coordinates (c,)."""
        found = self._triple([exact(one) for one in place], list(middle), 0)
        parts = (
            np.array([_number(entry) for entry in part])
            for part in (found.state, found.between, found.control, found.place)
        )
        return Violation(*parts)

    def _triple(self, places: Sequence[Any], middle: Sequence[Any], order: int) -> Triple:
        """Return the triple at the coordinates that matter, as series."""
        every: list[Any] = [constant(one, order) for one in self.middle]
        middles: list[Any] = list(self.middle)
        for index, place, one in zip(self.moving, places, middle, strict=True):
            every[index] = place if isinstance(place, Series) else constant(place, order)
            middles[index] = one
        return self.where.triple(every, middles)

    def _at(self, places: Sequence[Any], middle: Sequence[Any]) -> Interval:
        return self.matrices(self._triple(places, middle, 0)).parts[0]

    def _along(self, cells: Interval, moving: int, order: int) -> Series:
        """Return the matrices as series in one of the coordinates, over cells (k, c)."""
        places: list[Any] = [cells[:, index] for index in range(cells.shape[1])]
        places[moving] = variable(places[moving], order)
        middle = list(cells.midpoint.T)
        return self.matrices(self._triple(places, middle, order))

    def _outside(self, cells: Interval) -> BoolArray:
        """Return which cells (k, c) hold no point of the set, shape (k,)."""
        lower, upper = (np.tile(self.middle, (len(cells.lower), 1)) for _ in range(2))
        lower[:, self.moving], upper[:, self.moving] = cells.lower, cells.upper
        return self.where.outside(Interval(lower, upper))


def rate_matrices(
    system: System, metric: Metric, rate: float, source: Interval | None = None
) -> Matrices:
    """Return the left side of (**), and a multiple of the identity more.

    Args:
        system: The system.
        metric: W_bar and nu.
        rate: alpha [1/s].
        source: The multiple: what a disturbance adds, see `contraction.tube_design`; None for zero.
    """
    eye, weight = np.eye(system.state_dim), -2.0 * metric.control_weight

    def matrices(at: Triple) -> Series:
        order = len(at.place[0].parts) - 1
        slope, _ = slopes(system, at.between, at.control)
        _, gain = slopes(system, at.state, [constant(0.0, order)] * system.control_dim)
        if metric.point == "state":
            _check_unmoved(system, metric, gain)
        motion = system.derivative(at.place, at.control, functions)
        dual = enclosed_metric(metric, [Dual(*one) for one in zip(at.place, motion, strict=True)])
        left = product(gain, transposed(gain)) * weight
        if isinstance(dual, Dual):
            left = left - dual.gradient
            dual = dual.value
        elif isinstance(dual, Interval):
            dual = constant(dual, order)
        left = left + twice_symmetric(product(slope, dual)) + dual * (2.0 * rate)
        whole: Series = left if source is None else left + source * eye
        return whole

    return matrices


def _check_unmoved(system: System, metric: Metric, gain: Series) -> None:
    rows = gain.parts[0][..., list(metric.coordinates), :]
    if max(np.abs(rows.lower).max(initial=0.0), np.abs(rows.upper).max(initial=0.0)) > NOTHING:
        raise ValueError(
            f"a control of {system!r} moves coordinates {metric.coordinates} of the state, of "
            "which the metric is a function: its rate is not known before the control is; give a "
            'metric of other coordinates, or one of x_d (point="nominal")'
        )


def lifted_matrices(system: System, dual: FloatArray, rest: Interval) -> Matrices:
    """Return 2 sym([J(y, u_d) B(x); 0 0] Q) + R, of the state and a deviation that is held.

    Args:
        system: The system.
        dual: Q, shape (n + m, n + m).
        rest: Enclosure of R, of the same shape.
    """
    size = system.state_dim + system.control_dim

    def matrices(at: Triple) -> Series:
        order = len(at.place[0].parts) - 1
        slope, _ = slopes(system, at.between, at.control)
        _, gain = slopes(system, at.state, [constant(0.0, order)] * system.control_dim)
        return twice_symmetric(product(_lifted(slope, gain, size), constant(dual, order))) + rest

    return matrices


def _lifted(slope: Series, gain: Series, size: int) -> Series:
    """Return [J B; 0 0] for J (..., n, n) and B (..., n, m), shape (..., size, size)."""
    parts = []
    for one, other in zip(slope.parts, gain.parts, strict=True):
        n = one.shape[-1]
        shape = np.broadcast_shapes(one.shape[:-2], other.shape[:-2])
        ends = np.zeros((2, *shape, size, size))
        for full, left, right in zip(
            ends, (one.lower, one.upper), (other.lower, other.upper), strict=True
        ):
            full[..., :n, :n], full[..., :n, n:] = left, right
        parts.append(Interval(*ends))
    return Series(parts)


def hold_matrices(
    system: System, metric: Metric, rate: float, period: float, where: ProofSet
) -> Matrices:
    """Return L (F W_bar F' - exp(-2 alpha h) W_bar') L', the condition over a hold of the control.

    With Phi the Runge-Kutta map of one hold (the one that the environment integrates), F = dPhi/dx
    and G = dPhi/du at x and u_d, W_bar' at Phi(x, u_d), and L of n - m rows with L G = 0. Then, for
    every displacement e of x, some deviation v makes (F e + G v)' M' (F e + G v) at most
    exp(-2 alpha h) e'M e, by a Schur complement; by Finsler's lemma it is the same to ask that
    F W_bar F' - nu_h G G' < exp(-2 alpha h) W_bar' for some nu_h. (W_bar must be positive definite
    at both ends.) That is the condition that `HeldControl` imposes, for an infinitesimal error: the
    sampled loop is contracting in the metric, at the rate alpha, while it stays in the set.

    L = [I, -G_1 G_2^-1] up to the order of the states, with m rows G_2 of G that are regular.

    Args:
        system: The system.
        metric: The metric.
        rate: alpha [1/s].
        period: Hold h [s].
        where: The set, in whose middle the rows of G_2 are chosen.
    """
    check_positive("rate", rate)
    check_positive("period", period)
    # The exponential of the library errs by less than one unit in the last place.
    decay = math.nextafter(math.exp(-2.0 * rate * period), 0.0)
    middle = _middle(where)
    state, control = (
        np.array([_number(x) for x in part]) for part in (middle.state, middle.control)
    )
    reached = _regular_rows(linearise_hold(system, state, control, period)[2])
    others = [row for row in range(system.state_dim) if row not in reached]

    def matrices(at: Triple) -> Series:
        order = len(at.place[0].parts) - 1
        following, slope, gain = held_slopes(system, at.place, at.control, period)
        rows = (indexed(gain, (..., one, slice(None))) for one in (others, reached))
        share = _quotient(*rows)

        def reduced(matrix: Series) -> Series:
            top, rest = (indexed(matrix, (..., rows, slice(None))) for rows in (others, reached))
            return top - product(share, rest)

        def dual(place: Sequence[Series]) -> Series:
            found = enclosed_metric(metric, place)
            return constant(found, order) if isinstance(found, Interval) else found

        left = reduced(slope)
        before = product(product(left, dual(at.place)), transposed(left))
        after = reduced(transposed(reduced(dual(following))))
        return before - after * decay

    return matrices


def held_ends(
    system: System, where: ProofSet, period: float, counts: Sequence[int]
) -> tuple[list[Interval], list[Interval]]:
    """Enclose the entries of the state before and after a hold, from cells of a set, each (k,).

    Args:
        system: The system.
        where: The set.
        period: Hold [s].
        counts: Cells along each coordinate.
    """
    where, _ = _bounded(where)
    cells = where.cells(counts)
    places = [constant(cells[:, index], 0) for index in range(cells.shape[1])]
    at = where.triple(places, list(cells.midpoint.T))
    ended, _, _ = held_slopes(system, at.state, at.control, period)
    return [one.parts[0] for one in at.state], [one.parts[0] for one in ended]


def _bounded(where: ProofSet) -> tuple[ProofSet, BoolArray]:
    """Return a set with some bounds for what has none, and which coordinates these are."""
    free = ~np.isfinite(where.lower)
    lower, upper = np.where(free, -1.0, where.lower), np.where(free, 1.0, where.upper)
    return replace(where, lower=lower, upper=upper), free


def _middle(where: ProofSet) -> Triple:
    """Return the triple in the middle of a set."""
    where, _ = _bounded(where)
    middle: list[FloatArray] = list(0.5 * (where.lower + where.upper))
    return where.triple([constant(one, 0) for one in middle], middle)


def _number(one: Series) -> float:
    return float(one.parts[0].midpoint)


def _regular_rows(gain: FloatArray) -> list[int]:
    """Return which m rows of G (n, m) to solve for: each time the longest that is left."""
    rest, rows = gain.copy(), []
    for _ in range(gain.shape[1]):
        sizes = np.linalg.norm(rest, axis=1)
        rows.append(int(np.argmax(sizes)))
        one = rest[rows[-1]] / max(float(sizes.max()), np.finfo(float).tiny)
        rest = rest - np.outer(rest @ one, one)
    return rows


def _quotient(left: Series, right: Series) -> Series:
    """Enclose L R^-1 for series of matrices (..., k, m) and (..., m, m), by elimination."""
    m = right.parts[0].shape[-1]
    # Operations on the columns of both that turn R into the identity.
    tops = [indexed(left, (..., slice(j, j + 1))) for j in range(m)]
    columns = [indexed(right, (..., slice(j, j + 1))) for j in range(m)]
    for row in range(m):
        at = (..., slice(row, row + 1), slice(None))
        pivot = indexed(columns[row], at)
        tops[row], columns[row] = tops[row] / pivot, columns[row] / pivot
        for other in range(m):
            if other != row:
                factor = indexed(columns[other], at)
                tops[other] = tops[other] - tops[row] * factor
                columns[other] = columns[other] - columns[row] * factor
    parts = []
    for order in range(len(left.parts)):
        ends = [top.parts[order] for top in tops]
        sides = ([end.lower for end in ends], [end.upper for end in ends])
        parts.append(Interval(*(np.concatenate(side, axis=-1) for side in sides)))
    return Series(parts)
