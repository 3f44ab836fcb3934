"""The sets on which a condition is proved: triples (x, y, u_d) by coordinates of a box."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.dynamics import System
from lagros_envs.numbers import Interval
from lagros_policies.contraction.places import Point
from lagros_policies.contraction.regions import BoxRegion
from lagros_policies.contraction.systems import check_sizes
from lagros_policies.proof.cells import mesh

# Far above the rounding of a bound of an error, relative.
_WIDER = 1.0 + 1e-12


@dataclass(frozen=True)
class Triple:
    """Where a condition is asked for; each a list of numbers of one kind.

    Attributes:
        place: Where the metric is taken: x, or x_d of a metric of x_d.
        between: y, on the segment from x_d to x, where the motion is differentiated.
        state: x, where B is taken.
        control: u_d.
    """

    place: Sequence[Any]
    between: Sequence[Any]
    state: Sequence[Any]
    control: Sequence[Any]


def _none_outside(cells: Interval) -> BoolArray:
    return np.zeros(len(cells.lower), dtype=bool)


@dataclass(frozen=True)
class ProofSet:
    """A set of triples: the image of a box of coordinates.

    Attributes:
        lower: Lower ends of the coordinates, shape (c,). Infinite ones are for coordinates on which
            no condition depends.
        upper: Upper ends; those that are the lower ones make numbers of their coordinates.
        triple: From coordinates and the middle of their cell to the triple. It is smooth between
            `cuts`, and the middle says between which of them.
        cuts: Where the box is cut at first, by coordinate.
        outside: Which cells (k, c) hold no point of the set, shape (k,).
    """

    lower: FloatArray
    upper: FloatArray
    triple: Callable[[Sequence[Any], Sequence[FloatArray]], Triple]
    cuts: Sequence[Sequence[float]]
    outside: Callable[[Interval], BoolArray] = _none_outside

    def cells(self, counts: Sequence[int]) -> Interval:
        """Return cells (k, c): the box at its cuts, and every piece in so many equal parts."""
        ends = []
        for low, high, cuts, most in zip(self.lower, self.upper, self.cuts, counts, strict=True):
            count = most if low < high else 1
            inner = sorted({cut for cut in cuts if low < cut < high})
            pieces = np.array([low, *inner, high])
            shares = np.arange(count) / count
            parts = pieces[:-1, None] + np.diff(pieces)[:, None] * shares
            ends.append(np.append(parts.ravel(), high))
        found = mesh(ends)
        return found[~self.outside(found)]


class Provable(Protocol):
    """A set of triples with a shape of its own; a `BoxRegion` is one that needs nothing more."""

    def proof_set(self, system: System, point: Point) -> ProofSet:
        """Return the triples (x, y, u_d), for a metric of x or of x_d."""

    def held_set(self, system: System) -> ProofSet:
        """Return the pairs (x, u_d), as triples with y = x_d = x."""


def triples(box: BoxRegion | Provable, system: System, point: Point) -> ProofSet:
    """Return the triples of a box, for a metric of x or of x_d.

    Raises:
        TypeError: The box is of the states of another system.
        ValueError: Likewise.
    """
    if not isinstance(box, BoxRegion):
        return box.proof_set(system, point)
    _check_box(box, system)
    return boxed(box.low, box.high, box.error, box.control_low, box.control_high, point)


def held_triples(box: BoxRegion | Provable, system: System) -> ProofSet:
    """Return the pairs (x, u_d) of a box as triples with y = x_d = x; as `triples`."""
    if not isinstance(box, BoxRegion):
        return box.held_set(system)
    _check_box(box, system)
    return boxed(box.low, box.high, [0.0] * len(box.low), box.control_low, box.control_high)


def _check_box(box: BoxRegion, system: System) -> None:
    bounds = {
        "low": (box.low, system.state_dim),
        "control_low": (box.control_low, system.control_dim),
    }
    check_sizes(system, **{name: (np.array(end), (size,)) for name, (end, size) in bounds.items()})


def boxed(
    low: ArrayLike,
    high: ArrayLike,
    error: ArrayLike,
    control_low: ArrayLike,
    control_high: ArrayLike,
    point: Point = "state",
) -> ProofSet:
    """Return all triples with x and x_d in a box and no further apart than the errors.

    The coordinates are y; x, and x_d where the metric is of it, each as a share of what the box and
    the errors leave around y; and u_d.

    Args:
        low: Lower bounds of x and x_d, shape (n,); an infinite one where nothing depends on it.
        high: Upper bounds.
        error: Largest |x_i - x_d,i|, shape (n,).
        control_low: Lower bounds of u_d, shape (m,).
        control_high: Upper bounds.
        point: Whether the metric is a function of x or of x_d.
    """
    least, largest, far = (np.array(end, dtype=np.float64) for end in (low, high, error))
    ends = [np.array(end, dtype=np.float64) for end in (control_low, control_high)]
    n, near = len(least), 1 if point == "state" else 2
    same = far == 0.0
    apart = ~same & (~(far < largest - least) | ~np.isfinite(least))
    reach = np.where(apart, 0.0, far * _WIDER)

    def beside(
        between: Sequence[Any], middle: Sequence[FloatArray], share: Sequence[Any]
    ) -> list[Any]:
        found = []
        for index, one in enumerate(between):
            if same[index] or apart[index]:
                found.append(one if same[index] else share[index])
                continue
            inner = least[index] + reach[index], largest[index] - reach[index]
            # Which of the two bounds counts is the same for a whole cell.
            below = (one - inner[0]) * (1.0 * (middle[index] > inner[0])) + least[index]
            above = (one - inner[1]) * (1.0 * (middle[index] < inner[1])) + largest[index]
            found.append(below + (above - below) * share[index])
        return found

    def triple(coordinates: Sequence[Any], middle: Sequence[FloatArray]) -> Triple:
        between, rest = coordinates[:n], coordinates[n:]
        place = beside(between, middle, rest[:n])
        state = place if point == "state" else beside(between, middle, rest[n : 2 * n])
        return Triple(place, between, state, rest[near * n :])

    # Of what is near: its share of what is left, or the coordinate itself.
    shares = np.where(apart, least, 0.0), np.where(apart, largest, np.where(same, 0.0, 1.0))
    cuts: list[Sequence[float]] = [*zip(least + reach, largest - reach, strict=True)]
    return ProofSet(
        np.concatenate([least, *[shares[0]] * near, ends[0]]),
        np.concatenate([largest, *[shares[1]] * near, ends[1]]),
        triple,
        [*cuts, *[()] * (near * n + len(ends[0]))],
    )
