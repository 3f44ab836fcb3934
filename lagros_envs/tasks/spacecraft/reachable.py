"""Whether there is a way around round obstacles: flooding a grid."""

from __future__ import annotations

import math

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray

# Cells times discs, each of which is looked at: a second, and a gigabyte.
_MOST_CELLS = 50_000_000


def way_exists(
    starts: FloatArray, goals: FloatArray, centres: FloatArray, radii: FloatArray, cell: float
) -> bool:
    """Tell whether every start is connected to its goal outside the discs.

    The plane is free outside the discs, so that the grid reaches one cell beyond everything. A cell
    is free if its centre is; ways go from a cell to its four neighbours. The two ends are given.

    Args:
        starts: Shape (n, 2) [m].
        goals: Shape (n, 2) [m].
        centres: Centres of the discs, shape (k, 2) [m].
        radii: Their radii, inflated by whoever has to pass, shape (k,) [m].
        cell: Side of a cell [m].

    Raises:
        ValueError: The grid would have too many cells.
    """
    ends = np.concatenate([starts, goals])
    if _all_free(ends, centres, radii):
        return True
    reach = radii[:, None]
    low = np.min(np.concatenate([ends, centres - reach]), axis=0) - 2.0 * cell
    high = np.max(np.concatenate([ends, centres + reach]), axis=0) + 2.0 * cell
    columns, rows = (math.ceil(side / cell) + 1 for side in high - low)
    if columns * rows * len(radii) > _MOST_CELLS:
        raise ValueError(
            f"{len(radii)} overlapping obstacles over {high[0] - low[0]:.4g} m by "
            f"{high[1] - low[1]:.4g} m are too much to look for a way around on cells of {cell:g} "
            "m: use a smaller arena, fewer or smaller obstacles, or open passages between them"
        )
    x = low[0] + cell * np.arange(columns)
    y = low[1] + cell * np.arange(rows)
    squares = (x - centres[:, :1])[:, :, None] ** 2 + (y - centres[:, 1:])[:, None, :] ** 2
    free = np.all(squares >= (radii**2)[:, None, None], axis=0)
    cells = np.rint((ends - low) / cell).astype(np.intp)
    # The cell of an end may have its centre inside a disc although the end is outside.
    free[cells[:, 0], cells[:, 1]] = True
    first, last = np.split(cells, 2)
    outside = flood(free, (0, 0))
    return all(
        (outside[start] and outside[goal]) or flood(free, start)[goal]
        for start, goal in zip(map(tuple, first), map(tuple, last), strict=True)
    )


def _all_free(ends: FloatArray, centres: FloatArray, radii: FloatArray) -> bool:
    """Tell whether no two discs overlap and no end lies in one: then all of the rest connects."""
    apart = np.sum((centres[:, None] - centres) ** 2, axis=-1)
    np.fill_diagonal(apart, np.inf)
    away = np.sum((ends[:, None] - centres) ** 2, axis=-1)
    disjoint = np.all(apart >= (radii[:, None] + radii) ** 2)
    return bool(disjoint and np.all(away >= radii**2))


def flood(free: BoolArray, origin: tuple[int, ...]) -> BoolArray:
    """Return the free cells that are connected to the origin by steps to the four neighbours."""
    reached = np.zeros_like(free)
    reached[origin] = free[origin]
    count = 0
    while (size := int(np.count_nonzero(reached))) > count:
        count = size
        # Several steps between two counts, each in the four directions.
        for _ in range(8):
            reached[1:] |= reached[:-1]
            reached[:-1] |= reached[1:]
            reached &= free
            reached[:, 1:] |= reached[:, :-1]
            reached[:, :-1] |= reached[:, 1:]
            reached &= free
    return reached
