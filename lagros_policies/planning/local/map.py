"""What one agent remembers of what it has sensed, in axes whose origin is its goal."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lagros_envs.arrays import FloatArray

# Two centres nearer than this are one obstacle [m]: bodies that overlap so far are none.
_SAME_OBSTACLE = 0.05
# Between two instants no agent moves further than this [m], so that it is the same one.
_SAME_AGENT = 0.4


@dataclass
class LocalMap:
    """Obstacles seen so far, which stay, and neighbours sensed now.

    The order of what is sensed does not matter: everything is kept sorted.

    Attributes:
        obstacles: Centres and radii, shape (m, 3) [m].
        neighbours: Smoothed positions and velocities of those sensed now, shape (k, 4) [m, m/s].
    """

    obstacles: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    neighbours: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))

    def notice_obstacles(self, sensed: FloatArray) -> bool:
        """Add the obstacles (s, 3) that are new, and return whether any was."""
        if len(sensed) == 0:
            return False
        gaps = np.linalg.norm(sensed[:, None, :2] - self.obstacles[:, :2], axis=-1)
        new = sensed[np.min(gaps, axis=1, initial=np.inf) > _SAME_OBSTACLE]
        self.obstacles = _sorted(np.vstack([self.obstacles, new]))
        return len(new) > 0

    def notice_neighbours(self, sensed: FloatArray, period: float, smoothing: float) -> bool:
        """Take the neighbours (s, 4) sensed now, and return whether one was not sensed before.

        u* answers the disturbance, so that the velocity of an instant says little of where a
        neighbour is going. Those sensed before are tracked by their positions, with the critically
        damped filter whose error at constant velocity fades as exp(-t / smoothing).

        Args:
            sensed: Positions and velocities, shape (s, 4) [m, m/s].
            period: Time since the last call [s].
            smoothing: Time constant of the filter [s]; 0 for none.
        """
        known = self.neighbours
        if len(sensed) == 0:
            self.neighbours = np.zeros((0, 4))
            return False
        expected = known[:, :2] + period * known[:, 2:]
        gaps = np.linalg.norm(sensed[:, None, :2] - expected, axis=-1)
        met = np.min(gaps, axis=1, initial=np.inf) <= _SAME_AGENT
        smoothed = sensed.copy()
        if met.any():
            nearest = np.argmin(gaps[met], axis=1)
            surprise = sensed[met, :2] - expected[nearest]
            fade = math.exp(-period / smoothing) if smoothing > 0.0 else 0.0
            smoothed[met, :2] = expected[nearest] + (1.0 - fade**2) * surprise
            smoothed[met, 2:] = known[nearest, 2:] + (1.0 - fade) ** 2 / period * surprise
        self.neighbours = _sorted(smoothed)
        return not bool(met.all())


def _sorted(rows: FloatArray) -> FloatArray:
    """Return rows in the order of their columns, the first one first."""
    return rows[np.lexsort(rows.T[::-1])]
