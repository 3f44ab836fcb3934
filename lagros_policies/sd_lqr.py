"""The regulator of the exact error dynamics at every step: state-dependent Riccati equations."""

from __future__ import annotations

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import shown
from lagros_envs.dynamics import control_matrix
from lagros_envs.dynamics.system import state_dependent_coefficient
from lagros_envs.task import Feedback, Task
from lagros_policies.baselines import bryson_weights
from lagros_policies.expert import TrackedPlans
from lagros_policies.room import task_of
from lagros_policies.tube_mpc import TubeMpcPolicy, TubeMpcState

# Of the doubling: rounds at most, and the relative change at which the cost has settled.
_ROUNDS, _SETTLED = 40, 1e-13


class StateDependentRegulator:
    """u = u_d - K e, with K of a Riccati equation at (x, x_d, u_d) for the control that is held.

    With the SDC matrix A(x, x_d, u_d), e = x - x_d and v = u - u_d obey de/dt = A e + B(x) v
    without an error of linearisation. A and B are frozen for one hold, and K minimises the infinite
    sum of e'Qe + v'Rv of that loop (Cloutier 1997, discretised; as SD-LQR in Tsukamoto & Chung
    2021). Where no such gain exists, K is that of the linearisation at (x_d, u_d) and, where that
    has none either, zero; both count as a fallback.

    Args:
        task: The task.
        weights: Q and R; if left out, those that the law along a plan settles at.

    Raises:
        ImportError: SciPy is not installed.
    """

    name = "sd-lqr"

    def __init__(self, task: Task, weights: Feedback | None = None) -> None:
        try:
            import scipy.linalg  # noqa: F401
        except ImportError as error:
            raise ImportError("sd-lqr needs SciPy: pip install 'lagros[policies]'") from error
        if weights is not None and not isinstance(weights, Feedback):
            raise ValueError(f"weights={shown(weights)} must be a Feedback, or left out")
        self.task, self.weights = task, weights or bryson_weights(task)
        self._costs = (np.diag(self.weights.state_weights), np.diag(self.weights.control_weights))

    def __call__(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> FloatArray:
        """Return u, shape (s, m), at x (s, n), x_d (s, n), u_d (s, m)."""
        return self.answer(state, nominal, nominal_control)[0]

    def answer(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return u, shape (s, m), and where it is a fallback, shape (s,)."""
        gains, failed = self.gains(state, nominal, nominal_control)
        again = np.flatnonzero(failed)
        if len(again):
            gains[again] = self.gains(nominal[again], nominal[again], nominal_control[again])[0]
        control = nominal_control - np.einsum("smi,si->sm", gains, state - nominal)
        return control, failed

    def gains(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return K, shape (s, m, n), zero where there is none, and where that is, shape (s,)."""
        return held_gains(*self.held(state, nominal, nominal_control), *self._costs)

    def held(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return F, shape (s, n, n), and G, shape (s, n, m), of e after a hold of A and B."""
        from scipy.linalg import expm

        system = self.task.system
        slope = state_dependent_coefficient(system, state, nominal, nominal_control)
        reach = control_matrix(system, state)
        n, m = reach.shape[-2:]
        joint = np.zeros((len(state), n + m, n + m))
        joint[:, :n, :n], joint[:, :n, n:] = slope, reach
        moved = expm(self.task.control_period * joint)
        return moved[:, :n, :n], moved[:, :n, n:]


def held_gains(
    transition: FloatArray, effect: FloatArray, state_cost: FloatArray, control_cost: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the gains that minimise the infinite sum of e'Qe + v'Rv, of many loops at once.

    By doubling (Anderson 1978; Chu, Fan, Lin & Wang 2004): after k rounds H is the cost of 2^k
    holds, so that it settles in a dozen, and never where no gain exists.

    Args:
        transition: F, shape (s, n, n), of e+ = F e + G v.
        effect: G, shape (s, n, m).
        state_cost: Q, shape (n, n).
        control_cost: R, shape (m, m).

    Returns:
        K of v = -K e, shape (s, m, n), zero where there is none, and where that is, shape (s,).
    """
    turned = effect.swapaxes(-1, -2)
    with np.errstate(all="ignore"):  # what has no gain grows beyond all numbers
        moved, reach = transition, effect @ np.linalg.solve(control_cost, turned)
        cost = np.broadcast_to(state_cost, transition.shape)
        for _ in range(_ROUNDS):
            inner = np.eye(transition.shape[-1]) + reach @ cost
            # At once W^-1 A and W^-1 G, of which everything else is made.
            both = _solved(inner, np.concatenate([moved, reach], axis=-1))
            ahead, behind = np.split(both, 2, axis=-1)
            back = moved.swapaxes(-1, -2)
            more = back @ cost @ ahead
            reach = reach + moved @ behind @ back
            moved, cost = moved @ ahead, cost + more
            change = np.abs(more).max(axis=(-2, -1)) / np.abs(cost).max(axis=(-2, -1))
            if not np.any(change > _SETTLED):
                break
        paid = turned @ cost
        gains = _solved(control_cost + paid @ effect, paid @ transition)
    failed = ~(change <= _SETTLED) | ~np.isfinite(gains).all(axis=(-2, -1))
    return np.where(failed[:, None, None], 0.0, gains), failed


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve linear equations, one for each row; nan where one is singular to the last digit."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        if len(matrix) == 1:
            return np.full(right.shape, np.nan)
        rows = zip(np.split(matrix, len(matrix)), np.split(right, len(right)), strict=True)
        return np.concatenate([_solved(*row) for row in rows])


class SdLqrPolicy(TubeMpcPolicy):
    """`StateDependentRegulator` along the plan of `TubeMpcPolicy`.

    Args:
        settings: The task; None for the paper's.
        weights: Of the regulator; those that the law along a plan settles at if left out.
        deadline: As of `TubeMpcPolicy`.

    Raises:
        ImportError: SciPy is not installed.
        ValueError: As of `TubeMpcPolicy`.

    Attributes:
        law: The regulator.
    """

    restricted = False  # nothing of it was made before

    def __init__(
        self,
        settings: Task | None = None,
        weights: Feedback | None = None,
        deadline: float | None = None,
    ) -> None:
        self.law = StateDependentRegulator(task_of(settings), weights)
        super().__init__(self.law.task, deadline=deadline, law=self.law)

    def _wanted(
        self, tracked: TrackedPlans, step: int, state: FloatArray, memory: TubeMpcState
    ) -> FloatArray:
        index = step - tracked.first_step
        target = tracked.states[:, index], tracked.controls[:, index]
        control, failed = self.law.answer(state[None], *target)
        memory.fallbacks += int(failed[0])
        answer: FloatArray = control[0]
        return answer

    @property
    def _counted(self) -> tuple[str, ...]:
        return (*super()._counted, "fallbacks")
