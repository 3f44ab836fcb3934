"""A known Lyapunov function in place of a designed metric: tracking of a Lagrangian system.

For H(q) q'' + C(q, q') q' + G(q) = tau the remark after Theorem 2 names the sliding variable

    s = q' - q_r',   q_r' = q_d' - lambda (q - q_d),   tau = H q_r'' + C q_r' + G - k H s

(Slotine and Li 1991, page 392). The virtual system H y' + C y + k H (y - q_r') + ... contracts in
the metric H, because H' - 2C is skew; then q~ = q - q_d follows q~' = -lambda q~ + s. Two systems
in a row, each contracting: no metric to design, no program to solve.

A body that floats has C = G = 0 and a constant H, so that each axis is a double integrator in its
error. Here the law is made for a control that is held for h: the deviation v is the one for which

    s[k + 1] = rho_s s[k],                   rho_s = exp(-k h)
    q~[k + 1] = rho_q q~[k] + beta s[k],     rho_q = (2 - lambda h) / (2 + lambda h),
                                             beta = h (1 + rho_s) / (2 + lambda h)

hold exactly. As h goes to zero it is the law above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_not_negative, check_positive, check_whole

moved_names(__name__)

# What is left of an impulse response after this many steps of the slower mode is nothing.
_TAIL = 1e-12
# Above the rounding of a bound, relative.
_ROUNDING = 1e-8


@dataclass(frozen=True, slots=True)
class SlidingAxis:
    """The held sliding-variable law of one axis, or of several axes with the same rates.

    Attributes:
        position_rate: lambda, at which the position error follows [1/s].
        sliding_rate: k, at which the sliding variable contracts [1/s].
        period: Time h for which a control is held [s].

    Raises:
        ValueError: A value is not positive and finite, or lambda h >= 2, where the position error
            would change its sign at every step.
    """

    position_rate: float = 2.0
    sliding_rate: float = 2.0
    period: float = 0.1

    def __post_init__(self) -> None:
        for item in fields(self):
            check_positive(item.name, getattr(self, item.name))
        if self.position_rate * self.period >= 2.0:
            raise ValueError(
                f"position_rate={self.position_rate!r} times period={self.period!r} must be "
                "below 2: lower the rate or hold for less"
            )

    @property
    def sliding_factor(self) -> float:
        """Return rho_s, by which s shrinks in one step."""
        return math.exp(-self.sliding_rate * self.period)

    @property
    def position_factor(self) -> float:
        """Return rho_q, by which the position error shrinks in one step where s is zero."""
        ahead = self.position_rate * self.period
        return (2.0 - ahead) / (2.0 + ahead)

    @property
    def coupling(self) -> float:
        """Return beta, the position error that one unit of s brings in one step [s]."""
        ahead = 2.0 + self.position_rate * self.period
        return self.period * (1.0 + self.sliding_factor) / ahead

    @property
    def gains(self) -> tuple[float, float]:
        """Return (g_s, g_q) of v = -g_s s + g_q q~ [1/s, 1/s^2]."""
        ahead = self.position_rate * self.period
        share = 1.0 + 0.5 * ahead
        by_sliding = (1.0 - self.sliding_factor + ahead) / (self.period * share)
        return by_sliding, self.position_rate**2 / share

    def sliding(self, error: FloatArray, speed_error: FloatArray) -> FloatArray:
        """Return s = e' + lambda e, of the shape of the errors."""
        return speed_error + self.position_rate * error

    def deviation(self, error: FloatArray, speed_error: FloatArray) -> FloatArray:
        """Return v, the acceleration beyond the nominal one.

        Args:
            error: Position errors, any shape [m] or [rad].
            speed_error: Velocity errors, of the same shape, per second.

        Returns:
            v, of the same shape, per second squared.
        """
        by_sliding, by_error = self.gains
        value: FloatArray = by_error * error - by_sliding * self.sliding(error, speed_error)
        return value


@dataclass(frozen=True, slots=True)
class HierarchicalBound:
    """Bounds of the errors at the control instants 0 ... N (proved for the double integrator).

    Attributes:
        sliding: Of ||s||, shape (N + 1,).
        position: Of ||q~||, shape (N + 1,).
        velocity: Of ||q~'||, shape (N + 1,).
    """

    sliding: FloatArray
    position: FloatArray
    velocity: FloatArray

    @property
    def state(self) -> FloatArray:
        """Bound of the Euclidean norm of (q~, q~'), shape (N + 1,)."""
        return np.hypot(self.position, self.velocity)


