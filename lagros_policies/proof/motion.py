"""Enclosures of the cart-pole's Jacobian and of its metric as Taylor series in the angle.

The accelerations (of cart and pole) are, by Lagrange, affine in the force and in the cart's speed
and quadratic in the pole's rate. Force and speed enter as u - mu_c dp/dt alone, the push f:

    a(theta, f, w) = a_0(theta) + f a_f(theta) + w a_w(theta) + w^2 a_q(theta).

The four are read off the one equation of motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.numbers import Dual, Interval, Series, exact, functions, variable
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, POSITION, VELOCITY, CartPole
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.systems import check_cartpole, check_cartpole_metric
from lagros_policies.proof.matrices import matmul, transpose

FloatArray = NDArray[np.float64]
_STATES = 4
_RATES = slice(VELOCITY, ANGULAR_RATE + 1)
# A rate whose square is a power of two [rad/s].
_FAST = 1024.0


@dataclass(frozen=True)
class Accelerations:
    """The parts of the accelerations, each a series in the angle of shape (..., 2).

    Attributes:
        still: a_0.
        by_push: a_f; the lower half of B.
        by_rate: a_w.
        by_square: a_q.
    """

    still: Series
    by_push: Series
    by_rate: Series
    by_square: Series

    @property
    def balance(self) -> Series:
        """The push that holds the pole still at an angle, shape (...)."""
        return -(_indexed(self.still, (..., 1)) / _indexed(self.by_push, (..., 1)))


@dataclass(frozen=True)
class JacobianParts:
    """J = J_0 + f J_f + w J_w + w^2 J_q, the Jacobian of the motion by the state.

    Attributes:
        still: J_0, series of shape (..., 4, 4).
        by_push: J_f.
        by_rate: J_w.
        by_square: J_q.
        by_balance: b(theta) J_f with b the push that holds the pole still.
    """

    still: Series
    by_push: Series
    by_rate: Series
    by_square: Series
    by_balance: Series

    def at(
        self,
        order: int,
        push: Interval | FloatArray,
        balance: Interval | FloatArray,
        rate: Interval | FloatArray,
        square: Interval | FloatArray,
    ) -> Interval:
        """Enclose a derivative of J by the angle for f = push + balance b(theta).

        Args:
            order: Order of the derivative.
            push: Part of f that is the same at every angle; broadcasts, as all that follow.
            balance: Share of the push that holds the pole still.
            rate: w.
            square: w^2, a number of its own.

        Returns:
            The derivative, shape (..., 4, 4).
        """
        return (
            self.still.derivative(order)
            + self.by_push.derivative(order) * push
            + self.by_balance.derivative(order) * balance
            + self.by_rate.derivative(order) * rate
            + self.by_square.derivative(order) * square
        )


def accelerations(system: CartPole, angle: Interval, order: int) -> Accelerations:
    """Enclose the parts of the accelerations near or over angles.

    Args:
        system: The cart-pole.
        angle: Angles, shape (...) [rad].
        order: Order of the series, at least 1.

    Returns:
        The parts.
    """
    check_cartpole(system, "accelerations")
    place = variable(angle, order)
    zero = place * 0.0

    def at(push: Any, rate: Any, functions: Any) -> list[Any]:
        rates = system.derivative([0.0, place, 0.0, rate], [push], functions)
        return [rates[VELOCITY], rates[ANGULAR_RATE]]

    # The slopes at f = w = 0 are a_f and a_w, without the cancellation of a difference; w^2 is so
    # large that the rest hardly widens a_q.
    seed = Dual(zero, zero + 1.0)
    by_push = _stack([rate.gradient for rate in at(seed, zero, functions)])
    by_rate = _stack([rate.gradient for rate in at(zero, seed, functions)])
    still = _stack(at(0.0, 0.0, functions))
    ahead, behind = (_stack(at(0.0, rate, functions)) for rate in (_FAST, -_FAST))
    by_square = ((ahead - still) + (behind - still)) * (0.5 / _FAST**2)
    return Accelerations(still, by_push, by_rate, by_square)


def jacobian_parts(system: CartPole, parts: Accelerations) -> JacobianParts:
    """Enclose the Jacobian, one order less than the accelerations."""
    check_cartpole(system, "jacobian_parts")
    order = len(parts.still.parts) - 2
    push_slope = parts.by_push.differentiated()
    balance = _indexed(Series(parts.balance.parts[: order + 1]), (..., None))
    still = {
        ANGLE: parts.still.differentiated(),
        VELOCITY: parts.by_push * -system.cart_friction,
        ANGULAR_RATE: parts.by_rate,
    }
    by_rate = {ANGLE: parts.by_rate.differentiated(), ANGULAR_RATE: parts.by_square * 2.0}
    return JacobianParts(
        still=_matrix(order, still, kinematic=True),
        by_push=_matrix(order, {ANGLE: push_slope}),
        by_rate=_matrix(order, by_rate),
        by_square=_matrix(order, {ANGLE: parts.by_square.differentiated()}),
        by_balance=_matrix(order, {ANGLE: balance * push_slope}),
    )


def control_square(parts: Accelerations) -> Series:
    """Enclose B B', a series of shape (..., 4, 4)."""
    column = _indexed(parts.by_push, (..., slice(None), None))
    square = column * _indexed(parts.by_push, (..., None, slice(None)))
    placed = []
    for part in square.parts:
        lower, upper = np.zeros((2, *part.shape[:-2], _STATES, _STATES))
        lower[..., _RATES, _RATES], upper[..., _RATES, _RATES] = part.lower, part.upper
        placed.append(Interval(lower, upper))
    return Series(placed)


