"""A network to second order over boxes: value and slope at the middle, second derivatives anywhere.

y(c + e) = y(c) + y'(c) e + e' y''(xi) e / 2 with some xi in the box (Taylor's theorem). Layer by
layer the second derivatives are enclosed with the ranges of the layer before, and bound the ranges
of the next: so ranges grow with the box and its square, where intervals alone are lost after two
layers.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import Interval, exact
from lagros_envs.numbers.interval import ordered
from lagros_policies.learning.networks import Mlp
from lagros_policies.proof.rounded import above, linear, symmetric, within

Layers = Sequence[tuple[NDArray[np.floating], NDArray[np.floating]]]

# NumPy's tanh is taken to err by 4 units in the last place at most, in double and single precision.
_TANH_ERROR = 2e-15
_TANH_ERROR_32 = 4.0 * 2.0**-23
# Single precision: unit of rounding, and what underflows.
_UNIT_32, _TINY_32 = 2.0**-24, 2.0**-120


class Pairs(NamedTuple):
    """Pairs i <= j of n coordinates, in the order of second derivatives.

    Attributes:
        first: i of each, shape (p,).
        second: j of each, shape (p,).
        weight: 1 for i = j, else 2, shape (p,).
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    weight: FloatArray


def pairs(count: int) -> Pairs:
    """Return the pairs of so many coordinates."""
    first, second = np.array(
        list(itertools.combinations_with_replacement(range(count), 2)), np.intp
    ).T
    return Pairs(first, second, np.where(first == second, 1.0, 2.0))


@dataclass(frozen=True)
class Expansion:
    """Numbers y of a vector x, to second order over boxes |x - centre| <= reach.

    Attributes:
        centre: Middle of each box, shape (b, n).
        reach: Half its sides, shape (b, n).
        value: y at the middle, intervals of shape (b, y).
        slope: dy/dx at the middle, shape (b, n, y).
        values: y over the box, shape (b, y).
        slopes: dy/dx over the box, shape (b, n, y).
        curves: Second derivatives over the box by `pairs` of coordinates, shape (b, p, y).
        rounding: By how much y, evaluated in single precision, may differ, shape (b, y).
    """

    centre: FloatArray
    reach: FloatArray
    value: Interval
    slope: Interval
    values: Interval
    slopes: Interval
    curves: Interval
    rounding: FloatArray

    def remainder(self) -> Interval:
        """Enclose e' y''(xi) e / 2 over the box, shape (b, y)."""
        first, second, weight = pairs(self.centre.shape[-1])
        # A square is not negative: a pure second derivative keeps its sign.
        size = self.reach[:, first] * self.reach[:, second]
        square = (first == second)[:, None]
        low = np.where(square, np.minimum(self.curves.lower, 0.0), _least(self.curves))
        high = np.where(square, np.maximum(self.curves.upper, 0.0), -_least(self.curves))
        share = (0.5 * weight * size)[..., None]
        return ordered(-above(-(share * low).sum(axis=-2)), above((share * high).sum(axis=-2)))

    def drift(self) -> FloatArray:
        """Bound |dy/dx - (dy/dx at the middle)| over the box, shape (b, n, y)."""
        n = self.centre.shape[-1]
        first, second, _ = pairs(n)
        moved = np.zeros((len(self.centre), n, self.curves.shape[-1]))
        size = -_least(self.curves)
        for index, (i, j) in enumerate(zip(first, second, strict=True)):
            moved[:, i] += size[:, index] * self.reach[:, j, None]
            if i != j:
                moved[:, j] += size[:, index] * self.reach[:, i, None]
        bound: FloatArray = above(moved)
        return bound

    def narrowed(self) -> Expansion:
        """Return the same with ranges that use the slope at the middle, too."""
        away = above((self.slope.__abs__().upper * self.reach[..., None]).sum(axis=-2))
        values = self.value + symmetric(away) + self.remainder()
        slopes = self.slope + symmetric(self.drift())
        return Expansion(
            self.centre, self.reach, self.value, self.slope,
            within(self.values, values), within(self.slopes, slopes),
            self.curves, self.rounding,
        )  # fmt: skip


