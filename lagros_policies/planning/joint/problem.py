"""What the joint planner is asked: many agents, obstacles, distances, and how to iterate."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.checks import check_above, check_fields
from lagros_policies.planning.vectors import lengths


@dataclass(frozen=True, slots=True)
class JointScpSettings:
    """How long and how precisely to iterate.

    Attributes:
        max_iterations: Quadratic programs at most.
        effort_tolerance: Stop when the effort falls by less than this share in one pass.
        distance_tolerance: Largest violation of a distance at a control instant that counts as
            none [m].
        reach: A half-plane is imposed at a node where the last plan is nearer than the required
            distance plus this [m].
        near: Likewise at the control instants between nodes [m].
        penalty: Weight of a violated half-plane [N^2 s / m]; above the multipliers of the problem
            the penalty is exact.
        qp_tolerance: Residual of the quadratic programs.
        patience: Give up when the violation has not halved within this many passes.

    Raises:
        ValueError: A value is not positive.
    """

    max_iterations: int = 25
    effort_tolerance: float = 1e-2
    distance_tolerance: float = 4e-3
    reach: float = 1.0
    near: float = 0.1
    penalty: float = 1.0
    qp_tolerance: float = 1e-6
    patience: int = 6

    def __post_init__(self) -> None:
        check_fields(self)
        for item in fields(self):
            check_above(item.name, getattr(self, item.name), 0)


@dataclass(frozen=True)
class JointProblem:
    """What to plan. The grid of control instants has K = N * substeps steps.

    Attributes:
        starts: [p, v] at t = 0, shape (n, 4) [m, m/s].
        goals: [p, v] at the end, shape (n, 4).
        obstacles: Centres, shape (m, 2), or where they are at the control instants, shape
            (K + 1, m, 2) [m].
        obstacle_required: R_ij at the control instants, shape (K + 1, n, m) [m].
        pair_required: R_ij at the control instants for the pairs of `pairs`, shape (K + 1, P) [m].
        node_period: Time from node to node [s].
        substeps: Control steps in a node step.
        mass: m [kg].
        speed_limit: v_max per agent and axis, shape (n, 2) [m/s].
        arrivals: Node at which each agent is at its goal, and from which on it stays there without
            force, shape (n,); the last node if left out.
        start_cost: If given, a plan may begin beside `starts`: each axis' deviation e = (position,
            velocity) costs e'Qe / 2 with this positive definite Q, shape (2, 2).
        force_limit: Largest force per axis [N]; inf for none.
    """

    starts: FloatArray
    goals: FloatArray
    obstacles: FloatArray
    obstacle_required: FloatArray
    pair_required: FloatArray
    node_period: float
    substeps: int
    mass: float
    speed_limit: FloatArray
    arrivals: IntArray | None = None
    start_cost: FloatArray | None = None
    force_limit: float = math.inf

    @property
    def nodes(self) -> int:
        """Number N of node steps."""
        return (len(self.pair_required) - 1) // self.substeps

    @property
    def pairs(self) -> tuple[IntArray, IntArray]:
        """Indices of the agents of each pair, both of shape (P,)."""
        first, second = np.triu_indices(len(self.starts), 1)
        return first, second


def largest_violation(problem: JointProblem, places: FloatArray) -> float:
    """Return by how much the worst distance at a control instant falls short [m], at least 0.

    Args:
        problem: The problem.
        places: Positions at the control instants, shape (n, K + 1, 2) [m].
    """
    first, second = problem.pairs
    apart = lengths(places[first] - places[second]).T
    gaps = lengths(places[:, :, None] - problem.obstacles).transpose(1, 0, 2)
    short = [problem.pair_required - apart, problem.obstacle_required - gaps]
    return max(0.0, *(float(np.max(part, initial=0.0)) for part in short))
