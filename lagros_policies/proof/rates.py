"""The condition of Theorem 2 on the derivative, over cells of a box of the cart-pole.

For x of the box and y between x and x_d, the matrix is

    -dW_bar/dt(x) + 2 sym(J(y, u_d) W_bar(x)) - 2 nu B(x) B(x)' + 2 alpha W_bar(x).

Two coordinates are cut into cells with interpolation in between: the angle of x, and that of y (or
its difference, where the errors are bounded). The matrix is affine in all others, whose corners
decide: the push f = u_d - mu_c dp/dt, the rate of x, and the rate w of y with its square q. Over
w in [a, b] the pair (w, q) lies in the triangle (a, a^2), (b, b^2), ((a + b)/2, ab); the rate is
the third coordinate that is cut. The map (x, y, u_d) -> -(x, y, u_d) changes nothing, so that the
angle of x may be taken to be positive.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.numbers import Interval, exact, variable
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY, CartPole
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.systems import check_cartpole, check_cartpole_metric
from lagros_policies.proof.box import ProofBox
from lagros_policies.proof.cells import Examined, grid, remainder
from lagros_policies.proof.matrices import interval_jacobian, matmul, transpose
from lagros_policies.proof.motion import (
    JacobianParts,
    accelerations,
    control_square,
    jacobian_parts,
    metric_series,
    twice_symmetric,
)

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_ANGLE, _OTHER, _RATE = range(3)
_FIRST_ANGLES = 8
_FIRST_RATES = 2
# The range of the rates of x is widened by this, so that its rounded ends still enclose it.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Violation:
    """A point at which interval arithmetic shows that the condition fails.

    Attributes:
        state: x, shape (4,).
        nominal: y, which may serve as x_d, shape (4,).
        control: u_d, shape (1,).
    """

    state: FloatArray
    nominal: FloatArray
    control: FloatArray


@dataclass(frozen=True)
class _Corner:
    """One choice of what the matrix is affine in; each an array (k,), one entry per cell."""

    push: FloatArray
    balance: FloatArray
    rate: FloatArray  # of x
    other_rate: FloatArray  # of y
    square: Interval
    real: bool  # whether it is a point of the set, not the tip of a triangle


class RateCondition:
    """The matrices of a metric on a box, for `cells.search`.

    Args:
        system: The cart-pole.
        metric: The metric, with the rate alpha that is asked for.
        box: The set.
    """

    def __init__(self, system: CartPole, metric: Metric, box: ProofBox) -> None:
        """Bound the push."""
        check_cartpole(system, type(self).__name__)
        check_cartpole_metric(metric, type(self).__name__)
        self.system, self.metric, self.box = system, metric, box
        self.apart = box.angle_error >= 2.0 * box.angle
        self.rate_error = min(box.angular_rate_error, 2.0 * box.angular_rate)
        self.push = _largest_push(system, box)

    def start(self) -> Interval:
        """Return the first cells (k, 3)."""
        box = self.box
        error = min(box.angle_error, 2.0 * box.angle)
        reach = box.angle if self.apart else error
        others = 1 if reach == 0.0 else 2 * _FIRST_ANGLES
        # The rate of x is bounded by that of the box or by that of y: a kink where both meet.
        kink = box.angular_rate - self.rate_error
        cuts = np.linspace(-box.angular_rate, box.angular_rate, _FIRST_RATES + 1)
        cuts = np.unique(np.concatenate([cuts, [-kink, kink]]))
        ends = list(itertools.pairwise(cuts)) or [(0.0, 0.0)]
        parts = [
            grid(
                np.array([0.0, -reach, low]),
                np.array([box.angle, reach, high]),
                (_FIRST_ANGLES, others, 1),
            )
            for low, high in ends
        ]
        return Interval(
            np.concatenate([part.lower for part in parts]),
            np.concatenate([part.upper for part in parts]),
        )

    def examine(self, cells: Interval) -> Examined:
        """Enclose the matrices over cells (k, 3)."""
        remainders, effects = self._remainders(cells)
        return Examined(self._corners(cells), remainders, effects, self._outside(cells))

    def failure(self, cells: Interval) -> Violation | None:
        """Look for a corner at which the condition fails."""
        ends = self._ends(cells)
        matrices = self._corners(cells).midpoint
        count = len(self._choices(cells))
        values = np.linalg.eigvalsh(matrices)[..., -1].reshape(len(cells.lower), count, 2, 2)
        choices = self._choices(cells)
        for index in np.argsort(values, axis=None)[::-1][:20]:
            cell, choice, first, second = np.unravel_index(index, values.shape)
            corner = choices[choice]
            if values[cell, choice, first, second] <= 0.0:
                return None
            angle = float(ends[0].midpoint[cell, first, 0])
            other = float(ends[1].midpoint[cell, min(first, ends[1].shape[1] - 1), second])
            if not corner.real or abs(other) > self.box.angle:
                continue
            point = self._point(angle, other, corner, int(cell))
            if point is not None and fails(self.system, self.metric, point):
                return point
        return None

    def _point(self, angle: float, other: float, corner: _Corner, cell: int) -> Violation | None:
        """Return x, y and u_d of a corner, or None where the box was enlarged to cover it."""
        box = self.box
        state, nominal = np.zeros((2, 4))
        state[ANGLE], state[ANGULAR_RATE] = angle, corner.rate[cell]
        nominal[ANGLE], nominal[ANGULAR_RATE] = other, corner.other_rate[cell]
        side = np.sign(corner.push[cell])
        nominal[VELOCITY] = state[VELOCITY] = -side * box.velocity
        balance = accelerations(self.system, exact(other), 1).balance.parts[0].midpoint
        control = side * box.force + corner.balance[cell] * float(balance)
        return Violation(state, nominal, np.array([control]))

    def _choices(self, cells: Interval) -> list[_Corner]:
        """Return the corners of what the matrix is affine in."""
        box = self.box
        low, high = cells.lower[:, _RATE], cells.upper[:, _RATE]
        middle, tip = triangle_tip(low, high)
        points = [
            (low, exact(low).square(), True),
            (high, exact(high).square(), True),
            (middle, exact(tip), False),
        ]
        leans = (0.0, box.lean) if box.lean > 0.0 else (0.0,)
        error = self.rate_error
        choices = []
        for other_rate, square, real in points:
            rates = [other_rate]
            if error > 0.0:
                rates = [
                    np.maximum(other_rate - error, -box.angular_rate) - _ROUNDING,
                    np.minimum(other_rate + error, box.angular_rate) + _ROUNDING,
                ]
            for rate in rates:
                for push, lean in itertools.product((-self.push, self.push), leans):
                    full = np.full(len(low), push)
                    choices.append(
                        _Corner(full, np.full(len(low), lean), rate, other_rate, square, real)
                    )
        return choices

    def _ends(self, cells: Interval) -> tuple[Interval, Interval]:
        """Return the angles of x (k, 2, 1) and of y (k, 1 or 2, 2) at the corners of cells."""
        ends = np.stack([cells.lower, cells.upper], axis=1)
        angle, other = exact(ends[:, :, None, _ANGLE]), exact(ends[:, None, :, _OTHER])
        return angle, other if self.apart else angle + other

    def _outside(self, cells: Interval) -> BoolArray:
        """Return which cells hold no y of the box, shape (k,)."""
        if self.apart:
            return np.zeros(len(cells.lower), dtype=bool)
        other = cells[:, _ANGLE] + cells[:, _OTHER]
        beyond: BoolArray = (other.lower > self.box.angle) | (other.upper < -self.box.angle)
        return beyond

    def _corners(self, cells: Interval) -> Interval:
        """Return the matrices at all corners, shape (k, v, 4, 4)."""
        angle, other = self._ends(cells)
        slopes = jacobian_parts(self.system, accelerations(self.system, other, 1))
        square = control_square(accelerations(self.system, angle, 1)).derivative(0)
        dual = metric_series(self.metric, variable(angle, 1))
        weight = dual.derivative(0)
        constant = twice_symmetric(slopes.still.derivative(0), weight)
        constant = constant + self._rest(weight, square)
        by_push = twice_symmetric(slopes.by_push.derivative(0), weight)
        by_balance = twice_symmetric(slopes.by_balance.derivative(0), weight)
        by_rate = twice_symmetric(slopes.by_rate.derivative(0), weight)
        by_square = twice_symmetric(slopes.by_square.derivative(0), weight)
        moving = dual.derivative(1)

        def spread(values: Any) -> Any:
            return values[:, None, None, None, None]

        found = [
            constant
            + by_push * spread(corner.push)
            + by_balance * spread(corner.balance)
            + by_rate * spread(corner.other_rate)
            + by_square * spread(corner.square)
            - moving * spread(corner.rate)
            for corner in self._choices(cells)
        ]
        shape = (len(cells.lower), -1, 4, 4)
        return Interval(
            np.stack([part.lower for part in found], axis=1).reshape(shape),
            np.stack([part.upper for part in found], axis=1).reshape(shape),
        )

    def _remainders(self, cells: Interval) -> tuple[list[Interval], list[Interval]]:
        """Return the remainders of both angles and the effects of all coordinates, (k, 4, 4)."""
        angle = cells[:, _ANGLE]
        other = cells[:, _OTHER] if self.apart else angle + cells[:, _OTHER]
        slopes = jacobian_parts(self.system, accelerations(self.system, other, 3))
        square = control_square(accelerations(self.system, angle, 2))
        dual = metric_series(self.metric, variable(angle, 3))
        first, second, third = (dual.derivative(order) for order in (1, 2, 3))
        rates = [self._slopes(slopes, order, cells) for order in range(3)]
        along = twice_symmetric(rates[0], second) + self._rest(second, square.derivative(2))
        along = along - third * _wide(self._rate_of_state(cells))
        by_other = twice_symmetric(rates[2], dual.derivative(0))
        if not self.apart:
            along = along + twice_symmetric(rates[1], first) * 2.0 + by_other
        width = (cells.upper - cells.lower).T
        parts = [remainder(along, width[_ANGLE]), remainder(by_other, width[_OTHER])]
        # The tip of the triangle lies (b - a)^2 / 4 below the parabola.
        tip = twice_symmetric(slopes.by_square.derivative(0), dual.derivative(0))
        tip = tip * (0.25 * width[_RATE] ** 2)[:, None, None]
        return parts, [*parts, tip]

    def _rest(self, dual: Interval, square: Interval) -> Interval:
        """Return -2 nu B B' + 2 alpha W_bar, or a derivative of it."""
        return square * (-2.0 * self.metric.control_weight) + dual * (
            2.0 * self.metric.contraction_rate
        )

    def _slopes(self, slopes: JacobianParts, order: int, cells: Interval) -> Interval:
        """Enclose a derivative of J over cells and all that it is affine in."""
        rate = cells[:, _RATE]
        square = rate.square()
        low = np.minimum(square.lower, triangle_tip(rate.lower, rate.upper)[1])
        size = np.ones(len(cells.lower))
        return slopes.at(
            order,
            _wide(Interval(-self.push * size, self.push * size)),
            _wide(Interval(0.0 * size, self.box.lean * size)),
            _wide(rate),
            _wide(Interval(low, square.upper)),
        )

    def _rate_of_state(self, cells: Interval) -> Interval:
        """Enclose the rate of x."""
        error = self.rate_error + 2.0 * _ROUNDING
        return cells[:, _RATE] + Interval(-error, error)


