"""A joint plan of spacecraft: its motion on any grid, its true clearance, and its thrusters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import hold_step
from lagros_envs.tasks.spacecraft.physics import HEADING, Spacecraft
from lagros_policies.planning.joint.grid_path import segment_distance
from lagros_policies.planning.joint.scp import positions_between
from lagros_policies.tasks.spacecraft.thrusters import thrust_for_acceleration

FloatArray = NDArray[np.float64]


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
        """The integral of ||u_d||^2 = ||F||^2 / 2 per agent, shape (n,) [N^2 s]."""
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

    def reference(
        self, period: float, headings: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return what the tracking law follows: the full states and accelerations.

        Args:
            period: Divides the node step [s].
            headings: Of the agents, at rest, shape (n,) [rad]; zero if left out.

        Returns:
            x_d, shape (n, K + 1, 6), and accelerations of x, y and heading, shape (n, K, 3).

        Raises:
            ValueError: The period does not divide the node step.
        """
        motion, forces = self.resample(period)
        states = np.zeros((*motion.shape[:2], 6))
        states[..., :2], states[..., 3:5] = motion[..., :2], motion[..., 2:]
        if headings is not None:
            states[..., HEADING] = np.asarray(headings)[:, None]
        accelerations = np.zeros((*forces.shape[:2], 3))
        accelerations[..., :2] = forces / self.mass
        return states, accelerations


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


def fly(
    plan: JointPlan, body: Spacecraft, period: float, headings: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Carry out a plan open loop with the eight thrusters and the full dynamics.

    Args:
        plan: The plan.
        body: The spacecraft, of the plan's mass.
        period: Control period; divides the node step [s].
        headings: Of the agents at the start, shape (n,) [rad]; zero if left out.

    Returns:
        States, shape (n, K + 1, 6), and u_d >= 0, shape (n, K, 8) [N].

    Raises:
        ValueError: The body has another mass, or the period does not divide the node step.
    """
    if body.mass != plan.mass:
        raise ValueError(f"the plan is for mass {plan.mass!r} kg, not {body.mass!r} kg")
    reference, accelerations = plan.reference(period, headings)
    thrust = thrust_for_acceleration(body, reference[:, :-1], accelerations)
    states = np.empty_like(reference)
    states[:, 0] = reference[:, 0]
    for step in range(thrust.shape[1]):
        states[:, step + 1] = hold_step(body, states[:, step], thrust[:, step], period)
    return states, thrust


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
