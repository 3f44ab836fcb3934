"""Points placed at random in a square, apart from each other: starts, goals and obstacles."""

from __future__ import annotations

import math
import sys
from typing import cast

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray

DRAWS = 16  # of one point or pair at a time ...
ROUNDS = 12  # ... and how often, before the attempt is given up
_FEW = 3  # of the draws, looked at before the others


def most_apart(arena: float, apart: float) -> int:
    """Return a bound of how many points of a square lie apart from each other (Oler 1961).

    Args:
        arena: Side of the square [m].
        apart: Least distance between two of them, above zero [m].
    """
    ratio = arena / apart
    # Rounding must refuse no number that fits.
    bound = 2.0 / math.sqrt(3.0) * ratio * ratio + 2.0 * ratio + 1.0
    return math.floor(bound * (1.0 + 1e-12)) if math.isfinite(bound) else sys.maxsize


def most_apart_in_disc(radius: float, apart: float) -> int:
    """Return the same bound for a disc: 2 / sqrt(3) area / d^2 + perimeter / 2 d + 1 (Oler 1961).

    Args:
        radius: Of the disc [m].
        apart: Least distance between two of the points, above zero [m].
    """
    ratio = radius / apart
    bound = 2.0 / math.sqrt(3.0) * math.pi * ratio * ratio + math.pi * ratio + 1.0
    return math.floor(bound * (1.0 + 1e-12)) if math.isfinite(bound) else sys.maxsize


def scatter(rng: np.random.Generator, arena: float, count: int, apart: float) -> FloatArray | None:
    """Place points one by one, uniformly in a square.

    Args:
        rng: Source of the draws.
        arena: Side of the square [m].
        count: n, points.
        apart: Least distance between two of them [m].

    Returns:
        The points, shape (n, 2); None where one found no place in all of its draws.
    """
    placed = np.empty((count, 2))
    for index in range(count):
        for _ in range(ROUNDS):
            draws = rng.uniform(0.0, arena, (DRAWS, 2))
            fits = _first_clear(draws, placed[:index], apart**2)
            if fits is not None:
                placed[index] = draws[fits]
                break
        else:
            return None
    return placed


class Room:
    """Where pairs of a start and a goal find a place, uniformly in a square.

    Args:
        arena: Side of the square [m].
        apart: Least distance between two starts, and between two goals [m].
        least_way: Least distance from a start to its goal [m].
        obstacles: Centres, shape (k, 2) [m].
        clearance: Least distance from each centre, shape (k,) [m].
    """

    def __init__(
        self,
        arena: float,
        apart: float,
        least_way: float,
        obstacles: FloatArray,
        clearance: FloatArray,
    ) -> None:
        self.arena, self.apart, self.least_way = arena, apart, least_way
        self.obstacles, self.clearance = obstacles, clearance

    def scatter(self, rng: np.random.Generator, count: int) -> FloatArray | None:
        """Place pairs one after the other.

        Args:
            rng: Source of the draws.
            count: n, pairs.

        Returns:
            Starts and goals side by side, (n, 4); None where one found no place in its draws.
        """
        first = len(self.obstacles)
        placed, squares = self._kept(count)
        for agent in range(first, first + count):
            pair = self._pair(rng, placed[:agent], squares[:agent])
            if pair is None:
                return None
            placed[agent] = pair
        return placed[first:]

    def place(self, rng: np.random.Generator, others: FloatArray) -> FloatArray | None:
        """Place one pair among others (n, 4); return it, (4,), or None as `scatter` does."""
        placed, squares = self._kept(len(others))
        placed[len(self.obstacles) :] = others
        return self._pair(rng, placed, squares)

    def _kept(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the obstacles with room for pairs after them, and the squares of what to keep."""
        first = len(self.obstacles)
        placed = np.empty((first + count, 4))
        placed[:first] = np.tile(self.obstacles, 2)
        squares = np.full(first + count, self.apart**2)
        squares[:first] = self.clearance**2
        return placed, squares

    def _pair(
        self, rng: np.random.Generator, placed: FloatArray, squares: FloatArray
    ) -> FloatArray | None:
        for _ in range(ROUNDS):
            draws = rng.uniform(0.0, self.arena, (2, DRAWS, 2))
            way = draws[0] - draws[1]
            far = np.flatnonzero(_square(way[:, 0], way[:, 1]) >= self.least_way**2)
            ends = np.concatenate([draws[0, far], draws[1, far]], axis=1)
            fits = _first_clear(ends, placed, squares)
            if fits is not None:
                found: FloatArray = ends[fits]
                return found
        return None


def clear(points: FloatArray, others: FloatArray, distance: FloatArray) -> BoolArray:
    """Tell which points (p, 2) keep the distances (q,) to all the others (q, 2)."""
    return _clear_squares(points, others, distance**2)


def _first_clear(points: FloatArray, others: FloatArray, squares: FloatArray | float) -> int | None:
    """Return the first of the points (p, 2 or 4) that is clear of all the others, or None.

    Where there is room the first few will do, where there are many others, which are dear.
    """
    for part in (slice(0, _FEW), slice(_FEW, None)):
        clear = _clear_squares(points[part], others, squares)
        if clear.any():
            return int(part.start + np.argmax(clear))
    return None


def _clear_squares(
    points: FloatArray, others: FloatArray, squares: FloatArray | float
) -> BoolArray:
    """Tell which points keep the distances, given as squares (q,), to all the others.

    Points (p, 2) and others (q, 2) are positions; with four columns they are pairs of positions,
    each of which keeps its distance to its own kind.
    """
    fits = np.ones((len(points), len(others)), dtype=np.bool_)
    for axis in range(0, points.shape[1], 2):
        x = points[:, axis, None] - others[:, axis]
        y = points[:, axis + 1, None] - others[:, axis + 1]
        fits &= _square(x, y) >= squares
    return cast(BoolArray, fits.all(axis=1))


def _square(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the squared length of vectors, shape of both."""
    return x * x + y * y
