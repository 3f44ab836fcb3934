"""Fields of equal discs in the plane with open passages, one at a time or many at once."""

from __future__ import annotations

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray

_ASIDE = 0.1  # room more beside a start or a goal than a body needs [m]
_TRIES = 4096  # fields that are drawn at a time


def passages_open(centres: FloatArray, ends: FloatArray, keep: float) -> BoolArray:
    """Return whether a body passes between all discs, and stands clear of them at both ends.

    Args:
        centres: Of the discs [m], shape (..., k, 2); infinite where there is none.
        ends: Start and goal [m], shape (..., 2, 2).
        keep: Radius of a disc, radius of the body and the room that it needs [m].

    Returns:
        Shape (...).
    """
    # Coordinate by coordinate, and each pair once: a vector environment draws many fields.
    x, y = centres[..., 0], centres[..., 1]
    opened = np.ones(np.broadcast_shapes(x.shape[:-1], ends.shape[:-2]), bool)
    for one in range(x.shape[-1]):
        for end in (ends[..., 0, :], ends[..., 1, :]):
            gap = (x[..., one] - end[..., 0]) ** 2 + (y[..., one] - end[..., 1]) ** 2
            opened &= gap >= (keep + _ASIDE) ** 2
        for other in range(one):
            apart = (x[..., one] - x[..., other]) ** 2 + (y[..., one] - y[..., other]) ** 2
            # Of two that are not there the distance is no number.
            opened &= ~(apart < (2.0 * keep) ** 2)
    return opened


def draw_fields(
    rng: np.random.Generator,
    ends: FloatArray,
    low: tuple[float, float],
    high: tuple[float, float],
    counts: tuple[int, int],
    radius: float,
    keep: float,
) -> FloatArray:
    """Draw a field of discs for each pair of ends: uniform ones, drawn again until all is open.

    Args:
        rng: Where from.
        ends: Start and goal of each episode [m], shape (c, 2, 2).
        low: Least coordinates of a centre [m].
        high: Largest.
        counts: Least and largest number of discs.
        radius: Of a disc [m].
        keep: As for `passages_open`.

    Returns:
        Centre and radius of each disc, zeros where there is none, shape (c, largest number, 3).
    """
    most = counts[1]
    discs = np.zeros((len(ends), most, 3))
    waiting = np.arange(len(ends))
    while len(waiting):
        # Each that waits gets several tries, and takes the first that is open.
        tries = max(1, _TRIES // len(waiting))
        count = rng.integers(counts[0], most + 1, (len(waiting), tries))
        centres = rng.uniform(low, high, (len(waiting), tries, most, 2))
        centres[np.arange(most) >= count[..., None]] = np.inf
        with np.errstate(invalid="ignore"):  # infinity minus infinity
            opened = passages_open(centres, ends[waiting, None], keep)
        found = opened.any(axis=1)
        taken = centres[found, opened[found].argmax(axis=1)]
        there = np.isfinite(taken[..., :1])
        filled = np.concatenate([taken, np.full((*taken.shape[:-1], 1), radius)], axis=-1)
        discs[waiting[found]] = np.where(there, filled, 0.0)
        waiting = waiting[~found]
    return discs
