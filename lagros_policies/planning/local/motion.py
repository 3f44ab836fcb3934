"""The motion that one agent plans, and the discs that it keeps away from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_policies.planning.vectors import lengths

# Distances are planned wider by this, so that they are kept between the instants too [m].
_SPARE = 0.01
# Room that even a body which covers the goal keeps beyond touching [m].
_LEAST_ROOM = 0.02


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

    def heeded(self, times: FloatArray, foresight: float) -> BoolArray:
        """Return which are heeded at which times (k,) [s], shape (k, m).

        Those that move are heeded as far as the foresight [s]; the first and the last instant are
        given, so that nothing can be asked for there.
        """
        heeded: BoolArray = (times[:, None] <= foresight + 1e-9) | ~self.moving
        heeded[0] = heeded[-1] = False
        return heeded


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


def required_distances(
    discs: Discs,
    times: FloatArray,
    start: FloatArray,
    goal: FloatArray,
    left: float,
    margin_growth: float,
) -> FloatArray:
    """Return the distances that a motion has to keep: less near ends that lack room.

    Args:
        discs: What it keeps away from, m of them.
        times: Instants from now, shape (k,) [s].
        start: Where it is now, shape (2,) [m].
        goal: Where it ends, shape (2,) [m].
        left: Time until it should have arrived [s].
        margin_growth: The acceleration at which a margin grows that there is no room for [m/s^2].

    Returns:
        Shape (k, m) [m].
    """
    growth = 0.5 * margin_growth
    full = discs.touching + discs.margins + _SPARE
    gap = lengths(start - discs.centres)
    required = np.minimum(full, gap + growth * times[:, None] ** 2)
    # A body may cover the margin of the goal. One that moves is left time to be gone.
    room = np.maximum(lengths(goal - discs.centres), discs.touching + _LEAST_ROOM)
    room = np.where(discs.moving & (left > 0.0), np.inf, room)
    remaining = np.maximum(left - times, 0.0)
    value: FloatArray = np.minimum(required, room + growth * remaining[:, None] ** 2)
    return value
