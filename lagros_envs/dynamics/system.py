"""What a control-affine system is, and everything that follows from its one equation.

A system states dx/dt = f(x) + B(x) u once, as a function of scalars over a namespace of elementary
functions. Here that function is evaluated on batches and differentiated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, cast

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import dual, functions

# One entry per coordinate: floats, arrays of a batch, or duals. The physics does not mind which.
Components = Sequence[Any]

# 16 Gauss-Legendre nodes give A e of a pole on a cart to 1e-11 for any two states with |theta| <=
# 1.5, |rates| <= 4 and |u| <= 60; 8 nodes err by 3e-5 there.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_SDC_NODES = 0.5 * (_NODES + 1.0)
_SDC_WEIGHTS = 0.5 * _WEIGHTS


class Functions(Protocol):
    """Elementary functions that an equation of motion may call.

    `lagros_envs.numbers.functions`, which every kind of number knows, or `math` or `numpy`.
    """

    def sin(self, x: Any, /) -> Any:
        """Return the sine."""

    def cos(self, x: Any, /) -> Any:
        """Return the cosine."""

    def tan(self, x: Any, /) -> Any:
        """Return the tangent."""

    def exp(self, x: Any, /) -> Any:
        """Return the exponential."""

    def sqrt(self, x: Any, /) -> Any:
        """Return the square root."""


class System(Protocol):
    """A control-affine system dx/dt = f(x) + B(x) u, equation (1) of the paper without d."""

    @property
    def state_dim(self) -> int:
        """Number n of states."""

    @property
    def control_dim(self) -> int:
        """Number m of controls."""

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt, one entry per state, from one entry per state and per control."""


def components(array: FloatArray) -> list[FloatArray]:
    """Split the last axis of a batch (..., n) into n arrays of shape (...)."""
    return [array[..., index] for index in range(array.shape[-1])]


def vector_field(system: System, state: FloatArray, control: FloatArray) -> FloatArray:
    """Evaluate f(x) + B(x) u on a batch.

    Args:
        system: The system.
        state: x, shape (..., n).
        control: u, shape (..., m); broadcast against the state.

    Returns:
        dx/dt, shape (..., n).
    """
    rates = system.derivative(components(state), components(control), np)
    shape = np.broadcast_shapes(state.shape[:-1], control.shape[:-1])
    return np.stack([np.broadcast_to(rate, shape) for rate in rates], axis=-1)


def jacobian(
    system: System, state: FloatArray, control: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Differentiate f(x) + B(x) u by the state and by the control, exactly.

    Args:
        system: The system.
        state: x, shape (..., n).
        control: u, shape (..., m); broadcast against the state.

    Returns:
        d(f + Bu)/dx, shape (..., n, n), and B(x), shape (..., n, m).
    """
    shape = np.broadcast_shapes(state.shape[:-1], control.shape[:-1])
    n, m = system.state_dim, system.control_dim
    arrays = [np.broadcast_to(part, shape) for part in components(state) + components(control)]
    seeds = dual.seed(arrays)
    rates = list(system.derivative(seeds[:n], seeds[n:], functions))
    full = dual.gradients(rates, n + m, shape)
    return full[..., :n], full[..., n:]


def control_matrix(system: System, state: FloatArray) -> FloatArray:
    """Return B(x), shape (..., n, m), for a batch of states (..., n)."""
    return jacobian(system, state, np.zeros(system.control_dim))[1]


def state_dependent_coefficient(
    system: System, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
) -> FloatArray:
    """Return the SDC matrix A(x, x_d, u_d), with A (x - x_d) = f(x) + B(x)u_d - f(x_d) - B(x_d)u_d.

    The mean of d(f + B u_d)/dx along the segment from x_d to x (Lemma 2 of the NSCM paper, used in
    the paper's virtual system), by Gauss-Legendre quadrature.

    Args:
        system: The system.
        state: x, shape (..., n).
        nominal: x_d, shape (..., n).
        nominal_control: u_d, shape (..., m).

    Returns:
        A, shape (..., n, n).
    """
    share = _SDC_NODES[:, None]
    points = share * state[..., None, :] + (1.0 - share) * nominal[..., None, :]
    slopes, _ = jacobian(system, points, nominal_control[..., None, :])
    return cast(FloatArray, np.einsum("q,...qij->...ij", _SDC_WEIGHTS, slopes))
