"""Who is near whom in worlds of spacecraft, and near which obstacle: looked up once per step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.cells import Cells, Offsets, Resting, all_beside, all_pairs

# With fewer pairs in all worlds together it is faster to look at all of them: up to 126 agents in
# one world, 16 in each of 64 (`benchmarks/speed/spacecraft_world.py --thresholds`).
MOST_PAIRS = 8_000
# What is looked for is a little further away than what is sensed and what can have met.
_ROUNDING = 1.0 + 1e-12


class Near(NamedTuple):
    """What may be near each other at an instant: all that is sensed, and all that can have met.

    Attributes:
        points: Where the agents are, shape (2, worlds, agents) [m].
        agents: Pairs of agents of a world, each once.
        obstacles: Pairs of an agent and an obstacle of its world.
    """

    points: FloatArray
    agents: Offsets
    obstacles: Offsets


class Nearby:
    """Finds what is near, by cells where there are many and by all pairs where there are few.

    Both find the same: cells only leave out what is too far away to be sensed or touched.

    Args:
        sensing: How far an agent senses [m].
        goals: Where the agents go, shape (2, worlds, agents) [m].
        starts: Where they begin, likewise.
        contact: Distance of centres at which agents touch, shape (worlds,) [m].
        centres: Of the obstacles, shape (2, worlds, obstacles) [m].
        radii: Of the obstacles, shape (worlds, obstacles) [m]; -inf where there is none.
        core: Radius of an agent against obstacles, shape (worlds,) [m].
        by_cells: Whether cells are used, whatever the numbers; None decides by them.
    """

    def __init__(
        self,
        sensing: float,
        starts: FloatArray,
        goals: FloatArray,
        contact: FloatArray,
        centres: FloatArray,
        radii: FloatArray,
        core: FloatArray,
        by_cells: bool | None = None,
    ) -> None:
        self._worlds, self._agents = starts.shape[1:]
        self._obstacles = centres.reshape(2, -1)
        present = np.isfinite(radii)
        largest = float(np.max(radii, initial=0.0, where=present))
        self._sensing, self._largest = sensing, largest
        self._contact, self._touch = float(contact.max()), largest + float(core.max())
        self._cells: Cells | None = None
        self._resting: Resting | None = None
        # An absent obstacle lies at the origin and widens the rectangle at most.
        ends = np.concatenate([starts, goals, centres], axis=-1)
        low, high = ends.min(axis=-1).T, ends.max(axis=-1).T
        pairs = self._worlds * self._agents * (self._agents - 1) // 2
        if by_cells or (by_cells is None and pairs > MOST_PAIRS):
            self._cells = Cells(low, high, max(sensing, 2.0 * self._contact))
        many = self._agents * radii.size > MOST_PAIRS if by_cells is None else by_cells
        if many and present.any():
            reach = max(sensing + largest, 2.0 * self._touch)
            self._resting = Resting(low, high, centres, present, reach)

    def at(self, points: FloatArray, reach: float) -> Near:
        """Return what is near agents.

        Args:
            points: Where they are, shape (2, worlds, agents) [m].
            reach: Furthest that any of them came from there, on the way that is looked at [m].
        """
        flat = points.reshape(2, -1)
        cells, resting = self._cells, self._resting
        agents = max(self._sensing, self._contact + 2.0 * reach)
        obstacles = max(self._sensing + self._largest, self._touch + reach)
        if cells is None or agents > cells.side:
            pairs = all_pairs(self._worlds, self._agents)
        else:
            pairs = cells.pairs(cells.keys(points))
        if resting is None or obstacles > resting.reach:
            beside = all_beside(
                self._worlds, self._agents, self._obstacles.shape[1] // self._worlds
            )
        else:
            beside = resting.pairs(resting.cells.keys(points))
        return Near(
            points,
            Offsets.between(pairs, flat, flat).within(agents * _ROUNDING),
            Offsets.between(beside, flat, self._obstacles).within(obstacles * _ROUNDING),
        )