def triangle_tip(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the third corner (m, q) of a triangle around the parabola (w, w^2) on [low, high].

    The other two are on the parabola, (low, low^2) and (high, high^2). The edges from there to
    (m, q) lie below it where they are no steeper than its tangents, q <= 2 a m - a^2 for both ends
    a: so m may be rounded, and q is rounded downwards.

    Args:
        low: Lower ends, shape (k,).
        high: Upper ends, shape (k,).

    Returns:
        m and q, each of shape (k,).
    """
    middle = 0.5 * (low + high)
    tangents = [exact(end) * middle * 2.0 - exact(end).square() for end in (low, high)]
    return middle, np.minimum(tangents[0].lower, tangents[1].lower)


def fails(system: CartPole, metric: Metric, point: Violation) -> bool:
    """Show by intervals, and the motion's own Jacobian, that the condition fails at a point."""
    check_cartpole(system, "fails")
    check_cartpole_metric(metric, "fails")
    slope, _ = interval_jacobian(system, exact(point.nominal), exact(point.control))
    _, gain = interval_jacobian(system, exact(point.state), exact(point.control))
    dual = metric_series(metric, variable(exact(point.state[ANGLE]), 1))
    left = twice_symmetric(slope, dual.derivative(0))
    left = left - dual.derivative(1) * float(point.state[ANGULAR_RATE])
    left = left + matmul(gain, transpose(gain)) * (-2.0 * metric.control_weight)
    left = left + dual.derivative(0) * (2.0 * metric.contraction_rate)
    direction = np.linalg.eigh(left.midpoint)[1][:, -1]
    form = matmul(matmul(exact(direction[None, :]), left), exact(direction[:, None]))
    return bool(form.lower[0, 0] > 0.0)


def rate_condition(
    system: CartPole, metric: Metric, box: ProofBox, contraction_rate: float
) -> RateCondition:
    """Return the condition at a rate alpha [1/s]."""
    return RateCondition(system, replace(metric, contraction_rate=contraction_rate), box)


def _largest_push(system: CartPole, box: ProofBox) -> float:
    """Bound |u_d - mu_c dp/dt| less the share of the balance at y."""
    push = exact(box.velocity) * system.cart_friction + box.force
    if box.lean > 0.0 and box.angle_error > 0.0:
        # u_d leans with the angle of x_d, which differs from that of y by no more than the error.
        cuts = np.linspace(-box.angle, box.angle, 201)
        slope = accelerations(system, Interval(cuts[:-1], cuts[1:]), 1).balance.parts[1]
        steepest = float(np.maximum(np.abs(slope.lower), np.abs(slope.upper)).max())
        push = push + exact(min(box.angle_error, 2.0 * box.angle)) * steepest * box.lean
    return float(push.upper)


def _wide(value: Interval) -> Interval:
    return value[:, None, None]
