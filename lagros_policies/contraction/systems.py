"""Which systems the functions of this package are for: everything else is refused by name.

They take any control-affine `System`, with a metric of x only if the control does not move it
(`check_unmoved`); one of x_d serves the others.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import System
from lagros_policies.contraction.basis import Basis
from lagros_policies.contraction.metric import DualMetric, Metric

# Rounding of what should be zero, as a share of the metric times the reach of the control.
_ROUNDING = 1e-9


def check_polynomial(metric: Any, what: str) -> None:
    """Refuse what is no `Metric`: of a network, say, nothing is proved.

    Args:
        metric: The metric.
        what: Who uses its coefficients, as the message names it.

    Raises:
        TypeError: It is another.
    """
    if not isinstance(metric, Metric):
        raise TypeError(f"metric={metric!r} must be a Metric: {what} uses its coefficients")


def check_sizes(system: System, **arrays: tuple[FloatArray, tuple[int, ...]]) -> None:
    """Check the last axes of arrays against what a system has.

    Args:
        system: The system, which the message names.
        arrays: By name, an array and what the ends of its shape must be.

    Raises:
        ValueError: An array has other ends.
    """
    for name, (array, ends) in arrays.items():
        if np.shape(array)[-len(ends) :] != ends:
            wanted = ", ".join(("...", *map(str, ends)))
            raise ValueError(
                f"{name} of shape {np.shape(array)} must be ({wanted}) for {system!r} with "
                f"{system.state_dim} states and {system.control_dim} controls"
            )


def check_unmoved(system: System, metric: DualMetric, state: FloatArray, gain: FloatArray) -> None:
    """Check, at given states, that no control moves a metric, whose rate would not be known.

    Args:
        system: The system.
        metric: The metric; one of x_d passes, since the control of the plan is known.
        state: x, shape (..., n).
        gain: B(x), shape (..., n, m).

    Raises:
        ValueError: A control moves W_bar.
    """
    places = getattr(metric, "coordinates", None)
    known = places is not None and not np.any(gain[..., list(places), :])
    if known or getattr(metric, "point", "state") == "nominal":
        return
    size = np.abs(metric.dual(state)).max(initial=0.0)
    _check_still(system, lambda column: metric.dual_rate(state, column), size, state, gain)


def check_basis_unmoved(system: System, phi: Basis, state: FloatArray, gain: FloatArray) -> None:
    """Check, at given states (s, n), that no control moves the functions phi_i of a basis.

    Raises:
        ValueError: One does.
    """
    size = np.abs(phi.at(state)).max(initial=0.0)
    _check_still(system, lambda column: phi.rate(state, column), size, state, gain)


def _check_still(
    system: System,
    rate: Callable[[FloatArray], FloatArray],
    size: float,
    state: FloatArray,
    gain: FloatArray,
) -> None:
    for control in range(gain.shape[-1]):
        moved = np.abs(rate(gain[..., control])).reshape(*np.shape(state)[:-1], -1).max(axis=-1)
        if np.any(moved > _ROUNDING * size * np.abs(gain).max(initial=0.0)):
            worst = np.unravel_index(int(np.argmax(moved)), moved.shape)
            raise ValueError(
                f"control {control} of {system!r} moves a metric of the state at "
                f"x={state[worst].tolist()}, so that dW_bar/dt depends on a control that is not "
                'chosen yet: take a basis of other coordinates, or one of x_d (point="nominal")'
            )