def metric_series(metric: Metric, angle: Series) -> Series:
    """Enclose W_bar for angles that are a series (...), as one of shape (..., 4, 4).

    The polynomial is expanded about the cosine of the midpoint, itself by intervals: its
    coefficients are large and of both signs, and intervals would not see that they cancel.
    """
    check_cartpole_metric(metric, "metric_series")
    cosine = functions.cos(angle)
    centre = cosine.parts[0].midpoint
    gap = _indexed(cosine - centre, (..., None, None))
    powers = [exact(np.ones((*centre.shape, 1, 1)))]
    for _ in range(metric.degree):
        powers.append(powers[-1] * centre[..., None, None])
    total: Series | None = None
    for order in reversed(range(metric.degree + 1)):
        weight = powers[0] * metric.coefficients[order]
        for index in range(order + 1, metric.degree + 1):
            # The binomial is a small integer; its product with a weight rounds.
            scaled = exact(metric.coefficients[index]) * float(comb(index, order))
            weight = weight + powers[index - order] * scaled
        if total is None:
            still = exact(np.zeros(weight.shape))
            total = Series([weight, *[still] * (len(angle.parts) - 1)])
        else:
            total = total * gap + weight
    assert total is not None
    return total


def twice_symmetric(left: Interval, right: Interval) -> Interval:
    """Enclose L R + R L' for interval matrices, R symmetric."""
    product = matmul(left, right)
    return product + transpose(product)


def _stack(pair: list[Series]) -> Series:
    """Put two series side by side along a new last axis."""
    return Series(
        [
            Interval(
                np.stack([part.lower for part in parts], axis=-1),
                np.stack([part.upper for part in parts], axis=-1),
            )
            for parts in zip(*[one.parts for one in pair], strict=True)
        ]
    )


def _indexed(one: Series, index: Any) -> Series:
    """Index every coefficient, as an array."""
    return Series([part[index] for part in one.parts])


def _matrix(order: int, columns: dict[int, Series], kinematic: bool = False) -> Series:
    """Return matrices whose lower half holds the columns (..., 2).

    The upper half is zero, or that of a Jacobian: the positions' rates are the rates.
    """
    shape = next(iter(columns.values())).parts[0].shape[:-1]
    parts = []
    for k in range(order + 1):
        lower, upper = np.zeros((2, *shape, _STATES, _STATES))
        for column, entry in columns.items():
            lower[..., _RATES, column] = entry.parts[k].lower
            upper[..., _RATES, column] = entry.parts[k].upper
        if kinematic and k == 0:
            for ends in (lower, upper):
                ends[..., POSITION, VELOCITY] = ends[..., ANGLE, ANGULAR_RATE] = 1.0
        parts.append(Interval(lower, upper))
    return Series(parts)