def box_inputs(centre: FloatArray, reach: FloatArray, axes: FloatArray | None = None) -> Expansion:
    """Return y = centre + T x over boxes of x, as inputs of a network.

    Args:
        centre: Middle of the inputs, shape (b, n).
        reach: Half the sides of each box of x about zero, shape (b, n), not negative.
        axes: T, shape (b, n, n); the identity if left out: then the inputs lie in the box.
    """
    batch, n = centre.shape
    turn = np.broadcast_to(np.eye(n) if axes is None else axes, (batch, n, n))
    slope = exact(np.swapaxes(turn, 1, 2))
    values = exact(centre) + symmetric(above(np.einsum("bij,bj->bi", np.abs(turn), reach)))
    curves = exact(np.zeros((batch, n * (n + 1) // 2, n)))
    rounding = above(_UNIT_32 * abs(values).upper)
    return Expansion(centre, reach, exact(centre), slope, values, slope, curves, rounding)


def expand(network: Mlp, inputs: Expansion) -> Expansion:
    """Return what a network makes of its inputs, to second order over the boxes."""
    found = inputs.narrowed()
    layers = list(zip(network.weights, network.biases, strict=True))
    for index, (weight, bias) in enumerate(layers):
        found = _layer(found, weight, bias)
        if index < len(layers) - 1:
            found = _tanh(found)
    return found


def evaluated(network: Mlp, inputs: FloatArray) -> tuple[Interval, FloatArray]:
    """Enclose what the layers of a network give at points, and what single precision rounds.

    Args:
        network: The network.
        inputs: Numbers of single precision, shape (..., inputs).

    Returns:
        The outputs of the last layer, of real numbers, and by how much those that are evaluated in
        single precision, in whatever order sums are taken, may differ, (..., outputs).
    """
    values, rounding = exact(inputs), np.zeros(inputs.shape)
    layers = list(zip(network.weights, network.biases, strict=True))
    for index, (weight, bias) in enumerate(layers):
        rounding = _rounded(values, rounding, weight, bias)
        values = linear(values, np.asarray(weight, float), np.asarray(bias, float))
        if index < len(layers) - 1:
            _, near, _ = tanh_derivatives(values + symmetric(rounding))
            values, _, _ = tanh_derivatives(values)
            rounding = near.upper * rounding + _TANH_ERROR_32 * abs(values).upper + _TINY_32
    return values, above(rounding)


def _rounded(
    values: Interval,
    rounding: FloatArray,
    weight: NDArray[np.floating],
    bias: NDArray[np.floating],
) -> FloatArray:
    """Bound what single precision makes of a layer, of inputs that it knew to `rounding`."""
    sizes, offset = np.abs(np.asarray(weight, float)), np.abs(np.asarray(bias, float))
    share = (len(sizes) + 2) * _UNIT_32 * (1.0 + 2.0**-10)
    reached = abs(values).upper + rounding
    bound: FloatArray = above(rounding @ sizes + share * (reached @ sizes + offset) + _TINY_32)
    return bound


def _layer(given: Expansion, weight: NDArray[np.floating], bias: NDArray[np.floating]) -> Expansion:
    matrix, offset = np.asarray(weight, float), np.asarray(bias, float)
    return Expansion(
        given.centre,
        given.reach,
        linear(given.value, matrix, offset),
        linear(given.slope, matrix),
        linear(given.values, matrix, offset),
        linear(given.slopes, matrix),
        linear(given.curves, matrix),
        _rounded(given.values, given.rounding, weight, bias),
    ).narrowed()


def _tanh(given: Expansion) -> Expansion:
    value, slope, _ = tanh_derivatives(given.value)
    values, slopes, curves = tanh_derivatives(given.values)
    # Single precision reaches a little beyond the range.
    _, near, _ = tanh_derivatives(given.values + symmetric(given.rounding))
    rounding = near.upper * given.rounding + _TANH_ERROR_32 * abs(values).upper + _TINY_32
    first, second, _ = pairs(given.centre.shape[-1])
    products = given.slopes[:, first] * given.slopes[:, second]
    square = first == second
    products = ordered(
        np.where(square[:, None], np.maximum(products.lower, 0.0), products.lower), products.upper
    )
    return Expansion(
        given.centre,
        given.reach,
        value,
        slope[:, None] * given.slope,
        values,
        slopes[:, None] * given.slopes,
        curves[:, None] * products + slopes[:, None] * given.curves,
        above(rounding),
    ).narrowed()


def tanh_derivatives(values: Interval) -> tuple[Interval, Interval, Interval]:
    """Enclose tanh and its first two derivatives."""
    low = np.maximum(np.tanh(values.lower) - _TANH_ERROR, -1.0)
    high = np.minimum(np.tanh(values.upper) + _TANH_ERROR, 1.0)
    tanh = ordered(low, high)
    slope = 1.0 - tanh.square()
    # tanh'' = -2 t (1 - t^2) of t = tanh falls between its extrema at t = -+1/sqrt(3), of size
    # 4/(3 sqrt(3)), and rises outside.
    ends = [-2.0 * exact(end) * (1.0 - exact(end).square()) for end in (low, high)]
    least = np.minimum(ends[0].lower, ends[1].lower)
    largest = np.maximum(ends[0].upper, ends[1].upper)
    turn, peak = 3.0**-0.5, 4.0 / (3.0 * 3.0**0.5) + 1e-15
    near = 1e-12
    least = np.where((low - near <= turn) & (turn <= high + near), -peak, least)
    largest = np.where((low - near <= -turn) & (-turn <= high + near), peak, largest)
    return tanh, ordered(np.maximum(slope.lower, 0.0), slope.upper), ordered(least, largest)


def _least(values: Interval) -> FloatArray:
    size: FloatArray = -abs(values).upper
    return size
