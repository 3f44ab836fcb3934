"""Tubes around a target trajectory: Theorem 1, Lemma 1 and the tightening of Theorem 3."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_above, check_at_least, check_not_negative, check_positive
from lagros_policies.contraction.metric import ContractionMetric, extreme_eigenvalues


@dataclass(frozen=True, slots=True)
class Tube:
    """The contraction tube r(t) of Theorem 1, equation (7).

    r(t) = R(0) sqrt(omega_bar) exp(-alpha t)
           + (b_bar eps + d_bar) / alpha * sqrt(chi) * (1 - exp(-alpha t))

    Attributes:
        contraction_rate: alpha [1/s].
        condition: chi = omega_bar / omega_underbar, the condition number of M over the region.
        disturbance_bound: d_bar, in units of the state per second.
        learning_error: eps_l, bound of ||u - u*|| in units of the control.
        control_gain: b_bar, bound of ||B(x)||.
        initial_radius: R(0) sqrt(omega_bar), the radius at t = 0.

    Raises:
        ValueError: A rate or condition is not positive, or a bound is negative.
    """

    contraction_rate: float
    condition: float
    disturbance_bound: float
    learning_error: float = 0.0
    control_gain: float = 0.0
    initial_radius: float = 0.0

    def __post_init__(self) -> None:
        check_positive("contraction_rate", self.contraction_rate)
        check_positive("condition", self.condition)
        check_at_least("condition", self.condition, 1)
        for name in ("disturbance_bound", "learning_error", "control_gain", "initial_radius"):
            check_not_negative(name, getattr(self, name))

    @property
    def steady_radius(self) -> float:
        """The radius that the tube tends to."""
        push = self.control_gain * self.learning_error + self.disturbance_bound
        return push / self.contraction_rate * math.sqrt(self.condition)

    def radius(self, time: Any) -> Any:
        """Return r(t) for times [s], a float or an array."""
        decay = np.exp(-self.contraction_rate * np.asarray(time, dtype=np.float64))
        value = self.initial_radius * decay + self.steady_radius * (1.0 - decay)
        return float(value) if np.ndim(time) == 0 else value


def certified_tube(
    metric: ContractionMetric,
    disturbance_bound: float,
    learning_error: float = 0.0,
    control_gain: float = 0.0,
) -> Tube:
    """Return the tube of Theorem 1 from a metric's own alpha and condition number.

    It bounds the continuous-time loop while the state stays in the metric's region and the
    disturbance does not move M; the metric's condition was checked on samples, so the bound is
    observed, not proved. Where the disturbance moves what M depends on, the theorem
    leaves out a term: what follows then has `theorems.disturbed_rate` in alpha's place, and nothing
    follows where that is not positive.

    Args:
        metric: The contraction metric.
        disturbance_bound: d_bar, in units of the state per second.
        learning_error: eps_l, in units of the control.
        control_gain: b_bar.

    Returns:
        The tube in the Euclidean norm of the state.
    """
    least, largest = extreme_eigenvalues(metric)
    return Tube(
        metric.contraction_rate, largest / least, disturbance_bound, learning_error, control_gain
    )


def diverging_bound(
    time: FloatArray,
    lipschitz: float,
    disturbance_bound: float,
    learning_error: float = 0.0,
    control_gain: float = 0.0,
    initial_error: float = 0.0,
) -> FloatArray:
    """Return the bound of Lemma 1 for a learned u_d, equation (12), which grows exponentially.

    Args:
        time: t [s], any shape.
        lipschitz: L_f of the closed loop [1/s].
        disturbance_bound: d_bar, in units of the state per second.
        learning_error: eps_l.
        control_gain: b_bar.
        initial_error: ||e(0)||.

    Returns:
        The bound of ||e(t)||, of the shape of `time`.

    Raises:
        ValueError: The Lipschitz constant is not positive, or a bound negative or not finite.
    """
    check_above("lipschitz", lipschitz, 0)
    for name, value in {
        "disturbance_bound": disturbance_bound,
        "learning_error": learning_error,
        "control_gain": control_gain,
        "initial_error": initial_error,
    }.items():
        check_not_negative(name, value)
    push = control_gain * learning_error + disturbance_bound
    growth = np.expm1(lipschitz * time)
    bound: FloatArray = initial_error * (growth + 1.0) + push / lipschitz * growth
    return bound


def tighten(low: FloatArray, high: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shrink an interval by the tube, the admissible set of Theorem 3.

    Args:
        low: Lower bounds of the state, any shape.
        high: Upper bounds, likewise.
        radius: Tube radius, broadcast against them.

    Raises:
        ValueError: The tube is wider than the interval, or its radius negative or no number.
    """
    tight_low, tight_high = low + radius, high - radius
    if not np.all(tight_low <= tight_high) or np.any(radius < 0.0):
        widest = float(np.max(radius))
        raise ValueError(
            f"the tube (radius up to {widest:.3g}) is wider than the admissible interval: "
            "lower the disturbance bound or use a tighter tube"
        )
    return tight_low, tight_high
