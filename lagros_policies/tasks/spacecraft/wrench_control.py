"""u* of the spacecraft: the least wrench that makes the error contract under a hold.

With e = (position, velocity) per axis and a constant metric, the condition from one control instant
to the next, V(F e + g v) <= exp(-2 alpha h) V(e) summed over x and y, is a ball of accelerations v
(deviations from the nominal one). Its point nearest to the preferred deviation, zero unless said
otherwise, is Theorem 2's least-norm control for a held control, in closed form. The heading is an
axis of its own, with its own rate: the plan never turns the body, and nothing in the position's
certificate asks for a heading.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_positive
from lagros_envs.tasks.spacecraft.physics import Spacecraft, check_spacecraft
from lagros_policies.contraction.double_integrator import (
    AxisMetric,
    certified_margin,
    design_axis,
    flow,
)
from lagros_policies.tasks.spacecraft.thrusters import held_thrust

# Position and velocity errors (..., a) to the deviation (..., a) from the nominal acceleration.
Law = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class HeldBall:
    """The accelerations under which a few axes with one metric contract together.

    Attributes:
        metric: The metric of each axis, with the hold's period.

    Raises:
        ValueError: The metric has no period.
    """

    metric: AxisMetric

    def __post_init__(self) -> None:
        if self.metric.period == 0.0:
            raise ValueError("a held control needs a metric with a period")

    def ball(self, error: FloatArray, speed_error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return centre (..., a) and radius (...) of the ball of contracting deviations.

        Args:
            error: Position errors, shape (..., a).
            speed_error: Velocity errors, shape (..., a).
        """
        metric = self.metric
        h = metric.period
        matrix = metric.matrix
        push = np.array([0.5 * h * h, h])
        pull = push @ matrix
        a = float(pull @ push)
        step = flow(h)
        b = (pull @ step)[0] * error + (pull @ step)[1] * speed_error
        excess = step.T @ matrix @ step - np.exp(-2.0 * metric.rate * h) * matrix
        c = np.sum(
            excess[0, 0] * error**2
            + 2.0 * excess[0, 1] * error * speed_error
            + excess[1, 1] * speed_error**2,
            axis=-1,
        )
        # b b' - a c >= 0 by the metric's own condition; below zero it is rounding.
        squared = np.maximum(np.sum(b * b, axis=-1) - a * c, 0.0)
        return -b / a, np.sqrt(squared) / a

    def __call__(
        self, error: FloatArray, speed_error: FloatArray, preferred: FloatArray | float = 0.0
    ) -> FloatArray:
        """Return the contracting deviation (..., a) nearest to the preferred one.

        Args:
            error: Position errors, shape (..., a) [m] or [rad].
            speed_error: Velocity errors, shape (..., a), per second.
            preferred: Deviation taken where it contracts, shape (..., a), per second squared.
        """
        centre, radius = self.ball(error, speed_error)
        away = preferred - centre
        distance = np.linalg.norm(away, axis=-1)
        share = np.minimum(1.0, radius / np.where(distance > 0.0, distance, 1.0))
        deviation: FloatArray = centre + share[..., None] * away
        return deviation


@dataclass(frozen=True)
class AxesTracking:
    """A law of each axis' error and the thrusters that make it, for any number of agents at once.

    Attributes:
        body: The spacecraft.
        plane: What the law of x and y is made of, with the `period` of its hold.
        turning: Likewise of the heading, of the same period.

    Raises:
        TypeError: The body is no spacecraft.
        ValueError: The periods differ, or are zero.
    """

    body: Spacecraft
    plane: Any
    turning: Any

    def __post_init__(self) -> None:
        check_spacecraft(self.body, type(self).__name__)
        if self.plane.period != self.turning.period or self.plane.period == 0.0:
            raise ValueError(
                f"plane and turning need one period > 0, not {self.plane.period!r} and "
                f"{self.turning.period!r}"
            )

    @property
    def laws(self) -> tuple[Law, Law]:
        """The laws of the plane and of the heading."""
        raise NotImplementedError

    def margin(self, disturbance_bound: float) -> float:
        """Return what the position error never exceeds after e(0) = 0 (proved) [m]."""
        raise NotImplementedError

    def acceleration(
        self, state: FloatArray, nominal: FloatArray, nominal_acceleration: FloatArray
    ) -> FloatArray:
        """Return the acceleration of the law, shape (..., 3) [m/s^2, m/s^2, rad/s^2].

        Args:
            state: x, shape (..., 6).
            nominal: x_d, shape (..., 6).
            nominal_acceleration: Of x, y and heading under u_d, shape (..., 3).
        """
        error = state - nominal
        plane, turning = self.laws
        straight = plane(error[..., :2], error[..., 3:5])
        turn = turning(error[..., 2:3], error[..., 5:])
        value: FloatArray = nominal_acceleration + np.concatenate([straight, turn], axis=-1)
        return value

    def control(
        self, state: FloatArray, nominal: FloatArray, nominal_acceleration: FloatArray
    ) -> FloatArray:
        """Return the thrust, shape (..., 8), all >= 0 [N]; arguments as of `acceleration`."""
        wanted = self.acceleration(state, nominal, nominal_acceleration)
        return held_thrust(self.body, state, wanted, self.plane.period)


@dataclass(frozen=True)
class WrenchTracking(AxesTracking):
    """u* in the metrics of the plane and of the heading."""

    plane: AxisMetric
    turning: AxisMetric

    @property
    def laws(self) -> tuple[Law, Law]:
        """The laws of the plane and of the heading."""
        return HeldBall(self.plane), HeldBall(self.turning)

    def margin(self, disturbance_bound: float) -> float:
        """Return what the position error never exceeds; see `certified_margin`."""
        return certified_margin(self.plane, disturbance_bound)

    @classmethod
    def for_rates(
        cls, body: Spacecraft, period: float, contraction_rate: float, turning_rate: float
    ) -> WrenchTracking:
        """Return the law with the metrics of least chi for two rates.

        Args:
            body: The spacecraft.
            period: The hold's [s].
            contraction_rate: alpha in the plane [1/s].
            turning_rate: alpha of the heading [1/s].

        Raises:
            ValueError: A rate is not positive and finite.
        """
        rates = {"contraction_rate": contraction_rate, "turning_rate": turning_rate}
        for name, rate in rates.items():
            check_positive(name, rate)
        return cls(body, design_axis(contraction_rate, period), design_axis(turning_rate, period))
