"""The certificate of double integrators: one constant metric per axis, exact for all states.

Where B B' is the same diagonal at every state and reaches all velocities, as of a body that floats
with thrusters on all sides, each axis is a double integrator de = A e + g a in its error e =
(position, velocity), whatever the state. Theorem 2 asks for a constant W = [[1, q], [q, s]] (up to
scale) with, for some nu,

    A W + W A' - 2 nu g g' <= -2 alpha W     <=>  q <= -alpha                    (control at will)
    F W F' - nu g g' <= exp(-2 alpha h) W    <=>  q <= -(1 + h^2 s / 4) tanh(alpha h) / h    (held)

by Finsler's lemma, on the one direction that g does not reach. So q is as large as allowed and s,
the stiffness, is the one free number. It trades three things:

    whole state:  chi = lambda_max(W) / lambda_min(W), least at s = 1 + 2 alpha^2 for h = 0, where
                  sqrt(chi) = alpha + sqrt(1 + alpha^2) (an infimum: nu grows without bound);
    position:     lambda_max(M) lambda_max(C W C') = 1 / lambda_min(W), which falls to 1 with s;
    effort:       a stiffer metric answers the same error with a larger control.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_disturbance_bound, check_not_negative, check_positive
from lagros_policies.contraction.tube import Tube

# Panels of the integral over a hold; its excess is below 1e-8 of it.
_PANELS = 2000
# Above the rounding of a bound, and the share of the rate that its proof gives up, relative.
_ROUNDING = 1e-8
# Fitted to simulations that tests/policies/test_double_integrator.py repeats: 95 % of agents stay
# within this position error for 30 s of uniform-in-ball disturbance of bound 1, redrawn every
# 0.1 s, at alpha = 1 with the metric of least chi; and the power of 1/alpha.
_EXPECTED_ERROR = 0.378
_EXPECTED_POWER = 0.41
LEAST_MARGIN = 0.05  # of a plan, for what is not disturbance [m]


@dataclass(frozen=True, slots=True)
class AxisMetric:
    """W = [[1, q], [q, s]], M = W^-1, for the error (position, velocity) of one axis.

    Attributes:
        rate: alpha [1/s].
        stiffness: s [1/s^2].
        period: Time for which a control is held [s]; 0 for a control at will.

    Raises:
        ValueError: A value is out of range, or W would not be positive definite.
    """

    rate: float
    stiffness: float
    period: float = 0.1

    def __post_init__(self) -> None:
        check_positive("rate", self.rate)
        check_not_negative("period", self.period)
        check_positive("stiffness", self.stiffness)
        # A product that is too large is infinite; a power would raise.
        if not self.stiffness > self.coupling * self.coupling:
            raise ValueError(
                f"stiffness={self.stiffness!r} gives no positive definite W at rate={self.rate!r} "
                f"and period={self.period!r}: see stiffness_range"
            )

    @property
    def coupling(self) -> float:
        """Return q [1/s], as near to zero as the rate allows."""
        return _coupling(self.rate, self.stiffness, self.period)

    @property
    def dual(self) -> FloatArray:
        """W, shape (2, 2)."""
        return np.array([[1.0, self.coupling], [self.coupling, self.stiffness]])

    @property
    def matrix(self) -> FloatArray:
        """M = W^-1, shape (2, 2)."""
        determinant = self.stiffness - self.coupling**2
        return np.array([[self.stiffness, -self.coupling], [-self.coupling, 1.0]]) / determinant

    @property
    def state_condition(self) -> float:
        """Return chi = lambda_max(W) / lambda_min(W), of the whole-state tube."""
        least, largest = np.linalg.eigvalsh(self.dual)
        return float(largest / least)

    @property
    def position_condition(self) -> float:
        """Return lambda_max(M) lambda_max(C W C') with C = [1, 0], of the position's tube."""
        return float(1.0 / np.linalg.eigvalsh(self.dual)[0])


def stiffness_range(rate: float, period: float) -> tuple[float, float]:
    """Return between which stiffnesses W is positive definite [1/s^2].

    Args:
        rate: alpha [1/s].
        period: Hold [s]; 0 for a control at will.
    """
    slope = -_coupling(rate, 0.0, period)
    if period == 0.0:
        return slope**2, math.inf
    # s > k^2 (1 + h^2 s / 4)^2 with k = tanh(alpha h) / h: between the roots of a quadratic.
    share = 0.5 * (period * slope) ** 2
    root = math.sqrt(1.0 - (period * slope) ** 2)
    high = (1.0 - share + root) * 8.0 / (period**4 * slope**2)
    low = 16.0 / period**4 / high
    return low, high


def design_axis(
    rate: float,
    period: float = 0.1,
    objective: Literal["state", "position"] = "state",
    stiffness_limit: float = math.inf,
) -> AxisMetric:
    """Return the metric with the least tube (Theorem 2, per axis).

    Args:
        rate: alpha [1/s].
        period: Hold [s]; 0 for a control at will.
        objective: What the tube should bound: the whole state, or the position alone.
        stiffness_limit: Largest s [1/s^2]. The position's tube asks for a stiff metric, which pays
            in effort; without a hold it asks for an infinite one.

    Raises:
        ValueError: No stiffness below the limit is admissible, or none is best.
    """
    from scipy.optimize import minimize_scalar

    check_positive("rate", rate)
    if objective == "state" and period == 0.0 and 1.0 + 2.0 * rate**2 <= stiffness_limit:
        return AxisMetric(rate, 1.0 + 2.0 * rate**2, period)
    low, high = stiffness_range(rate, period)
    high = min(high, stiffness_limit)
    if not low < high < math.inf:
        raise ValueError(
            f"rate={rate!r}, period={period!r}: the stiffness must lie above {low:.4g} and below "
            f"{high:.4g}; give a finite stiffness_limit above that"
        )

    def tube(logarithm: float) -> float:
        metric = AxisMetric(rate, math.exp(logarithm), period)
        return metric.state_condition if objective == "state" else metric.position_condition

    # Both conditions have one minimum: they are quasi-convex in W, which is affine in s.
    inside = 1e-9 * (math.log(high) - math.log(low))
    answer = minimize_scalar(
        tube,
        bounds=(math.log(low) + inside, math.log(high) - inside),
        method="bounded",
        options={"xatol": 1e-10},
    )
    return AxisMetric(rate, math.exp(float(answer.x)), period)


def state_tube(metric: AxisMetric, disturbance_bound: float) -> Tube:
    """Return the tube of Theorem 1 around the whole state, for a control at will."""
    return Tube(metric.rate, metric.state_condition, disturbance_bound)


def position_tube(metric: AxisMetric, disturbance_bound: float) -> Tube:
    """Return the tube of Theorem 1 around the position, for a control at will.

    ||C e|| <= sqrt(lambda_max(C W C')) ||e||_M and ||e||_M <= sqrt(lambda_max(M)) d_bar / alpha.
    The axes share one metric, so this holds for the plane: the norm of the errors of x and y, with
    d_bar bounding the disturbance of position and velocity together.
    """
    return Tube(metric.rate, metric.position_condition, disturbance_bound)


def certified_margin(metric: AxisMetric, disturbance_bound: float) -> float:
    """Return a bound of the position error under a held control, at and between its instants [m].

    From instant to instant ||e||_M shrinks by rho = exp(-alpha h) and gains at most
    d_bar int_0^h sqrt(lambda_max(F(s)' M F(s))) ds. Between instants the position differs from the
    straight line between its ends by h^2/8 of the control's deviation, which is at most
    ||F||_M ||e||_M / ||g||_M, and by (h/2 + h^2/8) d_bar.

    The integrand is the norm of a matrix that is affine in s, so convex: the trapezoidal rule is a
    bound from above. The wrench is held in the body's axes; that they turn within a step is left
    out.

    Args:
        metric: A metric with a period.
        disturbance_bound: d_bar, of position and velocity of the plane together.

    Raises:
        ValueError: The metric has no period.
    """
    check_not_negative("disturbance_bound", disturbance_bound)
    h = metric.period
    if h == 0.0:
        raise ValueError("a held control needs a metric with a period; see position_tube")
    matrix = metric.matrix
    flows = np.tile(np.eye(2), (_PANELS + 1, 1, 1))
    flows[:, 0, 1] = np.linspace(0.0, h, _PANELS + 1)
    sizes = np.sqrt(np.linalg.eigvalsh(flows.transpose(0, 2, 1) @ matrix @ flows)[:, -1])
    gained = float(np.trapezoid(sizes, dx=h / _PANELS)) * (1.0 + _ROUNDING)
    error = disturbance_bound * gained / -math.expm1(-metric.rate * h)
    # ||F||_M by the eigenvalues of W F' M F.
    step = flow(h)
    growth = math.sqrt(float(np.max(np.linalg.eigvals(metric.dual @ step.T @ matrix @ step).real)))
    push = np.array([0.5 * h**2, h])
    deviation = growth / math.sqrt(float(push @ matrix @ push))
    between = h**2 / 8.0 * deviation * error + (h / 2.0 + h**2 / 8.0) * disturbance_bound
    return (error + between) * (1.0 + _ROUNDING)


def expected_margin(disturbance_bound: float, rate: float) -> float:
    """Return the margin f(d_bar, alpha) that suffices in simulation, not a bound [m].

    95 % of agents keep their position error below it for 30 s of uniform-in-ball disturbance, with
    the metric of least chi: a power law through what was measured for alpha from 0.3 to 3, within
    3 %. It is proportional to d_bar because u* scales with the error.

    Args:
        disturbance_bound: d_bar of the six states together.
        rate: alpha of u* [1/s].
    """
    check_not_negative("disturbance_bound", disturbance_bound)
    check_positive("rate", rate)
    return float(_EXPECTED_ERROR * disturbance_bound * rate**-_EXPECTED_POWER)


def planned_margin(margin: float | None, disturbance_bound: float, rate: float) -> float:
    """Return the margin that a planner asks for: the given one, or the expected one [m].

    Args:
        margin: Given by the user, or None.
        disturbance_bound: d_bar that the plan is to withstand.
        rate: alpha of u* [1/s].

    Raises:
        ValueError: A value is negative or not finite.
    """
    check_disturbance_bound("disturbance_bound", disturbance_bound)
    if margin is None:
        return max(LEAST_MARGIN, expected_margin(disturbance_bound, rate))
    check_not_negative("margin", margin, "or None")
    return margin


def flow(time: float) -> FloatArray:
    """Return F(t) = exp(A t) of the double integrator, shape (2, 2)."""
    return np.array([[1.0, time], [0.0, 1.0]])


def _coupling(rate: float, stiffness: float, period: float) -> float:
    if period == 0.0:
        return -rate
    return -(1.0 + 0.25 * period**2 * stiffness) * math.tanh(rate * period) / period
