"""Who is near whom in worlds of spacecraft, and near which obstacle: looked up once per step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.cells import Cells, Offsets, Resting, all_beside, all_pairs, both_ways

# With fewer pairs in all worlds together it is faster to look at all of them: up to 126 agents in
# one world, 16 in each of 64 (`benchmarks/speed/spacecraft_world.py --thresholds`).
MOST_PAIRS = 8_000
# What is looked for is a little further away than what is sensed and what can have met.
_ROUNDING = 1.0 + 1e-12
# Who is near is looked up for this much more than the sensing radius, in its units, and stays until
# somebody has moved as far: pairs then come apart or together by at most twice that.
_MARGIN = 0.1
# Of the margin, so that no rounding counts.
_USED = 0.99


@dataclass(frozen=True)
class Near:
    """What may be near each other at an instant: all that is sensed, and all that can have met.

    Attributes:
        points: Where the agents are, shape (2, worlds, agents) [m].
        centres: Where the obstacles are, shape (2, worlds * obstacles) [m].
        pairs: Places of pairs of agents of a world, each both ways, in ascending order.
        beside: Places of pairs of an agent and an obstacle of its world, in ascending order.
    """

    points: FloatArray
    centres: FloatArray
    pairs: tuple[IntArray, IntArray]
    beside: tuple[IntArray, IntArray]

    @cached_property
    def agents(self) -> Offsets:
        """How the agents of the pairs lie to each other."""
        flat = self.points.reshape(2, -1)
        return Offsets.between(self.pairs, flat, flat)

    @cached_property
    def obstacles(self) -> Offsets:
        """How the obstacles lie to the agents."""
        return Offsets.between(self.beside, self.points.reshape(2, -1), self.centres)


class Nearby:
    """Finds what is near, by cells where there are many and by all pairs where there are few.

    Both find the same: cells only leave out what is too far away to be sensed or touched. What they
    found is looked at again until somebody has moved further than it allows for (Verlet 1967).

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
        self._margin = margin = _MARGIN * sensing
        # An absent obstacle lies at the origin and widens the rectangle at most.
        ends = np.concatenate([starts, goals, centres], axis=-1)
        low, high = ends.min(axis=-1).T, ends.max(axis=-1).T
        pairs = self._worlds * self._agents * (self._agents - 1) // 2
        if by_cells or (by_cells is None and pairs > MOST_PAIRS):
            self._cells = Cells(low, high, max(sensing, 2.0 * self._contact) + 2.0 * margin)
        many = self._agents * radii.size > MOST_PAIRS if by_cells is None else by_cells
        if many and present.any():
            reach = max(sensing + largest, 2.0 * self._touch) + margin
            self._resting = Resting(low, high, centres, present, reach)
        self._of_agents: tuple[IntArray, IntArray]
        self._of_obstacles: tuple[IntArray, IntArray]
        if not (self._cells or self._resting):
            self._of_agents = all_pairs(self._worlds, self._agents)
            self._of_obstacles = all_beside(self._worlds, self._agents, radii.shape[1])
        # Where the agents were when pairs were looked up, and up to which distances.
        self._from: FloatArray | None = None
        self._up_to = math.nan, math.nan

    def at(self, points: FloatArray, reach: float) -> Near:
        """Return what is near agents.

        Args:
            points: Where they are, shape (2, worlds, agents) [m].
            reach: Furthest that any of them came from there, on the way that is looked at [m].
        """
        agents = max(self._sensing, self._contact + 2.0 * reach)
        obstacles = max(self._sensing + self._largest, self._touch + reach)
        if (self._cells or self._resting) and not self._holds(points, (agents, obstacles)):
            self._find(points, agents, obstacles)
        return Near(points, self._obstacles, self._of_agents, self._of_obstacles)

    def _holds(self, points: FloatArray, up_to: tuple[float, float]) -> bool:
        """Tell whether the pairs of before hold all that is no further apart than that [m]."""
        if self._from is None or self._up_to != up_to:
            return False
        x, y = points - self._from
        return bool(np.max(x * x + y * y) <= (_USED * self._margin) ** 2)

    def _find(self, points: FloatArray, agents: float, obstacles: float) -> None:
        """Look up the pairs that are no further apart than that [m], or than the margin more."""
        self._from, self._up_to = points, (agents, obstacles)
        flat = points.reshape(2, -1)
        agents, obstacles = agents + 2.0 * self._margin, obstacles + self._margin
        cells, resting = self._cells, self._resting
        far = cells is None or agents > cells.side
        pairs = (
            all_pairs(self._worlds, self._agents)
            if cells is None or far
            else cells.pairs(cells.keys(points))
        )
        near = Offsets.between(pairs, flat, flat).within(agents * _ROUNDING)
        one, other = near.one, near.other
        self._of_agents = (one, other) if far else both_ways(one, other)
        if resting is None or obstacles > resting.reach:
            pairs = all_beside(self._worlds, self._agents, self._obstacles.shape[1] // self._worlds)
        else:
            pairs = resting.pairs(resting.cells.keys(points))
        near = Offsets.between(pairs, flat, self._obstacles).within(obstacles * _ROUNDING)
        self._of_obstacles = near.one, near.other
