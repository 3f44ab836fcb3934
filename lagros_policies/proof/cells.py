"""Search for a proof that symmetric matrices are negative definite on a continuous box.

The box is cut into cells. On a cell with edges h_i a smooth F(z) differs from the multilinear
interpolation of its corners by sum_i t_i h_i^2 / 8 d^2F/dz_i^2 with some |t_i| <= 1 and second
derivatives from the cell, entry by entry. So F is negative definite on the cell if it is at the
corners with any such remainder, for the sum of negative definite matrices is one. The remainder
falls with the square of the edge; a cell that fails is halved.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.numbers import Interval
from lagros_policies.proof.matrices import negative_definite

Failure = TypeVar("Failure")
FailureOut = TypeVar("FailureOut", covariant=True)

# Rounding of edges, squares and sums of remainders, relative.
_ROUNDING = 1.0 + 1e-12


@dataclass(frozen=True)
class Examined:
    """What is known of k cells.

    Attributes:
        corners: The matrices at the corners, shape (k, v, n, n).
        remainders: h_i^2 / 8 d^2F/dz_i^2 for each coordinate in which F is interpolated, (k, n, n).
        empty: Which cells hold no point of the set, shape (k,).
    """

    corners: Interval
    remainders: list[Interval]
    empty: BoolArray


class Condition(Protocol[FailureOut]):
    """A family of symmetric matrices over cells of a box."""

    def start(self) -> Interval:
        """Return cells (k, c) that cover the set."""

    def examine(self, cells: Interval) -> Examined:
        """Enclose the matrices over cells (k, c)."""

    def failure(self, cells: Interval) -> FailureOut | None:
        """Return a point of the cells (k, c) at which the condition is shown to fail, or None."""


@dataclass(frozen=True)
class Search(Generic[Failure]):
    """What the search came to.

    Attributes:
        proved: Whether the condition holds on the whole box.
        cells: Cells examined.
        seconds: Time taken [s].
        failure: Where the condition was shown to fail, or None.
        undecided: Ends (2, c) of one cell left undecided; None if proved or failed.
    """

    proved: bool
    cells: int
    seconds: float
    failure: Failure | None = None
    undecided: FloatArray | None = None


def search(
    condition: Condition[Failure], batch: int, most_cells: int, most_seconds: float
) -> Search[Failure]:
    """Halve cells until the condition is proved on all of them, fails on one, or time is up.

    Args:
        condition: What to prove.
        batch: Cells of one pass.
        most_cells: Cells after which the search gives up.
        most_seconds: Processor time of this thread after which it gives up [s], so that a busy
            machine does not turn a proof into none.
    """
    start, begun = time.monotonic(), time.thread_time()
    waiting = condition.start()
    seen = 0
    whole = np.ptp(np.concatenate([waiting.lower, waiting.upper]), axis=0)
    while len(waiting.lower):
        # The newest first: depth first finds a failure soon and keeps the list short.
        some, rest = waiting[-batch:], waiting[:-batch]
        seen += len(some.lower)
        left, effects = _examined(condition, some, whole)
        some, effects = some[left], effects[left]
        failure = _failed(condition, some)
        if failure is not None:
            return Search(False, seen, time.monotonic() - start, failure)
        late = time.thread_time() - begun > most_seconds or seen >= most_cells
        # Where no coordinate matters, halves are no better.
        late = late or not effects.shape[1]
        if late and len(some.lower) + len(rest.lower):
            cell = (some if len(some.lower) else rest)[-1]
            ends = np.stack([cell.lower, cell.upper])
            return Search(False, seen, time.monotonic() - start, undecided=ends)
        if not len(some.lower):
            waiting = rest
            continue
        low, high = _halves(some, effects)
        waiting = Interval(np.concatenate([rest.lower, low]), np.concatenate([rest.upper, high]))
    return Search(True, seen, time.monotonic() - start)


def _examined(
    condition: Condition[Failure], cells: Interval, whole: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Return which cells (k,) are not proved, and how much each coordinate matters, (k, c)."""
    try:
        found = condition.examine(cells)
    except ZeroDivisionError:
        # Some cell is too wide for its intervals: halve them all where they are widest.
        width = (cells.upper - cells.lower) / np.where(whole > 0.0, whole, 1.0)
        return np.ones(len(cells.lower), dtype=bool), width
    added = [part[:, None] for part in found.remainders]
    definite = np.all(negative_definite(found.corners, added), axis=-1)
    return ~(found.empty | definite), _sizes(found)


def _failed(condition: Condition[Failure], cells: Interval) -> Failure | None:
    """Return a failure in cells, if there are any and one can be shown."""
    try:
        return condition.failure(cells) if len(cells.lower) else None
    except ZeroDivisionError:
        return None


def grid(lower: FloatArray, upper: FloatArray, counts: tuple[int, ...]) -> Interval:
    """Cut one box into equal cells.

    Args:
        lower: Lower ends, shape (c,).
        upper: Upper ends, shape (c,).
        counts: Cells along each coordinate.

    Returns:
        The cells, shape (product of the counts, c).
    """
    return mesh([np.linspace(a, b, n + 1) for a, b, n in zip(lower, upper, counts, strict=True)])


def mesh(cuts: Sequence[FloatArray]) -> Interval:
    """Return the cells between cuts of each coordinate, shape (product of their numbers, c)."""
    low = np.stack(np.meshgrid(*[cut[:-1] for cut in cuts], indexing="ij"), axis=-1)
    high = np.stack(np.meshgrid(*[cut[1:] for cut in cuts], indexing="ij"), axis=-1)
    return Interval(low.reshape(-1, len(cuts)), high.reshape(-1, len(cuts)))


def remainder(second: Interval, width: FloatArray) -> Interval:
    """Enclose the remainder of linear interpolation, h^2/8 F''.

    Args:
        second: Enclosure of F'' over the cell, shape (k, n, n).
        width: h, shape (k,).

    Returns:
        The remainder, up to a factor from -1 to 1, shape (k, n, n).
    """
    return second * (width * width * (_ROUNDING / 8.0))[:, None, None]


def _sizes(found: Examined) -> FloatArray:
    """Return how large the remainders are beside the matrices themselves, shape (k, c)."""
    middle = found.corners.midpoint.mean(axis=1)
    values, vectors = np.linalg.eigh(0.5 * (middle + np.swapaxes(middle, -1, -2)))
    basis = vectors / np.sqrt(np.maximum(np.abs(values), 1e-9))[..., None, :]
    turned = np.swapaxes(basis, -1, -2)
    norms = []
    for part in found.remainders:
        size = np.abs(turned @ part.midpoint @ basis)
        size += np.abs(turned) @ part.radius @ np.abs(basis)
        norms.append(np.sum(size**2, axis=(-1, -2)))
    if not norms:
        return np.zeros((len(values), 0))
    sizes: FloatArray = np.sqrt(np.stack(norms, axis=-1))
    return sizes


def _halves(cells: Interval, effects: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Halve each cell across the coordinate of the largest remainder; ends (2k, c)."""
    rows = np.arange(len(cells.lower))
    along = np.argmax(np.where(cells.upper > cells.lower, effects, -math.inf), axis=-1)
    cut = cells.midpoint[rows, along]
    first_high, second_low = cells.upper.copy(), cells.lower.copy()
    first_high[rows, along] = cut
    second_low[rows, along] = cut
    return np.concatenate([cells.lower, second_low]), np.concatenate([first_high, cells.upper])
