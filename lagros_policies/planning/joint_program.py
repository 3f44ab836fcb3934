"""One quadratic program of the joint planner, `joint_scp`: unknowns, dynamics and half-planes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from lagros_policies.planning.joint_problem import JointProblem, JointScpSettings
from lagros_policies.planning.qp import UNBOUNDED, QuadraticProgram
from lagros_policies.planning.vectors import unit_vectors

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


class ProgramLayout:
    """Where the unknowns lie, and the part of the program that no pass changes.

    Unknowns: per node the forces and states of all agents, then two per half-plane: by how much it
    is violated and by how much it is kept.

    Args:
        problem: What to plan.
    """

    def __init__(self, problem: JointProblem) -> None:
        """Number the unknowns."""
        nodes, n = problem.nodes, len(problem.starts)
        block = np.arange(nodes + 1)[:, None, None] * (6 * n)
        agent = np.arange(n)[None, :, None] * 6
        self.forces = (block + agent + np.arange(2))[:nodes]  # (N, n, 2)
        self.states = block + agent + 2 + np.arange(4)  # (N + 1, n, 4)
        # From the arrival on, the last node included, there is no force: pinned to zero.
        self.size = (nodes + 1) * 6 * n
        h = problem.node_period
        here, there = self.states[:-1], self.states[1:]
        place, speed = slice(0, 2), slice(2, 4)
        one = np.ones(here[..., place].shape)
        rows = np.arange(nodes * n * 4).reshape(nodes, n, 4)
        entries = [
            (rows[..., place], there[..., place], one),
            (rows[..., place], here[..., place], -one),
            (rows[..., place], here[..., speed], -h * one),
            (rows[..., place], self.forces, -0.5 * h**2 / problem.mass * one),
            (rows[..., speed], there[..., speed], one),
            (rows[..., speed], here[..., speed], -one),
            (rows[..., speed], self.forces, -h / problem.mass * one),
        ]
        count = rows.size
        goal_target = problem.goals
        ends = count + np.arange(goal_target.size).reshape(goal_target.shape)
        arrivals = np.full(n, nodes) if problem.arrivals is None else problem.arrivals
        entries.append((ends, self.states[arrivals, np.arange(n)], np.ones(goal_target.shape)))
        stays = np.arange(nodes + 1)[:, None] >= arrivals
        self.idle = (block + agent + np.arange(2))[stays].ravel()
        count += goal_target.size
        start = count + np.arange(problem.starts.size).reshape(problem.starts.shape)
        start_target = problem.starts
        self.start_errors = np.empty(0, dtype=np.intp)
        if problem.start_cost is None:
            entries.append((start, self.states[0], np.ones(start_target.shape)))
        else:
            # Unknowns r = U e with Q = U'U make the cost of the deviation a diagonal one.
            root = np.linalg.cholesky(problem.start_cost).T
            self.start_errors = self.size + np.arange(start_target.size)
            self.size += start_target.size
            first = self.states[0]
            entries += [
                (start[:, place], first[:, place], np.full((n, 2), root[0, 0])),
                (start[:, place], first[:, speed], np.full((n, 2), root[0, 1])),
                (start[:, speed], first[:, speed], np.full((n, 2), root[1, 1])),
                (start.ravel(), self.start_errors, np.full(start.size, -1.0)),
            ]
            start_target = np.hstack(
                [
                    root[0, 0] * problem.starts[:, :2] + root[0, 1] * problem.starts[:, 2:],
                    root[1, 1] * problem.starts[:, 2:],
                ]
            )
        count += start_target.size
        self.count = count
        self.rows, self.columns, self.values = (
            np.concatenate([part[index].ravel() for part in entries]) for index in range(3)
        )
        self.target = np.concatenate(
            [np.zeros(rows.size), goal_target.ravel(), start_target.ravel()]
        )

    def program(
        self, problem: JointProblem, places: FloatArray, settings: JointScpSettings
    ) -> QuadraticProgram:
        """Return the quadratic program around positions (n, K + 1, 2)."""
        instant, agents, signs, normals, offset = _half_planes(problem, places, settings)
        rows, columns, values = self._entries(problem, instant, agents, signs, normals)
        count = len(instant)
        extra = self.size + np.arange(2 * count)
        plane = self.count + np.arange(count)
        equality = sparse.coo_matrix(
            (
                np.concatenate([self.values, values, np.ones(count), -np.ones(count)]),
                (
                    np.concatenate([self.rows, rows, plane, plane]),
                    np.concatenate([self.columns, columns, extra]),
                ),
            ),
            shape=(self.count + count, self.size + 2 * count),
        ).tocsc()
        size = self.size + 2 * count
        diagonal = np.zeros(size)
        diagonal[self.forces] = problem.node_period
        diagonal[self.start_errors] = 1.0
        linear = np.zeros(size)
        linear[self.size : self.size + count] = settings.penalty
        low, high = np.full(size, -UNBOUNDED), np.full(size, UNBOUNDED)
        low[self.size :] = 0.0
        low[self.idle] = high[self.idle] = 0.0
        speeds = self.states[1:-1, :, 2:]
        low[speeds], high[speeds] = -problem.speed_limit, problem.speed_limit
        target = np.concatenate([self.target, offset])
        return QuadraticProgram(diagonal, linear, equality, target, low, high)

    def _entries(
        self,
        problem: JointProblem,
        instant: IntArray,
        agents: IntArray,
        signs: FloatArray,
        normals: FloatArray,
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Return the entries of the half-planes on forces and states."""
        node = instant // problem.substeps
        time = (instant - node * problem.substeps) * (problem.node_period / problem.substeps)
        rows, columns, values = [], [], []
        for column in range(agents.shape[1]):
            takes_part = np.flatnonzero(signs[:, column] != 0.0)
            agent, k = agents[takes_part, column], node[takes_part]
            slope = signs[takes_part, column, None] * normals[takes_part]
            t = time[takes_part, None]
            for place, weight in (
                (self.states[k, agent, :2], np.ones_like(t)),
                (self.states[k, agent, 2:], t),
                (self.forces[np.minimum(k, problem.nodes - 1), agent], 0.5 * t**2 / problem.mass),
            ):
                keep = np.broadcast_to(weight != 0.0, slope.shape)
                row = np.broadcast_to((self.count + takes_part)[:, None], slope.shape)
                rows.append(row[keep])
                columns.append(place[keep])
                values.append((weight * slope)[keep])
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def _half_planes(
    problem: JointProblem, places: FloatArray, settings: JointScpSettings
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Linearise the distances that matter around positions.

    Returns:
        Control instant (r,), the two agents (r, 2), their signs (r, 2), unit normals (r, 2) and
        right sides (r,): sum of sign * normal'p >= right side.
    """
    last = places.shape[1] - 1
    reach = np.where(np.arange(last + 1) % problem.substeps == 0, settings.reach, settings.near)
    # Where an end is given nothing can be imposed.
    reach[last] = -np.inf
    if problem.start_cost is None:
        reach[0] = -np.inf
    first, second = problem.pairs
    # Obstacles: the second agent takes no part.
    delta = places[:, :, None, :] - problem.obstacles
    distance = np.linalg.norm(delta, axis=-1)
    required = problem.obstacle_required.transpose(1, 0, 2)
    agent, instant, disc = np.nonzero(distance < required + reach[None, :, None])
    chosen = agent, instant, disc
    normal = unit_vectors(delta[chosen], distance[chosen])
    offset = required[chosen] + np.sum(normal * problem.obstacles[disc], axis=-1)
    # Pairs.
    between = places[first] - places[second]
    apart = np.linalg.norm(between, axis=-1)
    needed = problem.pair_required.T
    pair, when = np.nonzero(apart < needed + reach[None, :])
    side = unit_vectors(between[pair, when], apart[pair, when])
    return (
        np.concatenate([instant, when]),
        np.concatenate(
            [np.stack([agent, agent], axis=1), np.stack([first[pair], second[pair]], axis=1)]
        ),
        np.concatenate(
            [np.tile([1.0, 0.0], (len(agent), 1)), np.tile([1.0, -1.0], (len(pair), 1))]
        ),
        np.concatenate([normal, side]),
        np.concatenate([offset, needed[pair, when]]),
    )
