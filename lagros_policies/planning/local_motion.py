"""The motion that one agent plans, and the discs that it keeps away from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Discs:
    """What to keep away from.

    Attributes:
        centres: Shape (m, 2) [m].
        velocities: Shape (m, 2) [m/s].
        touching: Distance of the centres at touch, shape (m,) [m].
        margins: Room beyond that to ask for, shape (m,) [m].
        moving: Which move; they are heeded as far as the planner's foresight, shape (m,).
    """

    centres: FloatArray
    velocities: FloatArray
    touching: FloatArray
    margins: FloatArray
    moving: BoolArray

    @classmethod
    def none(cls) -> Discs:
        """Return no discs at all."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, bool))

    def at(self, times: FloatArray) -> FloatArray:
        """Return the centres at times (k,) [s] from now, shape (k, m, 2) [m]."""
        value: FloatArray = self.centres + times[:, None, None] * self.velocities
        return value


@dataclass(frozen=True)
class LocalPlan:
    """A motion to rest at the goal.

    Attributes:
        edges: Instants between which the force is held, from 0, shape (N + 1,) [s].
        start: [p, v] at 0, shape (4,) [m, m/s].
        forces: F, shape (N, 2) [N].
        mass: m [kg].
        short: By how much the worst distance falls short of what was asked for [m].
        cost: Effort 1/2 int ||F||^2 dt plus the price of the shortfalls [N^2 s].
        solved: Whether the solver found it.
        programs: Quadratic programs solved, over all guesses.
    """

    edges: FloatArray
    start: FloatArray
    forces: FloatArray
    mass: float
    short: float
    cost: float
    solved: bool
    programs: int

    @property
    def duration(self) -> float:
        """Time to the goal [s]."""
        return float(self.edges[-1])

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions and velocities, both (k, 2), at times (k,) [s]; at rest after its end.

        The forces are integrated exactly.
        """
        clipped = np.clip(times, 0.0, self.duration)
        place, speed = responses(self.edges, clipped, self.mass)
        places = self.start[:2] + clipped[:, None] * self.start[2:] + place @ self.forces
        speeds = self.start[2:] + speed @ self.forces
        return places, np.where((times > self.duration)[:, None], 0.0, speeds)

    def force(self, time: float) -> FloatArray:
        """Return the force that is held from this time on, shape (2,) [N]; zero after the end."""
        index = int(np.searchsorted(self.edges, time + 1e-9, side="right")) - 1
        return self.forces[index] if index < len(self.forces) else np.zeros(2)


def responses(edges: FloatArray, times: FloatArray, mass: float) -> tuple[FloatArray, FloatArray]:
    """Return what a held force of 1 N in each step does to position and velocity of one axis.

    Args:
        edges: Instants between which forces are held, shape (N + 1,) [s].
        times: When to look, shape (k,) [s].
        mass: m [kg].

    Returns:
        Phi(t) [m/N] and its derivative [m/(N s)], both of shape (k, N).
    """
    since = np.maximum(times[:, None] - edges, 0.0)
    square = (0.5 / mass) * since**2
    place = square[:, :-1] - square[:, 1:]
    speed = (since[:, :-1] - since[:, 1:]) / mass
    return place, speed
