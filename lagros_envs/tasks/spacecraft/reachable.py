"""Whether there is a way around round obstacles: flooding a grid."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray, IntArray

_MOST_CELLS = 20_000_000  # seconds, and half a gigabyte


class Grid(NamedTuple):
    """Square cells over a part of the plane.

    Attributes:
        low: Centre of the first cell, shape (2,) [m].
        cell: Side of a cell [m].
        shape: How many there are along each axis.
    """

    low: FloatArray
    cell: float
    shape: tuple[int, int]

    @classmethod
    def around(
        cls, points: FloatArray, centres: FloatArray, radii: FloatArray, cell: float
    ) -> Grid:
        """Return the grid that reaches two cells beyond points (n, 2) and discs (k, 2), (k,).

        Raises:
            ValueError: It would have too many cells.
        """
        reach = radii[:, None]
        low = np.min(np.concatenate([points, centres - reach]), axis=0) - 2.0 * cell
        high = np.max(np.concatenate([points, centres + reach]), axis=0) + 2.0 * cell
        columns, rows = (math.ceil(side / cell) + 1 for side in high - low)
        if columns * rows > _MOST_CELLS:
            raise ValueError(
                f"{len(radii)} overlapping obstacles over {high[0] - low[0]:.4g} m by "
                f"{high[1] - low[1]:.4g} m are too much to look for a way around on cells of "
                f"{cell:g} m: use a smaller arena, or open passages between them"
            )
        return cls(low, cell, (columns, rows))

    def cells(self, points: FloatArray) -> IntArray:
        """Return the cell of each point, shape (n, 2)."""
        cells: IntArray = np.rint((points - self.low) / self.cell).astype(np.intp)
        return cells

    def covers(self, centres: FloatArray, squares: FloatArray) -> IntArray:
        """Return by how many discs the centre of each cell is covered, of `shape`.

        Args:
            centres: Of the discs, shape (k, 2) [m].
            squares: Of their radii, shape (k,) [m^2]; the rim covers nothing.
        """
        count = np.zeros(self.shape, np.intp)
        x = self.low[0] + self.cell * np.arange(self.shape[0])
        y = self.low[1] + self.cell * np.arange(self.shape[1])
        reach = np.sqrt(squares)[:, None] + self.cell
        first = np.maximum(self.cells(centres - reach), 0)
        last = self.cells(centres + reach) + 1
        for centre, square, (left, down), (right, up) in zip(
            centres, squares, first.tolist(), last.tolist(), strict=True
        ):
            across, along = x[left:right] - centre[0], y[down:up] - centre[1]
            count[left:right, down:up] += (across**2)[:, None] + along**2 < square
        return count


def way_exists(
    starts: FloatArray, goals: FloatArray, centres: FloatArray, radii: FloatArray, cell: float
) -> bool:
    """Tell whether every start is connected to its goal outside the discs.

    The plane is free outside the discs, so that the grid reaches beyond everything. A cell is free
    if its centre is; ways go from a cell to its four neighbours. The two ends are given.

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
    grid = Grid.around(ends, centres, radii, cell)
    free = grid.covers(centres, radii**2) == 0
    cells = grid.cells(ends)
    # The cell of an end may have its centre inside a disc although the end is outside.
    free[cells[:, 0], cells[:, 1]] = True
    first, last = np.split(cells, 2)
    outside = flood(free, (0, 0))
    return all(
        (outside[start] and outside[goal]) or flood(free, start)[goal]
        for start, goal in zip(map(tuple, first), map(tuple, last), strict=True)
    )


def shut_in(
    points: FloatArray, apart: float, centres: FloatArray, radii: FloatArray, cell: float
) -> BoolArray:
    """Tell who cannot get away from where it is parked while all others stay parked.

    Who is not shut in has a way out of everything that touches nothing: cells are free only if
    every step between two free neighbours keeps clear, which is half a cell within the square of
    the distance. Who is shut in may have a way that is narrower than the cells tell.

    Args:
        points: Where the agents are parked, shape (n, 2), further apart than they touch [m].
        apart: Distance of centres at which two agents touch [m].
        centres: Centres of the obstacles, shape (k, 2) [m].
        radii: Distance of centres at which an agent touches each, shape (k,) [m].
        cell: Side of a cell [m].

    Returns:
        Shape (n,).

    Raises:
        ValueError: The grid would have too many cells.
    """
    aside = 0.25 * cell * cell
    own = apart * apart + aside
    bodies = np.concatenate([centres, points])
    squares = np.concatenate([radii**2 + aside, np.full(len(points), own)])
    grid = Grid.around(points, bodies, np.sqrt(squares), cell)
    count = grid.covers(bodies, squares)
    outside = flood(count == 0, (0, 0))
    # A window around each, without its own disc: whoever gets out of that disc is out if what it
    # reaches is.
    half = math.ceil(math.sqrt(own) / cell)
    steps = np.arange(-half, half + 1)
    at = grid.cells(points)
    window = at[:, 0, None, None] + steps[:, None], at[:, 1, None, None] + steps
    across = grid.low[0] + cell * window[0] - points[:, 0, None, None]
    along = grid.low[1] + cell * window[1] - points[:, 1, None, None]
    passable = count[window] - (across**2 + along**2 < own) == 0
    reached = np.zeros_like(passable)
    reached[:, half, half] = passable[:, half, half]
    for _ in range(passable[0].size):
        before = int(np.count_nonzero(reached))
        reached[:, 1:] |= reached[:, :-1] & passable[:, 1:]
        reached[:, :-1] |= reached[:, 1:] & passable[:, :-1]
        reached[:, :, 1:] |= reached[:, :, :-1] & passable[:, :, 1:]
        reached[:, :, :-1] |= reached[:, :, 1:] & passable[:, :, :-1]
        if int(np.count_nonzero(reached)) == before:
            break
    free: BoolArray = np.any(reached & outside[window], axis=(1, 2))
    return ~free


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
    # Whole runs of free cells at a time, along the one axis and along the other.
    along, across = _runs(free), _runs(free.T)
    count = 0
    while (size := int(np.count_nonzero(reached))) > count:
        count = size
        reached = _filled(reached, free, along)
        reached = _filled(reached.T, free.T, across).T
    return reached


def _runs(free: BoolArray) -> IntArray:
    """Return for every free cell the number of its run along the last axis."""
    begins = free.copy()
    begins[:, 1:] &= ~free[:, :-1]
    runs: IntArray = np.cumsum(begins.reshape(-1), dtype=np.intp).reshape(free.shape)
    return runs


def _filled(reached: BoolArray, free: BoolArray, runs: IntArray) -> BoolArray:
    """Return the free cells of all runs of which some cell is reached."""
    found = np.zeros(int(runs[-1, -1]) + 1, bool)
    found[runs[reached]] = True
    return found[runs] & free