def hierarchical_bound(
    axis: SlidingAxis,
    disturbance_bound: float,
    steps: int,
    initial_sliding: float = 0.0,
    initial_error: float = 0.0,
) -> HierarchicalBound:
    """Bound s first and, driven by that bound, the position error (hierarchical contraction).

    A disturbance (d_p, d_v) of position and velocity moves s by lambda d_p + (1 + lambda (h - t))
    d_v and q~ by d_p + (h - t) d_v within a hold. The norms of these are convex in t, so that the
    trapezoid of their ends bounds the integral for a disturbance that varies within the hold too.

    The wrench is held in the body's axes; that they turn within a step is left out.

    Args:
        axis: The law.
        disturbance_bound: d_bar, of position and velocity of the plane together.
        steps: N.
        initial_sliding: ||s|| at the start.
        initial_error: ||q~|| at the start.

    Raises:
        ValueError: A number is negative.
    """
    check_not_negative("disturbance_bound", disturbance_bound)
    check_not_negative("initial_sliding", initial_sliding)
    check_not_negative("initial_error", initial_error)
    check_whole("steps", steps, 0)
    sliding_push, position_push = _pushes(axis)
    rate = axis.position_rate
    sliding, position = np.empty(steps + 1), np.empty(steps + 1)
    sliding[0], position[0] = initial_sliding, initial_error
    for step in range(steps):
        sliding[step + 1] = axis.sliding_factor * sliding[step] + sliding_push * disturbance_bound
        position[step + 1] = (
            axis.position_factor * position[step]
            + axis.coupling * sliding[step]
            + position_push * disturbance_bound
        )
    above = 1.0 + _ROUNDING
    return HierarchicalBound(above * sliding, above * position, above * (sliding + rate * position))


def steady_position_bound(axis: SlidingAxis, disturbance_bound: float) -> float:
    """Return a bound of the position error at and between instants, from zero error, for ever [m].

    Between instants the position leaves the chord of its ends by at most h^2/8 of the deviation and
    (h/2 + h^2/8) d_bar, as in `double_integrator.certified_margin`.
    """
    check_not_negative("disturbance_bound", disturbance_bound)
    sliding_push, position_push = _pushes(axis)
    # What the bounds at the instants rise to, from zero: the fixed point of their recursion.
    sliding = sliding_push * disturbance_bound / -math.expm1(-axis.sliding_rate * axis.period)
    ahead = axis.position_rate * axis.period
    position = (axis.coupling * sliding + position_push * disturbance_bound) * (2.0 + ahead)
    position /= 2.0 * ahead  # 1 - rho_q = 2 lambda h / (2 + lambda h)
    between = _between(axis, sliding, position, disturbance_bound)
    return (position + between) * (1.0 + _ROUNDING)


def peak_position_error(axis: SlidingAxis, disturbance_bound: float) -> float:
    """Return the largest position error at the instants that a held disturbance can reach [m].

    The law is linear and the same in all directions, so that the worst sequence is known: each push
    (d_p, d_v), constant over its hold, points where its own effect on the last position is largest.
    The sum of these effects is exact, not only a bound; the hierarchical bound lies above it.
    """
    check_not_negative("disturbance_bound", disturbance_bound)
    h, rate = axis.period, axis.position_rate
    step = np.array([[axis.position_factor, axis.coupling], [0.0, axis.sliding_factor]])
    # Effects of unit d_p and d_v over one hold on (q~, s).
    effect = np.array([[h, 0.5 * h * h], [rate * h, h * (1.0 + 0.5 * rate * h)]])
    total = 0.0
    while True:
        reach = float(np.linalg.norm(effect[0]))
        total += reach
        # s feeds q~ later, so that both must have died out.
        if float(np.linalg.norm(effect)) < _TAIL * total:
            return total * disturbance_bound
        effect = step @ effect


def _pushes(axis: SlidingAxis) -> tuple[float, float]:
    """Return what one hold of a unit disturbance adds to ||s|| and to ||q~||, at most."""
    h, rate = axis.period, axis.position_rate
    sliding = 0.5 * h * (math.hypot(rate, 1.0) + math.hypot(rate, 1.0 + rate * h))
    return sliding, 0.5 * h * (1.0 + math.hypot(1.0, h))


def _between(axis: SlidingAxis, sliding: float, position: float, disturbance: float) -> float:
    by_sliding, by_error = axis.gains
    h = axis.period
    deviation = by_sliding * sliding + by_error * position
    return h * h / 8.0 * deviation + (0.5 * h + h * h / 8.0) * disturbance
