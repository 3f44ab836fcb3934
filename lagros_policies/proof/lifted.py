"""The condition of a held control on the state and its held deviation, over cells of a box.

For x of the box, y between x_d and x, and z = (e, v), the matrix is

    2 sym([J(y, u_d) B(x); 0 0] Q) + R,    Q and R given symmetric matrices of size 5.

The angles of x and of y are cut into cells with interpolation in between; B depends on the first, J
on the second. J is affine in all else, whose corners decide: the push f = u_d - mu_c dp/dt, and
(w, w^2), w the rate of y, in the polygon between the tangents to the parabola at both ends and at
zero. The map (x, y, u_d) -> -(x, y, u_d) changes nothing, so that the angle of x may be taken to be
positive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagros_envs.numbers import Interval, exact
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY, CartPole
from lagros_policies.contraction.systems import check_cartpole
from lagros_policies.proof.box import ProofBox
from lagros_policies.proof.cells import Examined, grid, remainder
from lagros_policies.proof.matrices import matmul
from lagros_policies.proof.motion import (
    accelerations,
    jacobian_parts,
    twice_symmetric,
)
from lagros_policies.proof.rates import Violation

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_ANGLE, _OTHER = range(2)
_FIRST = (4, 8)
_STATES, _SIZE = 4, 5
_RATES = slice(VELOCITY, ANGULAR_RATE + 1)
# The range of the rates is widened by this share, whose square is far above rounding, so that the
# polygon of rounded corners still encloses the parabola.
_WIDER = 1.0 + 1e-6


class LiftedCondition:
    """The matrices of one Q and R on a box, for `cells.search`.

    Args:
        system: The cart-pole.
        box: The set.
        dual: Q, shape (5, 5).
        rest: Enclosure of R, shape (5, 5).

    Raises:
        ValueError: The box has a lean, which is not covered here.
    """

    def __init__(self, system: CartPole, box: ProofBox, dual: FloatArray, rest: Interval) -> None:
        """Bound the push and the square of the rate."""
        check_cartpole(system, type(self).__name__)
        if box.lean != 0.0:
            raise ValueError(f"lean={box.lean!r} must be 0: forces that lean are not covered here")
        self.system, self.box = system, box
        self.dual, self.rest = exact(dual), rest
        self.push = float((exact(box.velocity) * system.cart_friction + box.force).upper)
        self.rate = box.angular_rate * _WIDER

    def start(self) -> Interval:
        """Return the first cells (k, 2) of both angles."""
        angle = self.box.angle
        return grid(np.array([0.0, -angle]), np.array([angle, angle]), _FIRST)

    def examine(self, cells: Interval) -> Examined:
        """Enclose the matrices over cells (k, 2)."""
        remainders = self._remainders(cells)
        return Examined(self._corners(cells), remainders, remainders, self._outside(cells))

    def failure(self, cells: Interval) -> Violation | None:
        """Look for a corner, of the set but for its rounding, at which the condition fails."""
        matrices = self._corners(cells)
        values, vectors = np.linalg.eigh(matrices.midpoint)
        ends = np.stack([cells.lower, cells.upper], axis=1)
        for index in np.argsort(values[..., -1], axis=None)[::-1][:20]:
            cell, corner = np.unravel_index(index, values.shape[:2])
            if values[cell, corner, -1] <= 0.0:
                return None
            choice, place = divmod(int(corner), 4)
            push, rate, square = self._choices()[choice]
            angle, other = ends[cell, place // 2, _ANGLE], ends[cell, place % 2, _OTHER]
            # The corners of the polygon that are not on the parabola are no points of the set.
            if square == 0.0 or abs(other - angle) > self.box.angle_error:
                continue
            direction = exact(vectors[cell, corner, :, -1])
            form = matmul(matmul(direction[None, :], matrices[cell, corner]), direction[:, None])
            if form.lower[0, 0] > 0.0:
                return self._point(float(angle), float(other), push, rate)
        return None

    def _point(self, angle: float, other: float, push: float, rate: float) -> Violation:
        """Return x, y and u_d of a corner."""
        state, nominal = np.zeros((2, _STATES))
        state[ANGLE], nominal[ANGLE], nominal[ANGULAR_RATE] = angle, other, rate
        nominal[VELOCITY] = -np.sign(push) * self.box.velocity
        return Violation(state, nominal, np.array([np.sign(push) * self.box.force]))

    def _choices(self) -> list[tuple[float, float, float]]:
        """Return the corners of what J is affine in: f, w and w^2."""
        rate, square = self.rate, self.rate * self.rate
        ends = [(rate, square), (-rate, square), (0.5 * rate, 0.0), (-0.5 * rate, 0.0)]
        return [(push, *end) for push in (-self.push, self.push) for end in ends]

    def _outside(self, cells: Interval) -> BoolArray:
        """Return which cells hold no pair of angles of the set, shape (k,)."""
        gap = cells[:, _OTHER] - cells[:, _ANGLE]
        beyond: BoolArray = (gap.lower > self.box.angle_error) | (gap.upper < -self.box.angle_error)
        return beyond

    def _corners(self, cells: Interval) -> Interval:
        """Return the matrices at all corners, shape (k, v, 5, 5)."""
        ends = np.stack([cells.lower, cells.upper], axis=1)
        angle = exact(ends[:, [0, 0, 1, 1], _ANGLE])
        other = exact(ends[:, [0, 1, 0, 1], _OTHER])
        slopes = jacobian_parts(self.system, accelerations(self.system, other, 1))
        gain = accelerations(self.system, angle, 1).by_push.parts[0]
        found = [
            twice_symmetric(
                _lifted(slopes.at(0, _full(push), _full(0.0), _full(rate), _full(square)), gain),
                self.dual,
            )
            + self.rest
            for push, rate, square in self._choices()
        ]
        shape = (len(cells.lower), -1, _SIZE, _SIZE)
        return Interval(
            np.stack([part.lower for part in found], axis=1).reshape(shape),
            np.stack([part.upper for part in found], axis=1).reshape(shape),
        )

    def _remainders(self, cells: Interval) -> list[Interval]:
        """Return what the width of each angle may add, each (k, 5, 5)."""
        slopes = jacobian_parts(self.system, accelerations(self.system, cells[:, _OTHER], 3))
        gain = accelerations(self.system, cells[:, _ANGLE], 2).by_push.derivative(2)
        rate = self.rate
        bent = slopes.at(
            2,
            Interval(_full(-self.push), _full(self.push)),
            _full(0.0),
            Interval(_full(-rate), _full(rate)),
            Interval(_full(0.0), _full(rate * rate)),
        )
        no_gain, no_slope = gain * 0.0, bent * 0.0
        width = (cells.upper - cells.lower).T
        by_angle = twice_symmetric(_lifted(no_slope, gain), self.dual)
        by_other = twice_symmetric(_lifted(bent, no_gain), self.dual)
        return [remainder(by_angle, width[_ANGLE]), remainder(by_other, width[_OTHER])]


def _lifted(slope: Interval, gain: Interval) -> Interval:
    """Return [J B; 0 0] for J (..., 4, 4) and the lower half of B (..., 2), shape (..., 5, 5)."""
    lower, upper = np.zeros((2, *slope.shape[:-2], _SIZE, _SIZE))
    lower[..., :_STATES, :_STATES], upper[..., :_STATES, :_STATES] = slope.lower, slope.upper
    lower[..., _RATES, _STATES], upper[..., _RATES, _STATES] = gain.lower, gain.upper
    return Interval(lower, upper)


def _full(value: float) -> FloatArray:
    return np.full((1, 1), value)
