"""Runge-Kutta integration under a control that is held over one control step."""

from __future__ import annotations

from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics.system import Components, System, components
from lagros_envs.numbers import dual, functions

# With 4 substeps of 0.025 s, halving the substep moves no state of a controlled 9 s episode by
# 1e-4 (3e-5 along tracked least-effort plans); with 2 it moves some by 5e-4.
SUBSTEPS = 4


def rk4_hold(
    system: System,
    state: Components,
    control: Components,
    disturbance: Components,
    duration: float,
    functions: Any,
    substeps: int = SUBSTEPS,
) -> Components:
    """Integrate dx/dt = f(x) + B(x) u + d with u and d constant, by classical Runge-Kutta.

    Args:
        system: The system.
        state: x at the start, one entry per coordinate (floats, arrays or duals).
        control: u, one entry per control.
        disturbance: d, one entry per coordinate, in units of the state per second.
        duration: Length of the control step [s].
        functions: Namespace of elementary functions for that kind of number.
        substeps: Runge-Kutta steps in the control step.

    Returns:
        x at the end, one entry per coordinate.
    """
    h = duration / substeps
    half, sixth = 0.5 * h, h / 6.0
    derivative = system.derivative
    x = state
    d = disturbance
    for _ in range(substeps):
        k1 = [f + w for f, w in zip(derivative(x, control, functions), d, strict=True)]
        point = [a + half * k for a, k in zip(x, k1, strict=True)]
        k2 = [f + w for f, w in zip(derivative(point, control, functions), d, strict=True)]
        point = [a + half * k for a, k in zip(x, k2, strict=True)]
        k3 = [f + w for f, w in zip(derivative(point, control, functions), d, strict=True)]
        point = [a + h * k for a, k in zip(x, k3, strict=True)]
        k4 = [f + w for f, w in zip(derivative(point, control, functions), d, strict=True)]
        x = [
            a + sixth * (p + 2.0 * (q + r) + s)
            for a, p, q, r, s in zip(x, k1, k2, k3, k4, strict=True)
        ]
    return x


def hold_step(
    system: System,
    state: FloatArray,
    control: FloatArray,
    duration: float,
    disturbance: FloatArray | None = None,
    substeps: int = SUBSTEPS,
) -> FloatArray:
    """Advance a batch of states by one control step.

    Args:
        system: The system.
        state: x, shape (..., n).
        control: u, shape (..., m).
        duration: Control step [s].
        disturbance: d, shape (..., n), or None for zero.
        substeps: Runge-Kutta steps in the control step.

    Returns:
        The states at the end of the step, shape (..., n).
    """
    pushes: Components = (
        [0.0] * system.state_dim if disturbance is None else components(disturbance)
    )
    parts = rk4_hold(system, components(state), components(control), pushes, duration, np, substeps)
    return np.stack(parts, axis=-1)


def hold_control_slope(
    system: System, state: FloatArray, control: FloatArray, duration: float
) -> tuple[FloatArray, FloatArray]:
    """Advance states by one control step and differentiate by a single control, exactly.

    A single state is integrated in plain floats, five times faster than as arrays of length one.

    Args:
        system: A system with one control.
        state: x, shape (..., n).
        control: u, shape (..., 1), of the same batch shape.
        duration: Control step [s].

    Returns:
        The next states F(x, u) and dF/du, both of shape (..., n).
    """
    start: Components = state.tolist() if state.ndim == 1 else components(state)
    force = float(control[0]) if state.ndim == 1 else control[..., 0]
    one = 1.0 if state.ndim == 1 else np.ones_like(force)
    push = [dual.Dual(force, one)]
    parts = rk4_hold(system, start, push, [0.0] * system.state_dim, duration, functions)
    # The held force reaches every rate in the first substep, so that all parts are duals.
    following = np.stack([part.value for part in parts], axis=-1)
    return following, np.stack([part.gradient for part in parts], axis=-1)


def linearise_hold(
    system: System,
    state: FloatArray,
    control: FloatArray,
    duration: float,
    substeps: int = SUBSTEPS,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Advance a batch of states by one control step and differentiate the map exactly.

    Args:
        system: The system.
        state: x, shape (..., n).
        control: u, shape (..., m), of the same batch shape.
        duration: Control step [s].
        substeps: Runge-Kutta steps in the control step.

    Returns:
        The next states F(x, u), shape (..., n); dF/dx, shape (..., n, n); dF/du, shape (..., n, m).
    """
    n, m = system.state_dim, system.control_dim
    seeds = dual.seed(components(state) + components(control))
    parts = rk4_hold(system, seeds[:n], seeds[n:], [0.0] * n, duration, dual, substeps)
    following = np.stack([part.value for part in parts], axis=-1)
    slopes = dual.gradients(list(parts), n + m, state.shape[:-1])
    return following, slopes[..., :n], slopes[..., n:]
