"""The condition over a hold of the control: V falls from one control instant to the next.

With Phi the Runge-Kutta map of one hold (the one that the environment integrates), F = dPhi/dx,
G = dPhi/du, x' = Phi(x, u_d) and L any matrix of three rows with L G = 0, the condition is

    L (F(x, u_d) W_bar(x) F(x, u_d)' - exp(-2 alpha h) W_bar(x')) L' < 0.

Then, for every displacement e of x, some deviation v makes (F e + G v)' M(x') (F e + G v) at most
exp(-2 alpha h) e'M(x)e, by a Schur complement; by Finsler's lemma it is the same to ask that
F W_bar F' - nu_h G G' < exp(-2 alpha h) W_bar(x') for some nu_h. (W_bar must be positive definite
at x and at x', which may lie outside the box: `largest_angle_after`.) That is the condition that
`HeldControl` imposes, for an infinitesimal error: the sampled loop is contracting in the metric, at
the rate alpha, while it stays in the box. L = [I, -g] with g = G_i / G_4, which is smooth: the
force moves the pole's rate everywhere.

Angle, rate and push f = u_d - mu_c dp/dt are cut into cells with interpolation in between; the
cart's speed enters through f alone, during the hold too, so that it may be taken as zero at the
start. The map (x, u_d) -> -(x, u_d) changes nothing, so that the angle may be taken to be positive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_positive
from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.numbers import Interval, Series, dual, exact, functions, variable
from lagros_envs.tasks.cartpole.physics import ANGLE, CartPole
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.systems import check_cartpole, check_cartpole_metric
from lagros_policies.proof.box import ProofBox
from lagros_policies.proof.cells import Examined, grid, remainder
from lagros_policies.proof.matrices import matmul, transpose
from lagros_policies.proof.motion import accelerations, metric_series

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_ANGLE, _RATE, _PUSH = range(3)
_FIRST = (6, 6, 4)
# Cells that enclose where a hold ends.
_IMAGE = (20, 10, 6)
_CORNERS = np.array(list(np.ndindex(2, 2, 2)))
# Directions of the Jacobians: the state but for the position, and the force.
_SEEDS = 4


@dataclass(frozen=True)
class HeldViolation:
    """A point at which interval arithmetic shows that the condition over a hold fails.

    Attributes:
        state: x with the cart at rest, shape (4,).
        control: The push u_d - mu_c dp/dt, which is the force for a cart at rest, shape (1,).
    """

    state: FloatArray
    control: FloatArray


class HoldCondition:
    """The matrices of a metric on a box, for `cells.search`.

    Args:
        system: The cart-pole.
        metric: The metric.
        box: The set; its errors are not used.
        contraction_rate: alpha [1/s].
        period: Hold h [s].
    """

    def __init__(
        self,
        system: CartPole,
        metric: Metric,
        box: ProofBox,
        contraction_rate: float,
        period: float,
    ) -> None:
        """Bound the push."""
        check_cartpole(system, type(self).__name__)
        check_cartpole_metric(metric, type(self).__name__)
        check_positive("contraction_rate", contraction_rate)
        check_positive("period", period)
        self.system, self.metric, self.box, self.period = system, metric, box, period
        # The exponential of the library errs by less than one unit in the last place.
        self.decay = math.nextafter(math.exp(-2.0 * contraction_rate * period), 0.0)
        self.push = float((exact(box.velocity) * system.cart_friction + box.force).upper)

    def start(self) -> Interval:
        """Return the first cells (k, 3) of angle, rate and push."""
        return self._cells(_FIRST)

    def largest_angle_after(self) -> float:
        """Bound |theta| after a hold from anywhere in the box [rad]; it may lie outside the box.

        V after the hold is measured by W_bar(x') there, so that it must be positive definite there
        too.
        """
        cells = self._cells(_IMAGE)
        after = self.map([Series([cells[:, index]]) for index in range(3)])[2].parts[0]
        return float(np.maximum(np.abs(after.lower), np.abs(after.upper)).max())

    def _cells(self, counts: tuple[int, ...]) -> Interval:
        """Cut the box into equal cells (k, 3) of angle, rate and push."""
        box = self.box
        cells = grid(
            np.array([0.0, -box.angular_rate, -self.push]),
            np.array([box.angle, box.angular_rate, self.largest_push(box.angle)]),
            counts,
        )
        return cells[~self._outside(cells)]

    def largest_push(self, angle: float) -> float:
        """Bound the push at angles from 0 to an angle [rad]."""
        if self.box.lean == 0.0:
            return self.push
        balance = accelerations(self.system, Interval(0.0, angle), 1).balance.parts[0]
        return float((balance * self.box.lean + self.push).upper)

    def examine(self, cells: Interval) -> Examined:
        """Enclose the matrices over cells (k, 3)."""
        remainders = self._remainders(cells)
        return Examined(self._corners(cells), remainders, remainders, self._outside(cells))

    def failure(self, cells: Interval) -> HeldViolation | None:
        """Look for a corner at which the condition fails."""
        matrices = self._corners(cells)
        values, vectors = np.linalg.eigh(matrices.midpoint)
        places = np.stack([cells.lower, cells.upper], axis=1)
        for index in np.argsort(values[..., -1], axis=None)[::-1][:20]:
            cell, corner = np.unravel_index(index, values.shape[:2])
            place = places[cell, _CORNERS[corner], np.arange(3)]
            if values[cell, corner, -1] <= 0.0:
                return None
            if place[_PUSH] > self.largest_push(float(place[_ANGLE])):
                continue
            direction = exact(vectors[cell, corner, :, -1])
            form = matmul(matmul(direction[None, :], matrices[cell, corner]), direction[:, None])
            if form.lower[0, 0] > 0.0:
                state = np.array([0.0, place[_ANGLE], 0.0, place[_RATE]])
                return HeldViolation(state, place[[_PUSH]])
        return None

    def _outside(self, cells: Interval) -> BoolArray:
        """Return which cells hold no force of the box, shape (k,)."""
        beyond = np.zeros(len(cells.lower), dtype=bool)
        if self.box.lean > 0.0:
            balance = accelerations(self.system, cells[:, _ANGLE], 1).balance.parts[0]
            beyond = cells.lower[:, _PUSH] > (balance * self.box.lean + self.push).upper
        return beyond

    def _corners(self, cells: Interval) -> Interval:
        """Return the matrices at the corners, shape (k, 8, 4, 4)."""
        ends = np.stack([cells.lower, cells.upper], axis=1)
        places = exact(ends[:, _CORNERS, np.arange(3)])
        parts = [Series([places[..., index]]) for index in range(3)]
        return self._matrices(parts).parts[0]

    def _remainders(self, cells: Interval) -> list[Interval]:
        """Return what the width of each coordinate may add, each (k, 4, 4)."""
        width = (cells.upper - cells.lower).T
        found = []
        for moving in range(3):
            parts = [variable(cells[:, index], 2) for index in range(3)]
            still = exact(np.zeros(len(cells.lower)))
            parts = [
                part if index == moving else Series([part.parts[0], still, still])
                for index, part in enumerate(parts)
            ]
            found.append(remainder(self._matrices(parts).derivative(2), width[moving]))
        return found

    def _matrices(self, places: list[Series]) -> Series:
        """Enclose the matrices for angle, rate and push, a series of shape (..., 3, 3)."""
        slope, gain, following = self.map(places)
        share = Series([part[..., :3, :] for part in gain.parts]) / _row(gain, 3)
        left = _reduced(slope, share)
        before = product(
            product(left, metric_series(self.metric, places[_ANGLE])), transposed(left)
        )
        after = _reduced(metric_series(self.metric, following), share)
        after = _reduced(transposed(after), share)
        return before - after * self.decay

    def map(self, places: list[Series]) -> tuple[Series, Series, Series]:
        """Enclose the map of a hold.

        Args:
            places: Angle, rate and push, series of shape (...).

        Returns:
            dPhi/dx (..., 4, 4), dPhi/du (..., 4, 1) and the angle after the hold (...).
        """
        zero = places[0] * 0.0
        shape = zero.parts[0].shape
        still = [exact(np.zeros((_SEEDS, *shape)))] * (len(zero.parts) - 1)
        seeds = []
        for index, part in enumerate([places[_ANGLE], zero, places[_RATE], places[_PUSH]]):
            unit = np.zeros((_SEEDS, *shape))
            unit[index] = 1.0
            seeds.append(dual.Dual(part, Series([exact(unit), *still])))
        # Nothing but the position after the hold depends on the position, and that by one.
        start = [dual.Dual(zero, seeds[0].gradient * 0.0), *seeds[:3]]
        ended = rk4_hold(self.system, start, seeds[3:], [0.0] * 4, self.period, functions)
        gradient = _rows([part.gradient for part in ended])
        slope = []
        for order, block in enumerate(gradient.parts):
            lower, upper = np.zeros((2, *shape, 4, 4))
            lower[..., 1:], upper[..., 1:] = block.lower[..., :3], block.upper[..., :3]
            if order == 0:
                lower[..., 0, 0] = upper[..., 0, 0] = 1.0
            slope.append(Interval(lower, upper))
        gain = Series([part[..., 3:] for part in gradient.parts])
        return Series(slope), gain, ended[ANGLE].value


def _reduced(matrix: Series, share: Series) -> Series:
    """Return L A for matrices (..., 4, k): the first three rows less shares of the last."""
    top = Series([part[..., :3, :] for part in matrix.parts])
    return top - share * _row(matrix, 3)


def _row(matrix: Series, index: int) -> Series:
    """Return one row of matrices, shape (..., 1, k)."""
    return Series([part[..., index : index + 1, :] for part in matrix.parts])


def product(left: Series, right: Series) -> Series:
    """Enclose the matrix products of two series of matrices."""
    parts = []
    for order in range(len(left.parts)):
        total = matmul(left.parts[0], right.parts[order])
        for index in range(1, order + 1):
            total = total + matmul(left.parts[index], right.parts[order - index])
        parts.append(total)
    return Series(parts)


def transposed(matrix: Series) -> Series:
    """Return the transposes of a series of matrices."""
    return Series([transpose(part) for part in matrix.parts])


def _rows(gradients: list[Series]) -> Series:
    """Stack series (k, ...) into one of matrices (..., rows, k)."""
    parts = []
    for row in zip(*[gradient.parts for gradient in gradients], strict=True):
        lower = np.moveaxis(np.stack([part.lower for part in row]), (0, 1), (-2, -1))
        upper = np.moveaxis(np.stack([part.upper for part in row]), (0, 1), (-2, -1))
        parts.append(Interval(lower, upper))
    return Series(parts)
