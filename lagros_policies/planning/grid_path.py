"""First guesses of where a body goes among discs: shortest paths on a grid.

Guesses need not obey any constraint. They choose the side on which a body passes an obstacle, which
the quadratic programs that follow cannot change. Every choice is deterministic; ties go to the side
that leaves the obstacle on the left.

However far starts, goals and obstacles lie apart, no more cells are looked at than `GridSettings`
says: where one grid for all would have more, each agent has one of its own, as coarse as it must
be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.checks import check_fields
from lagros_policies.planning.vectors import segment_distance

# Cells that every agent has at least, however many agents there are.
_FEWEST = 400
# Far beyond any arena, and far below where differences of positions lose the obstacles [m].
_FARTHEST = 1e9
# From a cell to those around it.
STEPS = [(i, j) for i in range(-2, 3) for j in range(-2, 3)]


@dataclass(frozen=True, slots=True)
class GridSettings:
    """The grids.

    Attributes:
        cell: Cell of the shortest paths [m].
        border: Free room around all starts, goals and obstacles [m].
        preference: Share by which going counter-clockwise around an obstacle is cheaper.
        crossing_cost: How many times longer a way through an inflated obstacle counts.
        sidestep: How far to the right of its path an agent is guessed at its middle [m].
        search_cell: Cell of the search in space and time [m].
        search_period: Its time step [s].
        most_cells: Cells of the shortest paths; 100,000 take half a second, or 45 m by 50 m.
        most_search_cells: Cells of the search, of each of its layers.

    Raises:
        ValueError: A value is out of range.
    """

    cell: float = 0.15
    border: float = 1.5
    preference: float = 0.03
    crossing_cost: float = 30.0
    sidestep: float = 0.4
    search_cell: float = 0.25
    search_period: float = 1.0
    most_cells: int = 100_000
    most_search_cells: int = 40_000

    def __post_init__(self) -> None:
        check_fields(
            self,
            positive=("cell", "search_cell", "search_period"),
            not_negative=("border", "preference", "crossing_cost", "sidestep"),
            least={"most_cells": _FEWEST, "most_search_cells": _FEWEST},
        )
        if self.preference >= 1.0:
            raise ValueError(f"preference={self.preference!r} must be below 1")


def shortest_paths(
    starts: FloatArray,
    goals: FloatArray,
    obstacles: FloatArray,
    distance: FloatArray,
    settings: GridSettings,
) -> list[FloatArray]:
    """Return for each agent the shortest way around the inflated obstacles, straightened.

    Where no free way exists the path crosses an obstacle: what follows will find it infeasible.

    Args:
        starts: Positions, shape (n, 2) [m].
        goals: Positions, shape (n, 2) [m].
        obstacles: Centres, shape (m, 2) [m].
        distance: To be kept from each centre, shape (m,) [m].
        settings: The grid.

    Returns:
        One polyline per agent, shape (points, 2), from its start to its goal [m].
    """
    frames = frames_around(
        starts, goals, obstacles, settings.cell, settings.border, settings.most_cells
    )
    # One graph where all share it: the agents of a frame, in their order.
    sharing: dict[Frame, list[int]] = {}
    for agent, frame in enumerate(frames):
        sharing.setdefault(frame, []).append(agent)
    paths: dict[int, FloatArray] = {}
    for frame, agents in sharing.items():
        graph = _graph(frame, obstacles, distance, settings)
        sources, targets = frame.nearest(starts[agents]), frame.nearest(goals[agents])
        _, before = dijkstra(graph, indices=sources, return_predecessors=True)
        for row, agent in enumerate(agents):
            chain = [int(targets[row])]
            while before[row, chain[-1]] >= 0:
                chain.append(int(before[row, chain[-1]]))
            cells = np.stack(np.unravel_index(np.array(chain[::-1]), frame.shape), axis=-1)
            inner = frame.origin + frame.cell * cells[1:-1]
            path = np.vstack([starts[agent], inner, goals[agent]])
            paths[agent] = straighten(path, obstacles, distance)
    return [paths[agent] for agent in range(len(starts))]


def straighten(path: FloatArray, obstacles: FloatArray, distance: FloatArray) -> FloatArray:
    """Drop the points of a polyline that the discs do not need.

    Args:
        path: Polyline, shape (points, 2) [m].
        obstacles: Centres, shape (m, 2) [m].
        distance: To be kept from each centre, shape (m,) [m]; less where the path itself is nearer.
    """
    gaps = np.linalg.norm(path[:, None] - obstacles, axis=-1)
    kept = [0]
    while kept[-1] < len(path) - 1:
        here = kept[-1]
        ahead = path[here + 1 :]
        allowed = np.minimum(distance, np.minimum.accumulate(gaps[here:])[1:]) - 1e-9
        clear = np.all(segment_distance(path[here], ahead, obstacles) >= allowed, axis=1)
        kept.append(here + 1 + int(np.max(np.flatnonzero(clear), initial=0)))
    return path[kept]


def walk(path: FloatArray, progress: FloatArray, sidestep: float = 0.0) -> FloatArray:
    """Return the points of a polyline at shares of its length.

    Args:
        path: Polyline, shape (points, 2) [m].
        progress: Shares in [0, 1], shape (k,).
        sidestep: Shift to the right at the middle, none at the ends [m].

    Returns:
        Positions, shape (k, 2) [m].
    """
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    total = float(length[-1])
    share = length / total if total > 0.0 else np.linspace(0.0, 1.0, len(length))
    points = np.stack([np.interp(progress, share, path[:, axis]) for axis in range(2)], axis=-1)
    heading = path[-1] - path[0]
    right = np.array([heading[1], -heading[0]]) / max(float(np.linalg.norm(heading)), 1e-9)
    shifted: FloatArray = points + sidestep * np.sin(math.pi * progress)[:, None] * right
    return shifted


def smooth_progress(time: FloatArray, begin: float, end: float) -> FloatArray:
    """Return the share of the way of least effort from rest to rest between two times.

    Args:
        time: Any shape [s].
        begin: Departure [s].
        end: Arrival, after the departure [s].
    """
    share = np.clip((time - begin) / (end - begin), 0.0, 1.0)
    value: FloatArray = share * share * (3.0 - 2.0 * share)
    return value


@dataclass(frozen=True, eq=False)
class Frame:
    """Where a grid lies.

    Attributes:
        origin: Its lowest corner, shape (2,) [m].
        shape: Rows and columns.
        cell: Side of a cell [m].
    """

    origin: FloatArray
    shape: tuple[int, int]
    cell: float

    @classmethod
    def around(cls, points: FloatArray, cell: float, border: float, most: int) -> Frame:
        """Return a grid around points (p, 2), with larger cells where there would be too many."""
        low, high = points.min(axis=0) - border, points.max(axis=0) + border
        sides = high - low
        if not np.max(np.abs(points)) < _FARTHEST:
            raise ValueError(
                f"positions of up to {float(np.max(np.abs(points))):.3g} m must be below "
                f"{_FARTHEST:g} m: give them from an origin that is nearer"
            )
        cell = max(cell, math.sqrt(sides[0] * sides[1] / most))
        cells = np.ceil(sides / cell) + 1.0
        while cells[0] * cells[1] > most:
            cell *= 1.05
            cells = np.ceil(sides / cell) + 1.0
        return cls(low, (int(cells[0]), int(cells[1])), cell)

    def centres(self) -> FloatArray:
        """Return the points of the grid, shape (rows, columns, 2)."""
        first, second = (
            self.origin[axis] + self.cell * np.arange(self.shape[axis]) for axis in range(2)
        )
        return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1)

    def nearest(self, points: FloatArray) -> IntArray:
        """Return the flat index of the cell nearest to each of the points (p, 2)."""
        index = np.rint((points - self.origin) / self.cell).astype(np.intp)
        flat: IntArray = np.ravel_multi_index((index[:, 0], index[:, 1]), self.shape)
        return flat


def frames_around(
    starts: FloatArray,
    goals: FloatArray,
    obstacles: FloatArray,
    cell: float,
    border: float,
    most: int,
) -> list[Frame]:
    """Return the grid of each agent: one for all, or one of its own where that would be too large.

    An agent's own reaches from its start to its goal and around the obstacles there; all of them
    together have no more than `most` cells.
    """
    whole = Frame.around(np.vstack([starts, goals, obstacles]), cell, border, most)
    if whole.cell == cell:
        return [whole] * len(starts)
    frames = []
    for ends in np.stack([starts, goals], axis=1):
        low, high = ends.min(axis=0) - border, ends.max(axis=0) + border
        near = obstacles[np.all((obstacles >= low) & (obstacles <= high), axis=1)]
        share = max(most // len(starts), _FEWEST)
        frames.append(Frame.around(np.vstack([ends, near]), cell, border, share))
    return frames


def _graph(
    frame: Frame,
    obstacles: FloatArray,
    distance: FloatArray,
    settings: GridSettings,
) -> sparse.csr_matrix:
    """Return the directed lengths between each cell and its sixteen nearest in sight."""
    shape = frame.shape
    count = shape[0] * shape[1]
    number = np.arange(count).reshape(shape)
    centres = frame.centres()
    rows, columns, lengths = [], [], []
    for i, j in (s for s in STEPS if math.gcd(*s) == 1):
        here = (_overlap(i, shape[0]), _overlap(j, shape[1]))
        there = (_overlap(-i, shape[0]), _overlap(-j, shape[1]))
        step = frame.cell * np.array([i, j], dtype=np.float64)
        length = float(np.linalg.norm(step))
        offset = centres[here] + 0.5 * step
        delta = offset[..., None, :] - obstacles
        gap = np.linalg.norm(delta, axis=-1)
        crosses = np.any(gap < distance, axis=-1)
        # Counter-clockwise around the near obstacles is a little cheaper.
        turn = delta[..., 0] * step[1] - delta[..., 1] * step[0]
        swirl = np.sum(turn / np.maximum(gap, 1e-9) * np.exp(-gap), axis=-1) / length
        factor = np.where(crosses, settings.crossing_cost, 1.0)
        factor = factor * (1.0 - settings.preference * np.clip(swirl, -1.0, 1.0))
        rows.append(number[here].ravel())
        columns.append(number[there].ravel())
        lengths.append((length * factor).ravel())
    return sparse.csr_matrix(
        (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))),
        shape=(count, count),
    )


def _overlap(shift: int, size: int) -> slice:
    """Return the cells whose neighbour at a shift lies on the grid."""
    return slice(max(0, -shift), size - max(0, shift))
