"""A plan of many agents in one: its motion on any grid, and its true clearance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.planning.joint.scp import positions_between
from lagros_policies.planning.vectors import segment_distance


@dataclass(frozen=True)
class JointPlan:
    """Target trajectories of all agents.

    Attributes:
        states: [p, v] at the nodes, shape (n, N + 1, 4) [m, m/s].
        forces: F in the world's frame, held between nodes, shape (n, N, 2) [N].
        node_period: Time from node to node [s].
        mass: m [kg].
        solved: Whether ends, margins and speeds are kept, between the nodes too.
        status: How the plan was found, or why there is none, in words.
        clearance: Least room beyond touching, swept between control instants [m]; inf for one
            agent without obstacles.
        margin: Room that the plan was asked to keep [m], less only near starts and goals that lack
            it.
        iterations: Quadratic programs solved, over all guesses.
        attempts: Guesses tried.
        seconds: Wall time [s].
    """

    states: FloatArray
    forces: FloatArray
    node_period: float
    mass: float
    solved: bool
    status: str
    clearance: float
    margin: float
    iterations: int
    attempts: int
    seconds: float

    @property
    def effort(self) -> FloatArray:
        """The integral of ||F||^2 / 2 per agent, shape (n,) [N^2 s]."""
        value: FloatArray = 0.5 * self.node_period * np.sum(self.forces**2, axis=(1, 2))
        return value

    def resample(self, period: float) -> tuple[FloatArray, FloatArray]:
        """Return the same motion on a finer grid, exactly.

        Args:
            period: Divides the node step [s].

        Returns:
            [p, v], shape (n, K + 1, 4), and F held from instant to instant, shape (n, K, 2).

        Raises:
            ValueError: The period does not divide the node step.
        """
        count = divisor("period", period, self.node_period)
        place, speed = positions_between(
            self.states, self.forces, self.mass, self.node_period, count
        )
        return np.concatenate([place, speed], axis=-1), np.repeat(self.forces, count, axis=1)


def swept_distances(places: FloatArray, obstacles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the least distances of centres while each agent moves straight between instants.

    Args:
        places: Positions, shape (n, K + 1, 2) [m].
        obstacles: Centres, shape (m, 2) [m].

    Returns:
        To obstacles, shape (K, n, m), and between agents, shape (K, P), pairs in the order of
        `numpy.triu_indices` [m].
    """
    gaps = segment_distance(places[:, :-1], places[:, 1:], obstacles).transpose(1, 0, 2)
    first, second = np.triu_indices(len(places), 1)
    between = places[first] - places[second]
    apart = segment_distance(between[:, :-1], between[:, 1:], np.zeros((1, 2)))[..., 0]
    return gaps, apart.T


def divisor(name: str, period: float, whole: float) -> int:
    """Return how many periods make the whole.

    Raises:
        ValueError: It is not a whole number.
    """
    count = round(whole / period) if period > 0.0 else 0
    if count < 1 or abs(count * period - whole) > 1e-9 * whole:
        raise ValueError(f"{name}={period!r} s does not divide the node step of {whole} s")
    return count


def instants(period: float, count: int) -> FloatArray:
    """Return the times 0, period, ... of `count` steps, shape (count + 1,) [s]."""
    return np.arange(count + 1, dtype=np.float64) * period
