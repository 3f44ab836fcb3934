"""Sequential convex programming with a trust region for least-effort trajectories.

The problem is the paper's (19): min of the integral of ||u||^2 subject to the dynamics, a fixed
initial state, a fixed terminal state, bounds on the states in between and, where there is a limit,
on the controls. Each pass linearises the held Runge-Kutta dynamics, solves one sparse quadratic
program, and accepts the step if it lowers an exact penalty of the true problem. The defects are
those of the true dynamics at every pass; the slopes come from a coarser Runge-Kutta step, which
moves the limit by far less than the tolerance on effort and halves the cost of a pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from lagros_envs.checks import check_above, check_fields
from lagros_envs.dynamics import System, hold_step, linearise_hold
from lagros_policies.planning.qp import UNBOUNDED, QuadraticProgram, solve_qp
from lagros_policies.planning.trajectory import Trajectory

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class ScpSettings:
    """How long and how precisely to iterate.

    Attributes:
        max_iterations: Quadratic programs at most.
        defect_tolerance: Largest violation of the true dynamics of an accepted plan.
        step_tolerance: Stop when no state (and no control, times the period) moves by more.
        qp_tolerance: Residual of the quadratic programs.
        trust_weight: Weight of the squared step, the trust region in its penalty form, at first.
        trust_weight_max: Give up when the weight that a decrease would need exceeds this.
        penalty: Weight of the violation of the dynamics in the merit function.
        slope_substeps: Runge-Kutta substeps behind the slopes.

    Raises:
        ValueError: A value is not positive.
    """

    max_iterations: int = 60
    defect_tolerance: float = 1e-7
    step_tolerance: float = 1e-3
    qp_tolerance: float = 1e-8
    trust_weight: float = 1e-3
    trust_weight_max: float = 1e6
    penalty: float = 1e3
    slope_substeps: int = 2

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        for item in fields(self):
            check_above(item.name, getattr(self, item.name), 0)


@dataclass(frozen=True)
class _Layout:
    """Where the unknowns z = [u_0, x_1, u_1, x_2, ...] and the equality's entries lie."""

    controls: IntArray  # (N, m) places of u_k in z
    states: IntArray  # (N, n) places of x_{k+1} in z
    indices: IntArray  # rows of the compressed columns of the equality
    pointers: IntArray  # column pointers
    order: IntArray  # permutation from assembly order to compressed columns


def _layout(horizon: int, n: int, m: int) -> _Layout:
    stage = np.arange(horizon)[:, None] * (n + m)
    controls = stage + np.arange(m)
    states = stage + m + np.arange(n)
    row = np.arange(horizon)[:, None] * n + np.arange(n)
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
        (np.arange(1, place[0].size + 1), place), shape=(horizon * n, horizon * (n + m))
    )
    return _Layout(controls, states, numbered.indices, numbered.indptr, numbered.data - 1)


