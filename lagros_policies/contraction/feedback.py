"""The regulator along a plan, which u* prefers where contraction leaves it a choice."""

from __future__ import annotations

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import FloatArray

moved_names(__name__)

# The terminal weight, in units of the last stage weight.
_TERMINAL_WEIGHT = 10.0


def riccati_gains(
    by_state: FloatArray, by_control: FloatArray, state: FloatArray, control: FloatArray
) -> FloatArray:
    """Return the gains of `riccati_recursion` alone."""
    return riccati_recursion(by_state, by_control, state, control)[0]


def riccati_recursion(
    by_state: FloatArray, by_control: FloatArray, state: FloatArray, control: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solve the backward Riccati recursion of a time-varying regulator.

    Args:
        by_state: A_k, shape (..., N, n, n).
        by_control: B_k, shape (..., N, n, m).
        state: Diagonals of Q_k, shape (..., N + 1, n).
        control: Diagonals of R_k, shape (..., N, m).

    Returns:
        K_k of v = -K_k e, shape (..., N, m, n), and P_k, whose e'P_k e is what is left to pay from
        step k on, shape (..., N + 1, n, n).
    """
    steps, n, m = by_control.shape[-3:]
    batch = np.broadcast_shapes(by_state.shape[:-3], state.shape[:-2])
    gains, values = np.empty((*batch, steps, m, n)), np.empty((*batch, steps + 1, n, n))
    eye = np.eye(n)
    values[..., steps, :, :] = _TERMINAL_WEIGHT * state[..., -1, :, None] * eye
    value = values[..., steps, :, :]
    for step in range(steps - 1, -1, -1):
        slope, push = by_state[..., step, :, :], by_control[..., step, :, :]
        ahead = value @ slope
        pull = np.swapaxes(push, -1, -2) @ ahead
        stiffness = np.swapaxes(push, -1, -2) @ value @ push
        stiffness = control[..., step, :, None] * np.eye(m) + stiffness
        # A quotient of numbers is several times faster than a system of one equation.
        gain = pull / stiffness if m == 1 else np.linalg.solve(stiffness, pull)
        value = state[..., step, :, None] * eye + np.swapaxes(slope, -1, -2) @ ahead
        value = value - np.swapaxes(pull, -1, -2) @ gain
        # What rounding leaves of asymmetry would grow with an unstable system.
        value = 0.5 * (value + np.swapaxes(value, -1, -2))
        gains[..., step, :, :], values[..., step, :, :] = gain, value
    return gains, values
