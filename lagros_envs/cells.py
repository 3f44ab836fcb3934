"""Who is near whom: square cells over worlds side by side, in place of all pairs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray, IntArray

# Sides are longer than what is looked for by more than the rounding of a cell's number.
_SLACK = 1.0 + 1e-9
_MOST = 2**20  # cells of all worlds, beyond which they become larger


class Offsets(NamedTuple):
    """Pairs that may be near each other, and how one lies from the other.

    Attributes:
        one: The first of each pair, as a place in (worlds * agents,), shape (p,).
        other: The second, as a place in (worlds * agents,) or (worlds * obstacles,), shape (p,).
        x: Coordinate of the other minus that of the one, shape (p,) [m].
        y: The same of the second coordinate [m].
        square: Squared distance, shape (p,) [m^2].
    """

    one: IntArray
    other: IntArray
    x: FloatArray
    y: FloatArray
    square: FloatArray

    @classmethod
    def between(
        cls, pairs: tuple[IntArray, IntArray], ones: FloatArray, others: FloatArray
    ) -> Offsets:
        """Return the offsets of pairs of places in points (2, n) and others (2, m)."""
        one, other = pairs
        x = others[0].take(other) - ones[0].take(one)
        y = others[1].take(other) - ones[1].take(one)
        return cls(one, other, x, y, x * x + y * y)

    def within(self, distance: float) -> Offsets:
        """Return those that are no further apart than a distance [m]."""
        kept = np.flatnonzero(self.square <= distance * distance)
        one, other, x, y, square = self
        return Offsets(
            one.take(kept), other.take(kept), x.take(kept), y.take(kept), square.take(kept)
        )


class Cells:
    """Square cells over a rectangle of each world; what lies outside counts to the nearest cell.

    Whatever is no further apart than the side of a cell is in the same cell or in neighbours,
    outside of the rectangle, too: to go to the nearest cell brings nobody apart.

    Args:
        low: Least corner of each rectangle, shape (worlds, 2) [m].
        high: Its opposite [m].
        reach: Distance up to which pairs are to be found [m].

    Attributes:
        side: Of a cell, at least the reach [m].
    """

    def __init__(self, low: FloatArray, high: FloatArray, reach: float) -> None:
        most = max(1.0, math.sqrt(_MOST / len(low)))
        self.side = max(reach * _SLACK, float(np.max(high - low)) / most)
        columns, rows = (
            (np.floor(np.max(high - low, axis=0) / self.side) + 3.0).astype(int).tolist()
        )
        # The first and the last of a row, and the first and the last row, stay empty: so the
        # neighbours of a cell are three runs of cells, whatever its place.
        self.columns, self.count = columns, len(low) * rows * columns
        self._low = low.T[:, :, None].copy()
        self._last = np.array([columns - 2, rows - 2], np.float64)[:, None, None]
        self._each = rows * columns
        self._begin = self._each * np.arange(len(low))[:, None]

    def keys(self, points: FloatArray) -> IntArray:
        """Return the cell of each point (2, worlds, n), shape (worlds * n,)."""
        at = (points - self._low) / self.side
        np.floor(at, out=at)
        at += 1.0
        np.clip(at, 1.0, self._last, out=at)
        column, row = at.astype(np.intp)
        row *= self.columns
        row += column
        row += self._begin
        keys: IntArray = row.reshape(-1)
        return keys

    def pairs(self, keys: IntArray) -> tuple[IntArray, IntArray]:
        """Return the pairs of neighbouring cells among points of these keys, each once."""
        order, first = self.sorted(keys)
        at = keys.take(order)
        # Of its own cell those that come after, and the next cell; then three cells of the row
        # above.
        starts = np.concatenate([np.arange(1, len(keys) + 1), first.take(at + (self.columns - 1))])
        ends = np.concatenate([first.take(at + 2), first.take(at + (self.columns + 2))])
        whose, place = _spread(starts, ends)
        whose[whose >= len(keys)] -= len(keys)
        return order.take(whose), order.take(place)

    def beside(self, keys: IntArray, across: IntArray, up: IntArray) -> tuple[IntArray, BoolArray]:
        """Return the cells so many cells away from each of these, and which of them there are.

        Args:
            keys: The cells, shape (n,).
            across: How many columns away, shape (s,).
            up: How many rows away, shape (s,).

        Returns:
            Both of shape (n, s).
        """
        world, at = np.divmod(keys, self._each)
        row, column = np.divmod(at, self.columns)
        rows, columns = row[:, None] + up, column[:, None] + across
        there = (rows >= 1) & (rows <= self._last[1, 0, 0])
        there &= (columns >= 1) & (columns <= self._last[0, 0, 0])
        found: IntArray = world[:, None] * self._each + rows * self.columns + columns
        return found, there

    def sorted(self, keys: IntArray) -> tuple[IntArray, IntArray]:
        """Return points in the order of their cells, and where in it each cell begins."""
        first = np.zeros(self.count + 1, np.intp)
        np.cumsum(np.bincount(keys, minlength=self.count), out=first[1:])
        # Few cells are sorted by counting.
        small = keys.astype(np.uint16) if self.count <= 2**16 else keys
        return np.argsort(small, kind="stable"), first


class Resting:
    """What stays where it is, by the cells from which it is near.

    Args:
        low: Least corner of a rectangle of each world, shape (worlds, 2) [m].
        high: Its opposite; all that is there lies between [m].
        points: Where it is, shape (2, worlds, k) [m].
        present: Which of them are there, shape (worlds, k).
        reach: Distance up to which pairs are to be found [m].
    """

    def __init__(
        self,
        low: FloatArray,
        high: FloatArray,
        points: FloatArray,
        present: BoolArray,
        reach: float,
    ) -> None:
        self.reach = reach
        # A quarter of the reach: what is looked at is then little more than what is near.
        self.cells = cells = Cells(low, high, 0.25 * reach)
        places = np.flatnonzero(present)
        home = cells.keys(points)[places]
        span = math.ceil(reach * _SLACK / cells.side)
        steps = np.arange(-span, span + 1)
        # A cell is near if its nearest point is, from wherever in its own cell something lies.
        apart = cells.side * np.maximum(np.abs(steps) - 1, 0)
        near = np.flatnonzero(apart[:, None] ** 2 + apart**2 <= (reach * _SLACK) ** 2)
        up, across = np.unravel_index(near, (len(steps), len(steps)))
        keys, there = cells.beside(home, steps[across], steps[up])
        whose = np.broadcast_to(places[:, None], keys.shape)[there]
        order, self._first = cells.sorted(keys[there])
        self._near = whose[order]

    def pairs(self, keys: IntArray) -> tuple[IntArray, IntArray]:
        """Return the pairs of points of these keys and what is near their cells."""
        whose, place = _spread(self._first.take(keys), self._first.take(keys + 1))
        return whose, self._near.take(place)


def _spread(starts: IntArray, ends: IntArray) -> tuple[IntArray, IntArray]:
    """Return all places of the ranges, one after the other, and the range of each."""
    counts = ends - starts
    after = np.cumsum(counts)
    whose = np.repeat(np.arange(len(starts)), counts)
    place = np.arange(len(whose)) + np.repeat(starts - after + counts, counts)
    return whose, place


def both_ways(one: IntArray, other: IntArray) -> tuple[IntArray, IntArray]:
    """Return pairs each both ways, in ascending order; they are given each once."""
    ones, others = np.concatenate([one, other]), np.concatenate([other, one])
    order = np.argsort(ones * (ones.max(initial=0) + 1) + others)
    return ones[order], others[order]


@lru_cache(maxsize=8)
def all_pairs(worlds: int, agents: int) -> tuple[IntArray, IntArray]:
    """Return every pair of agents of a world both ways, as places in (worlds * agents,)."""
    first, second = np.nonzero(~np.eye(agents, dtype=bool))
    begin = agents * np.arange(worlds)[:, None]
    return (begin + first).reshape(-1), (begin + second).reshape(-1)


@lru_cache(maxsize=8)
def all_beside(worlds: int, agents: int, obstacles: int) -> tuple[IntArray, IntArray]:
    """Return every agent with every obstacle of its world, as places."""
    agent = np.repeat(np.arange(worlds * agents), obstacles)
    begin = obstacles * np.repeat(np.arange(worlds), agents)
    return agent, (begin[:, None] + np.arange(obstacles)).reshape(-1)
