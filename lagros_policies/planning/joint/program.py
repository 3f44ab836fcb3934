"""One quadratic program of `solve_joint`: unknowns, dynamics and half-planes."""

from __future__ import annotations

import math

import numpy as np
from scipy import sparse

from lagros_envs.arrays import FloatArray, IntArray
from lagros_policies.planning.joint.problem import JointProblem, JointScpSettings
from lagros_policies.planning.qp import UNBOUNDED, QuadraticProgram
from lagros_policies.planning.vectors import lengths, unit_vectors

# Entries of some equalities by row, column and value, and their right sides.
Equalities = tuple[list[tuple[IntArray, IntArray, FloatArray]], FloatArray]

_PLACE, _SPEED = slice(0, 2), slice(2, 4)  # in a state


class ProgramLayout:
    """Where the unknowns lie, and the part of the program that no pass changes.

    Unknowns: per node the forces and states of all agents, then two per half-plane: by how much it
    is violated and by how much it is kept.
    """

    def __init__(self, problem: JointProblem) -> None:
        """Number the unknowns."""
        nodes, n = problem.nodes, len(problem.starts)
        block = np.arange(nodes + 1)[:, None, None] * (6 * n)
        agent = np.arange(n)[None, :, None] * 6
        forces = block + agent + np.arange(2)  # (N + 1, n, 2)
        self.forces = forces[:nodes]
        self.states = block + agent + 2 + np.arange(4)  # (N + 1, n, 4)
        self.size = (nodes + 1) * 6 * n
        # From the arrival on, the last node included, there is no force: pinned to zero.
        arrivals = np.full(n, nodes) if problem.arrivals is None else problem.arrivals
        self.idle = forces[np.arange(nodes + 1)[:, None] >= arrivals].ravel()
        self.start_errors = np.empty(0, dtype=np.intp)
        self.count = 0
        parts = self._dynamics(problem), self._goals(problem, arrivals), self._starts(problem)
        entries = [entry for some, _ in parts for entry in some]
        self.rows, self.columns, self.values = (
            np.concatenate([entry[index].ravel() for entry in entries]) for index in range(3)
        )
        self.target = np.concatenate([target.ravel() for _, target in parts])

    def _new_rows(self, shape: tuple[int, ...]) -> IntArray:
        """Return the numbers of as many new equalities, in this shape."""
        rows = self.count + np.arange(math.prod(shape)).reshape(shape)
        self.count += rows.size
        return rows

    def _dynamics(self, problem: JointProblem) -> Equalities:
        """Double integrators under forces that are held between the nodes."""
        h = problem.node_period
        here, there = self.states[:-1], self.states[1:]
        rows = self._new_rows(here.shape)
        one = np.ones(here[..., _PLACE].shape)
        entries = [
            (rows[..., _PLACE], there[..., _PLACE], one),
            (rows[..., _PLACE], here[..., _PLACE], -one),
            (rows[..., _PLACE], here[..., _SPEED], -h * one),
            (rows[..., _PLACE], self.forces, -0.5 * h**2 / problem.mass * one),
            (rows[..., _SPEED], there[..., _SPEED], one),
            (rows[..., _SPEED], here[..., _SPEED], -one),
            (rows[..., _SPEED], self.forces, -h / problem.mass * one),
        ]
        return entries, np.zeros(rows.shape)

    def _goals(self, problem: JointProblem, arrivals: IntArray) -> Equalities:
        """Every agent at its goal at its arrival."""
        rows = self._new_rows(problem.goals.shape)
        states = self.states[arrivals, np.arange(len(arrivals))]
        return [(rows, states, np.ones(rows.shape))], problem.goals

    def _starts(self, problem: JointProblem) -> Equalities:
        """Every agent at its start, or beside it by unknowns r = U e with Q = U'U.

        These make the cost of the deviation e a diagonal one.
        """
        starts, first = problem.starts, self.states[0]
        rows = self._new_rows(starts.shape)
        if problem.start_cost is None:
            return [(rows, first, np.ones(rows.shape))], starts
        root = np.linalg.cholesky(problem.start_cost).T
        self.start_errors = self.size + np.arange(starts.size)
        self.size += starts.size
        n = len(starts)
        entries = [
            (rows[:, _PLACE], first[:, _PLACE], np.full((n, 2), root[0, 0])),
            (rows[:, _PLACE], first[:, _SPEED], np.full((n, 2), root[0, 1])),
            (rows[:, _SPEED], first[:, _SPEED], np.full((n, 2), root[1, 1])),
            (rows.ravel(), self.start_errors, np.full(rows.size, -1.0)),
        ]
        place, speed = starts[:, _PLACE], starts[:, _SPEED]
        return entries, np.hstack([root[0, 0] * place + root[0, 1] * speed, root[1, 1] * speed])

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
        largest = min(problem.force_limit, UNBOUNDED)
        low[self.forces], high[self.forces] = -largest, largest
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
    distance = lengths(delta)
    required = problem.obstacle_required.transpose(1, 0, 2)
    agent, instant, disc = np.nonzero(distance < required + reach[None, :, None])
    chosen = agent, instant, disc
    normal = unit_vectors(delta[chosen], distance[chosen])
    centres = np.broadcast_to(problem.obstacles, (last + 1, *problem.obstacles.shape[-2:]))
    offset = required[chosen] + np.sum(normal * centres[instant, disc], axis=-1)
    # Pairs.
    between = places[first] - places[second]
    apart = lengths(between)
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
