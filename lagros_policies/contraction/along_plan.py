"""Metric and gain along one plan, from one program: sampled-data CV-STEM for a held control.

Along a plan the error of one hold is e_{k+1} = F_k e_k + G_k v_k to first order, F = dPhi/dx and
G = dPhi/du of the hold map Phi. Theorem 2 in the dual variables W = M^-1 and Y = K W reads, for
such a hold and v = K e,

    [exp(-2 alpha h) W_k, (F_k W_k + G_k Y_k)'; F_k W_k + G_k Y_k, W_{k+1}] >= 0,            (1)

which says that V_k = e'M_k e falls by exp(-2 alpha h). A Riccati recursion with a prescribed degree
of stability (Anderson and Moore 1971, section 4.2) solves it in closed form: with the weights Q_k
and R_k,

    M_k = Q_k + K_k'R_k K_k + exp(2 alpha h) (F_k + G_k K_k)'M_{k+1} (F_k + G_k K_k),          (2)

K_k the gain that makes M_k least. So (1) holds whatever the weights, Q_k + K_k'R_k K_k is its room,
and metric and gain belong together. The weights choose among the solutions of (1): they trade the
tube for the effort.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.task import Feedback
from lagros_policies.contraction.feedback import riccati_recursion


class PlanMetric(NamedTuple):
    """Metric and gain along plans.

    Attributes:
        matrices: M_k, shape (..., N + 1, n, n).
        gains: K_k of v = K_k e, shape (..., N, m, n).
    """

    matrices: FloatArray
    gains: FloatArray


def stage_weights(
    weights: Feedback, times: FloatArray | None, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return the diagonals of Q_k, shape (N + 1, n), and of R_k, shape (N, m).

    Args:
        weights: The weights.
        times: Control instants of a plan, shape (N + 1,) [s]; None for the settled weights.
        count: N + 1.
    """
    fading = np.zeros(count) if times is None else np.exp(-times / weights.settling)
    parts = []
    for settled, early in (
        (weights.state_weights, weights.early_state),
        (weights.control_weights, weights.early_control),
    ):
        begun = np.array(early or (0.0,) * len(settled))
        parts.append(np.array(settled) * np.exp(np.multiply.outer(fading, begun)))
    return parts[0], parts[1][:-1]


def plan_metric(
    by_state: FloatArray,
    by_control: FloatArray,
    state: FloatArray,
    control: FloatArray,
    decay: float,
) -> PlanMetric:
    """Return metric and gain along plans by the recursion (2) of this module.

    Args:
        by_state: F_k, shape (..., N, n, n).
        by_control: G_k, shape (..., N, n, m).
        state: Diagonals of Q_k, shape (..., N + 1, n); M_N is ten times Q_N.
        control: Diagonals of R_k, shape (..., N, m).
        decay: alpha h, the rate times the hold; zero for a plain regulator.
    """
    growth = np.exp(decay)
    gains, matrices = riccati_recursion(growth * by_state, growth * by_control, state, control)
    return PlanMetric(matrices, -gains)


def contraction_condition(
    metric: PlanMetric, by_state: FloatArray, by_control: FloatArray, decay: float
) -> FloatArray:
    """Return the left side of (1), multiplied by M_k and M_{k+1} from both sides.

    It is [exp(-2 alpha h) M_k, (F + G K)'M_{k+1}; M_{k+1} (F + G K), M_{k+1}], positive
    semidefinite where (1) is.

    Args:
        metric: Metric and gain.
        by_state: F_k, shape (..., N, n, n).
        by_control: G_k, shape (..., N, n, m).
        decay: alpha h.

    Returns:
        Shape (..., N, 2n, 2n).
    """
    here, after = metric.matrices[..., :-1, :, :], metric.matrices[..., 1:, :, :]
    moved = after @ (by_state + by_control @ metric.gains)
    above = np.concatenate([np.exp(-2.0 * decay) * here, np.swapaxes(moved, -1, -2)], axis=-1)
    below = np.concatenate([moved, after], axis=-1)
    condition: FloatArray = np.concatenate([above, below], axis=-2)
    return condition
