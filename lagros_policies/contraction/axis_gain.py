"""A constant gain for double integrators under a held control, and the metric that it contracts.

From instant to instant the error e = (position, velocity) of an axis obeys e' = (F + g K) e + w.
The gain of rate alpha places both poles at exp(-alpha h (1 +- 3i/4)), a damping ratio of 4/5: of
all gains with the same worst position error it needs, within a few percent, the least effort under
uniform disturbance. With T the matrix that turns F + g K into a rotation, W = T T' is the metric of
that gain,

    (F + g K) W (F + g K)' = exp(-2 alpha h) W,

so that u_d + K e lies in the contracting set of W for every e, and the projection onto it is the
identity: the gain that belongs to the metric flies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields, check_positive
from lagros_policies.contraction.double_integrator import AxisMetric, flow

# Imaginary over real part of the poles: a damping ratio of 4/5.
_SWING = 0.75


@dataclass(frozen=True, slots=True)
class AxisGain:
    """v = -stiffness * position error - damping * velocity error, held for a period.

    Attributes:
        stiffness: k_p [1/s^2].
        damping: k_v [1/s].
        period: h [s].

    Raises:
        ValueError: A value is not positive and finite, or errors do not die out under the gain.
    """

    stiffness: float
    damping: float
    period: float = 0.1

    def __post_init__(self) -> None:
        check_fields(self, positive=("stiffness", "damping", "period"))
        if not self.rate > 0.0:
            raise ValueError(
                f"stiffness={self.stiffness!r} and damping={self.damping!r} held for "
                f"{self.period!r} s let errors grow: use smaller ones"
            )

    @classmethod
    def of_rate(cls, rate: float, period: float = 0.1) -> AxisGain:
        """Return the gain of a contraction rate.

        Args:
            rate: alpha [1/s].
            period: h [s].

        Raises:
            ValueError: A value is not positive and finite.
        """
        check_positive("rate", rate)
        check_positive("period", period)
        size = math.exp(-rate * period)
        # F + g K has the trace 2 - k_p h^2 / 2 - k_v h and the determinant 1 + k_p h^2 / 2 - k_v h.
        trace = 2.0 * size * math.cos(_SWING * rate * period)
        damping = (3.0 - trace - size * size) / (2.0 * period)
        stiffness = (1.0 - trace + size * size) / period**2
        return cls(stiffness, damping, period)

    @classmethod
    def regulator(
        cls, error: float, speed_error: float, acceleration: float, period: float = 0.1
    ) -> AxisGain:
        """Return the gain of a linear quadratic regulator, without any metric.

        Along a plan of a double integrator the Riccati recursion has one and the same gain at every
        instant but the last few.

        Args:
            error: What the weights take for a large position error, Q_11 = 1 / error^2.
            speed_error: Likewise of the velocity.
            acceleration: Likewise of the control, R = 1 / acceleration^2.
            period: h [s].

        Raises:
            ValueError: A value is not positive and finite.
        """
        from scipy.linalg import solve_discrete_are

        weights = {"error": error, "speed_error": speed_error, "acceleration": acceleration}
        for name, value in {**weights, "period": period}.items():
            check_positive(name, value)
        step, push = flow(period), np.array([[0.5 * period**2], [period]])
        state, control = np.diag([error**-2, speed_error**-2]), np.array([[acceleration**-2]])
        value = solve_discrete_are(step, push, state, control)
        gain = np.linalg.solve(control + push.T @ value @ push, push.T @ value @ step)[0]
        return cls(float(gain[0]), float(gain[1]), period)

    @property
    def gain(self) -> FloatArray:
        """K, shape (2,) [1/s^2, 1/s]."""
        return np.array([-self.stiffness, -self.damping])

    @property
    def step(self) -> FloatArray:
        """F + g K, shape (2, 2)."""
        h = self.period
        return flow(h) + np.outer([0.5 * h * h, h], self.gain)

    @property
    def rate(self) -> float:
        """The rate alpha at which errors die out, of the slowest pole [1/s]."""
        return float(-np.log(np.max(np.abs(np.linalg.eigvals(self.step)))) / self.period)

    @property
    def dual(self) -> FloatArray:
        """W with (F + g K) W (F + g K)' <= exp(-2 alpha h) W and W_11 = 1, shape (2, 2)."""
        _, vectors = np.linalg.eig(self.step)
        dual = np.real(vectors @ np.conj(vectors.T))
        value: FloatArray = dual / dual[0, 0]
        return value

    @property
    def metric(self) -> AxisMetric:
        """The metric of the gain's rate whose stiffness is that of W.

        For a gain of `of_rate` it is W itself: both meet Theorem 2's condition with equality.
        """
        return AxisMetric(self.rate, float(self.dual[1, 1]), self.period)

    @property
    def state_condition(self) -> float:
        """Return chi = lambda_max(W) / lambda_min(W)."""
        least, largest = np.linalg.eigvalsh(self.dual)
        return float(largest / least)

    def deviation(self, error: FloatArray, speed_error: FloatArray) -> FloatArray:
        """Return v = K e.

        Args:
            error: Position errors, shape (..., a) [m] or [rad].
            speed_error: Velocity errors, shape (..., a), per second.
        """
        value: FloatArray = -self.stiffness * error - self.damping * speed_error
        return value
