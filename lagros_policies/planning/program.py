"""One quadratic program of the planner of one body: unknowns, linearised dynamics, half-spaces.

The unknowns are u_0, x_1, u_1, x_2, ... in units of the problem's scales, and two per half-space:
by how much it is violated and by how much it is kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import sparse

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.dynamics.system import components
from lagros_envs.numbers import dual
from lagros_envs.numbers import functions as elementary
from lagros_policies.planning.problem import Problem
from lagros_policies.planning.qp import UNBOUNDED, QuadraticProgram
from lagros_policies.planning.vectors import unit_vectors


@dataclass(frozen=True)
class Layout:
    """Where the unknowns and the entries of the linearised dynamics lie.

    Attributes:
        controls: Places of u_k, shape (N, m).
        states: Places of x_{k+1}, shape (N, n).
        indices: Rows of the compressed columns of the dynamics.
        pointers: Their column pointers.
        order: Permutation from assembly order to compressed columns.
    """

    controls: IntArray
    states: IntArray
    indices: IntArray
    pointers: IntArray
    order: IntArray


@dataclass(frozen=True)
class Point:
    """A trajectory of an iteration, with what is known of it.

    Attributes:
        states: x_0 ... x_N, shape (N + 1, n).
        controls: u_0 ... u_{N-1}, shape (N, m).
        following: F(x_k, u_k), shape (N, n).
        required: Distances that the nodes must keep, shape (N + 1, k), or None without discs.
        clearance: Least distance beyond what the problem requires.
        excess: Largest of what the problem keeps at or below zero.
        merit: Effort plus the weighted violations.
    """

    states: FloatArray
    controls: FloatArray
    following: FloatArray
    required: FloatArray | None = None
    clearance: float = math.inf
    excess: float = -math.inf
    merit: float = math.inf

    @property
    def defect(self) -> float:
        """Largest violation of the dynamics."""
        return float(np.max(np.abs(self.following - self.states[1:])))


class HalfSpaces(NamedTuple):
    """Conditions slope'x_k >= bound on states in scales.

    Attributes:
        node: k of each, shape (r,).
        slope: Shape (r, n).
        bound: Shape (r,).
    """

    node: IntArray
    slope: FloatArray
    bound: FloatArray


@lru_cache(maxsize=256)
def layout(steps: int, n: int, m: int) -> Layout:
    """Return the layout of a program of N steps, n states and m controls."""
    stage = np.arange(steps)[:, None] * (n + m)
    controls = stage + np.arange(m)
    states = stage + m + np.arange(n)
    row = np.arange(steps)[:, None] * n + np.arange(n)
    # Assembly order: the identity on x_{k+1}, then -B_k on u_k, then -A_k on x_k for k >= 1.
    rows = [
        row.ravel(),
        np.repeat(row[:, :, None], m, axis=2).ravel(),
        np.repeat(row[1:, :, None], n, axis=2).ravel(),
    ]
    columns = [
        states.ravel(),
        np.repeat(controls[:, None, :], n, axis=1).ravel(),
        np.repeat(states[:-1, None, :], n, axis=1).ravel(),
    ]
    place = np.concatenate(rows), np.concatenate(columns)
    numbered = sparse.csc_matrix(
        (np.arange(1, place[0].size + 1), place), shape=(steps * n, steps * (n + m))
    )
    return Layout(controls, states, numbered.indices, numbered.indptr, numbered.data - 1)


class Programs:
    """The quadratic programs of one problem.

    Args:
        problem: What to plan.
        penalty: Weight of a violated half-space, in scales.
        reach: A half-space is imposed where a trajectory is nearer to its border, with all that is
            required, than so many scales.
        spare: How much more than zero is asked of what the problem keeps at or below it.
    """

    def __init__(self, problem: Problem, penalty: float, reach: float, spare: float = 0.0) -> None:
        """Compute what no pass changes."""
        self.problem, self.penalty, self.reach, self.spare = problem, penalty, reach, spare
        n, m, steps = problem.system.state_dim, problem.system.control_dim, problem.steps
        self.place = place = layout(steps, n, m)
        self._shape = steps * n, steps * (n + m)
        x_scale, u_scale = problem.state_scale, problem.control_scale
        self._ones = np.ones(steps * n)
        self._by_state, self._by_control = (
            scale / x_scale[:, None] for scale in (x_scale, u_scale)
        )
        # In units of the largest scale, so that effort and penalty stay comparable in all units.
        self._effort = 2.0 * problem.period * (u_scale / np.max(u_scale)) ** 2
        self._effortless = self._effort * (problem.reference_control / u_scale)
        # u_k, then x_{k+1}, as in the layout.
        low = np.concatenate([problem.control_low / u_scale, problem.state_low / x_scale], axis=1)
        high = np.concatenate(
            [problem.control_high / u_scale, problem.state_high / x_scale], axis=1
        )
        self._low = np.maximum(low.ravel(), -UNBOUNDED)
        self._high = np.minimum(high.ravel(), UNBOUNDED)
        self._given = problem.given_end
        self._end = place.states[-1][self._given]

    def states_and_controls(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x_1 ... x_N, shape (N, n), and the controls (N, m) of a program's solution."""
        states = values[self.place.states] * self.problem.state_scale
        return states, values[self.place.controls] * self.problem.control_scale

    def around(
        self, point: Point, slopes: tuple[FloatArray, FloatArray], trust_weight: float
    ) -> QuadraticProgram:
        """Return the program around a trajectory.

        Args:
            point: The trajectory.
            slopes: dF/dx, shape (N, n, n), and dF/du, shape (N, n, m), along it.
            trust_weight: Weight of the squared step, in scales.
        """
        place, x_scale, u_scale = self.place, self.problem.state_scale, self.problem.control_scale
        by_control = slopes[1] * self._by_control
        by_state = slopes[0][1:] * self._by_state
        controls, states = point.controls / u_scale, point.states[1:] / x_scale
        entries = np.concatenate([self._ones, -by_control.ravel(), -by_state.ravel()])
        equality = sparse.csc_matrix(
            (entries[place.order], place.indices, place.pointers), shape=self._shape
        )
        target = point.following / x_scale - np.einsum("kij,kj->ki", by_control, controls)
        target[1:] -= np.einsum("kij,kj->ki", by_state, states[:-1])
        linear = np.empty(self._shape[1])
        linear[place.controls] = -trust_weight * controls - self._effortless
        linear[place.states] = -trust_weight * states
        diagonal = np.full(linear.size, trust_weight)
        diagonal[place.controls] += self._effort
        low, high = self._low.copy(), self._high.copy()
        # The trajectory ends where the problem does, to within the solvers' tolerance.
        low[self._end] = high[self._end] = states[-1][self._given]
        program = QuadraticProgram(diagonal, linear, equality, target.ravel(), low, high)
        found = [] if point.required is None else [self._beside_discs(point)]
        found += [] if self.problem.keep is None else [self._kept(point)]
        parts = [np.concatenate(part) for part in zip(*found, strict=True)]
        return self._within(program, HalfSpaces(*parts)) if parts else program

    def _kept(self, point: Point) -> HalfSpaces:
        """Return g + (dg/dx)'(x - x_k) <= 0 for what the problem keeps, where it is near zero."""
        problem, states = self.problem, point.states[1:]
        assert problem.keep is not None
        numbers = list(problem.keep(dual.seed(components(states)), elementary))
        slopes = dual.gradients(numbers, states.shape[1], states.shape[:1])
        values = np.stack([number.value for number in numbers], axis=-1) + self.spare
        node, which = np.nonzero(values > -self.reach)
        slope = slopes[node, which]
        bound = values[node, which] - np.einsum("ri,ri->r", slope, states[node])
        return HalfSpaces(node + 1, -slope * problem.state_scale, bound)

    def _beside_discs(self, point: Point) -> HalfSpaces:
        """Return n'p_k >= R + n'o for the discs near each node."""
        problem, required = self.problem, point.required
        assert problem.discs is not None
        assert required is not None
        axes, centres = list(problem.discs.position), problem.discs.centres
        scale = float(np.max(problem.state_scale[axes]))
        delta = point.states[:, None, axes] - centres
        distance = np.linalg.norm(delta, axis=-1)
        near = distance < required + self.reach * scale
        # Where an end is given nothing can be imposed.
        near[0] = False
        if np.all(self._given[axes]):
            near[-1] = False
        node, disc = np.nonzero(near)
        normal = unit_vectors(delta[node, disc], distance[node, disc])
        offset = required[node, disc] + np.sum(normal * centres[disc], axis=-1)
        slope = np.zeros((node.size, problem.system.state_dim))
        slope[:, axes] = normal * problem.state_scale[axes] / scale
        return HalfSpaces(node, slope, offset / scale)

    def _within(self, program: QuadraticProgram, spaces: HalfSpaces) -> QuadraticProgram:
        """Add slope'x_k + violated - kept = bound for each half-space."""
        count, size = spaces.node.size, program.cost_diagonal.size
        one, row = np.ones(count), np.arange(count)
        which, coordinate = np.nonzero(spaces.slope)
        places = self.place.states[spaces.node[which] - 1, coordinate]
        planes = sparse.csc_matrix(
            (
                np.concatenate([spaces.slope[which, coordinate], one, -one]),
                (
                    np.concatenate([which, row, row]),
                    np.concatenate([places, size + np.arange(2 * count)]),
                ),
            ),
            shape=(count, size + 2 * count),
        )
        dynamics = program.equality
        pointers = np.concatenate([dynamics.indptr, np.full(2 * count, dynamics.indptr[-1])])
        wide = sparse.csc_matrix(
            (dynamics.data, dynamics.indices, pointers),
            shape=(len(program.target), planes.shape[1]),
        )
        return QuadraticProgram(
            np.concatenate([program.cost_diagonal, np.zeros(2 * count)]),
            np.concatenate([program.cost_linear, self.penalty * one, 0.0 * one]),
            sparse.vstack([wide, planes], format="csc"),
            np.concatenate([program.target, spaces.bound]),
            np.concatenate([program.low, np.zeros(2 * count)]),
            np.concatenate([program.high, np.full(2 * count, UNBOUNDED)]),
        )