class ScpSolver:
    """Plans least-effort trajectories of one system at one control period.

    Args:
        system: The system.
        period: Control period [s].
        settings: How to iterate.
        control_limit: Largest magnitude of each control.
    """

    def __init__(
        self,
        system: System,
        period: float,
        settings: ScpSettings | None = None,
        control_limit: float = math.inf,
    ) -> None:
        """Remember the problem's constants."""
        self.system = system
        self.period = period
        self.control_limit = min(control_limit, UNBOUNDED)
        self.settings = settings or ScpSettings()
        # The sparsity of each horizon met so far.
        self._layouts: dict[int, _Layout] = {}

    def solve(
        self,
        initial_state: FloatArray,
        terminal_state: FloatArray,
        low: FloatArray,
        high: FloatArray,
        guess: tuple[FloatArray, FloatArray] | None = None,
    ) -> Trajectory:
        """Plan from one state to another.

        Args:
            initial_state: x_d(0), shape (n,).
            terminal_state: x_d(T), shape (n,).
            low: Lower bounds of x_1 ... x_{N-1}, shape (N - 1, n), which says N; -inf for none.
            high: Upper bounds, likewise.
            guess: States (N + 1, n) and controls (N, m) to start from; a straight line without.

        Returns:
            The plan; `solved` is False, and `status` says why, where it does not hold.
        """
        if guess is None:
            horizon = len(low) + 1
            states = np.linspace(initial_state, terminal_state, horizon + 1)
            controls = np.zeros((horizon, self.system.control_dim))
        else:
            states, controls = guess[0].copy(), guess[1].copy()
            # A warm start need not end where this problem ends: the linearisation pulls it there.
            states[0], states[-1] = initial_state, terminal_state
        bounds = _clean(low, -UNBOUNDED), _clean(high, UNBOUNDED)
        return self._iterate(states, controls, bounds)

    def _iterate(
        self, states: FloatArray, controls: FloatArray, bounds: tuple[FloatArray, FloatArray]
    ) -> Trajectory:
        settings = self.settings
        weight = settings.trust_weight
        following = self._propagate(states, controls)
        by_state, by_control = self._slopes(states, controls)
        merit = self._merit(states, controls, following, bounds)
        status = f"no convergence in {settings.max_iterations} quadratic programs"
        iterations = 0
        solved = False
        while iterations < settings.max_iterations:
            program = self._program(
                states, controls, following, by_state, by_control, bounds, weight
            )
            iterations += 1
            answer = solve_qp(program, settings.qp_tolerance)
            if not answer.solved:
                status = f"quadratic program {iterations} failed ({answer.status})"
                break
            layout = self._layouts[len(controls)]
            new_states = np.vstack([states[:1], answer.values[layout.states]])
            new_controls = answer.values[layout.controls]
            new_following = self._propagate(new_states, new_controls)
            new_merit = self._merit(new_states, new_controls, new_following, bounds)
            step = max(
                float(np.max(np.abs(new_states - states))),
                self.period * float(np.max(np.abs(new_controls - controls))),
            )
            # Differences below the programs' own tolerance say nothing.
            if not new_merit <= merit + 1e-6 * (1.0 + abs(merit)):
                weight = max(8.0 * weight, 1e-2)
                if weight > settings.trust_weight_max:
                    status = f"trust region exhausted at weight {weight:.0e}"
                    break
                continue
            states, controls, merit = new_states, new_controls, new_merit
            following = new_following
            weight = max(weight / 8.0, settings.trust_weight)
            defect = float(np.max(np.abs(following - states[1:])))
            if defect <= settings.defect_tolerance and step <= settings.step_tolerance:
                solved, status = True, "solved"
                break
            by_state, by_control = self._slopes(states, controls)
        defect = float(np.max(np.abs(following - states[1:])))
        return Trajectory(states, controls, self.period, solved, status, defect, iterations)

    def _propagate(self, states: FloatArray, controls: FloatArray) -> FloatArray:
        return hold_step(self.system, states[:-1], controls, self.period)

    def _slopes(self, states: FloatArray, controls: FloatArray) -> tuple[FloatArray, FloatArray]:
        substeps = self.settings.slope_substeps
        _, by_state, by_control = linearise_hold(
            self.system, states[:-1], controls, self.period, substeps
        )
        return by_state, by_control

    def _merit(
        self,
        states: FloatArray,
        controls: FloatArray,
        following: FloatArray,
        bounds: tuple[FloatArray, FloatArray],
    ) -> float:
        """Return effort plus the weighted violation of dynamics and bounds (exact penalty)."""
        inner = states[1:-1]
        violation = np.sum(np.abs(following - states[1:]))
        violation += np.sum(np.maximum(bounds[0] - inner, 0.0))
        violation += np.sum(np.maximum(inner - bounds[1], 0.0))
        if self.control_limit < UNBOUNDED:
            # A guess may exceed it; no program does.
            violation += np.sum(np.maximum(np.abs(controls) - self.control_limit, 0.0))
        return float(np.sum(controls**2) * self.period + self.settings.penalty * violation)

    def _program(
        self,
        states: FloatArray,
        controls: FloatArray,
        following: FloatArray,
        by_state: FloatArray,
        by_control: FloatArray,
        bounds: tuple[FloatArray, FloatArray],
        weight: float,
    ) -> QuadraticProgram:
        horizon, m = controls.shape
        n = states.shape[1]
        if horizon not in self._layouts:
            self._layouts[horizon] = _layout(horizon, n, m)
        layout = self._layouts[horizon]
        entries = np.concatenate([np.ones(horizon * n), -by_control.ravel(), -by_state[1:].ravel()])
        equality = sparse.csc_matrix(
            (entries[layout.order], layout.indices, layout.pointers),
            shape=(horizon * n, horizon * (n + m)),
        )
        offset = following - np.einsum("kij,kj->ki", by_control, controls)
        offset[1:] -= np.einsum("kij,kj->ki", by_state[1:], states[1:-1])
        reference = np.empty(horizon * (n + m))
        reference[layout.controls] = controls
        reference[layout.states] = states[1:]
        diagonal = np.full(reference.size, weight)
        diagonal[layout.controls] += 2.0 * self.period
        low = np.full(reference.size, -UNBOUNDED)
        high = np.full(reference.size, UNBOUNDED)
        low[layout.states[:-1]], high[layout.states[:-1]] = bounds
        low[layout.controls], high[layout.controls] = -self.control_limit, self.control_limit
        low[layout.states[-1]] = high[layout.states[-1]] = states[-1]
        return QuadraticProgram(diagonal, -weight * reference, equality, offset.ravel(), low, high)


def _clean(bound: FloatArray, absent: float) -> FloatArray:
    return np.where(np.isfinite(bound), bound, absent)
