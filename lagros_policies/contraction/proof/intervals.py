"""Interval arithmetic on arrays, rounded outwards: what is computed encloses what is true.

An `Interval` is a number type like any other: the equations of motion run on it, and duals of
intervals (`lagros_envs.dynamics.dual`) enclose their Jacobians. NumPy rounds + - * / to the nearest
double, so widening each result by at least one unit in the last place encloses the exact one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Union

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import System, dual

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Number = Union["Interval", FloatArray, float]

# |x| 2^-52 is between one and two units in the last place of x. The second term covers underflow
# and is no subnormal number, which would slow every product down.
_ULP = 2.0**-52
_TINY = 1e-300
# NumPy's sine and cosine are taken to err by 4 units in the last place at most, 4.5e-16 up to one.
_SINE_ERROR = 2e-15
# Beyond this the reduction of the angle is not trusted and the answer is [-1, 1].
_LARGEST_ANGLE = 1e4
# How far the extrema of the sine are looked for outside the interval: too many only widens.
_ANGLE_SLACK = 1e-10


# What rounding may add to an entry of a product of three 4 by 4 matrices, relative to the product
# of their magnitudes: it is below 16 units, of 1.1e-16 each.
_PRODUCT_ERROR = 64 * 2.0**-52
# The sums and products of the test itself; a bound this near to failing counts as failed.
_SLACK = 1e-9


class Interval:
    """Arrays of closed intervals [lower, upper], broadcast like arrays.

    Attributes:
        lower: Lower ends, shape (...).
        upper: Upper ends, the same shape.
    """

    __slots__ = ("lower", "upper")

    def __init__(self, lower: Any, upper: Any) -> None:
        """Pair the ends.

        Args:
            lower: Lower ends, shape (...).
            upper: Upper ends; broadcast against the lower ones.

        Raises:
            ValueError: A lower end exceeds its upper end, or an end is not a number.
        """
        low, high = np.broadcast_arrays(np.asarray(lower, float), np.asarray(upper, float))
        if not np.all(low <= high):
            raise ValueError("lower must not exceed upper, and neither may be NaN: swap the ends")
        self.lower: FloatArray = low
        self.upper: FloatArray = high

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.lower.shape

    @property
    def midpoint(self) -> FloatArray:
        """A point inside each interval."""
        middle: FloatArray = 0.5 * self.lower + 0.5 * self.upper
        return middle

    @property
    def radius(self) -> FloatArray:
        """An upper bound of the distance from the midpoint to either end."""
        middle = self.midpoint
        reach: FloatArray = _up(np.maximum(self.upper - middle, middle - self.lower))
        return reach

    def contains(self, value: FloatArray | float) -> BoolArray:
        """Return which numbers lie inside, shape (...)."""
        inside: BoolArray = (self.lower <= value) & (value <= self.upper)
        return inside

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """Let NumPy's functions, and arrays on the left of an operator, work on intervals."""
        if method != "__call__" or options or ufunc not in _UFUNCS:
            return NotImplemented
        return _UFUNCS[ufunc](*(_interval(value) for value in inputs))

    def __getitem__(self, index: Any) -> Interval:
        """Take a part, as of an array."""
        return _pair(self.lower[index], self.upper[index])

    def __add__(self, other: Number) -> Interval:
        """Enclose the sums."""
        low, high = _ends(other)
        return _pair(_down(self.lower + low), _up(self.upper + high))

    __radd__ = __add__

    def __neg__(self) -> Interval:
        """Change the sign, exactly."""
        return _pair(-self.upper, -self.lower)

    def __sub__(self, other: Number) -> Interval:
        """Enclose the differences."""
        low, high = _ends(other)
        return _pair(_down(self.lower - high), _up(self.upper - low))

    def __rsub__(self, other: Number) -> Interval:
        """Enclose the differences from a constant."""
        return -self + other

    def __mul__(self, other: Number) -> Interval:
        """Enclose the products; an interval times itself is its square."""
        if other is self:
            return self.square()
        if not isinstance(other, Interval):
            first, second = self.lower * other, self.upper * other
            return _pair(_down(np.minimum(first, second)), _up(np.maximum(first, second)))
        low, high = other.lower, other.upper
        first, second = self.lower * low, self.lower * high
        third, fourth = self.upper * low, self.upper * high
        least = np.minimum(np.minimum(first, second), np.minimum(third, fourth))
        largest = np.maximum(np.maximum(first, second), np.maximum(third, fourth))
        return _pair(_down(least), _up(largest))

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Interval:
        """Enclose the quotients.

        Raises:
            ZeroDivisionError: A divisor contains zero, or almost.
        """
        low, high = _ends(other)
        if np.any((np.asarray(low) <= _TINY) & (np.asarray(high) >= -_TINY)):
            raise ZeroDivisionError("a divisor contains zero, or almost: use smaller intervals")
        return self * _pair(_down(1.0 / np.asarray(high)), _up(1.0 / np.asarray(low)))

    def __rtruediv__(self, other: Number) -> Interval:
        """Enclose the quotients of a constant."""
        return _interval(other) / self

    def square(self) -> Interval:
        """Enclose the squares, which are not negative."""
        first, second = self.lower * self.lower, self.upper * self.upper
        around = (self.lower <= 0.0) & (self.upper >= 0.0)
        least = np.where(around, 0.0, np.maximum(_down(np.minimum(first, second)), 0.0))
        return _pair(least, _up(np.maximum(first, second)))

    def sin(self) -> Interval:
        """Enclose the sines of angles [rad]."""
        return _wave(self, np.sin, 0.5 * math.pi)

    def cos(self) -> Interval:
        """Enclose the cosines of angles [rad]."""
        return _wave(self, np.cos, 0.0)


def exact(values: Any) -> Interval:
    """Return the intervals that hold one number each, shape (...)."""
    return _interval(np.asarray(values, float))


def interval_jacobian(
    system: System, state: Interval, control: Interval
) -> tuple[Interval, Interval]:
    """Enclose d(f + Bu)/dx and B over boxes of states and controls.

    Args:
        system: The system.
        state: Boxes of x, shape (..., n).
        control: Boxes of u, shape (..., m); broadcast against the state.

    Returns:
        Enclosures of d(f + Bu)/dx, shape (..., n, n), and of B(x), shape (..., n, m).
    """
    n, m = system.state_dim, system.control_dim
    shape = np.broadcast_shapes(state.shape[:-1], control.shape[:-1])
    zero = np.zeros(shape)
    # Sums with zeros would round: broadcast the ends themselves.
    parts: list[Any] = [
        _pair(part.lower[..., index] + zero, part.upper[..., index] + zero)
        for part, count in ((state, n), (control, m))
        for index in range(count)
    ]
    seeds = dual.seed(parts)
    lower, upper = np.zeros((*shape, n, n + m)), np.zeros((*shape, n, n + m))
    for row, rate in enumerate(system.derivative(seeds[:n], seeds[n:], dual)):
        if isinstance(rate, dual.Dual):
            low, high = _ends(rate.gradient)
            lower[..., row, :] = np.moveaxis(np.asarray(low), 0, -1)
            upper[..., row, :] = np.moveaxis(np.asarray(high), 0, -1)
    full = Interval(lower, upper)
    return full[..., :n], full[..., n:]


def matmul(left: Interval, right: Interval) -> Interval:
    """Enclose the matrix products of (..., i, j) and (..., j, k), shape (..., i, k)."""
    total = left[..., :, 0, None] * right[..., 0, None, :]
    for index in range(1, left.shape[-1]):
        total = total + left[..., :, index, None] * right[..., index, None, :]
    return total


def transpose(matrix: Interval) -> Interval:
    """Return the transposes of matrices (..., i, j), shape (..., j, i)."""
    return _pair(np.swapaxes(matrix.lower, -1, -2), np.swapaxes(matrix.upper, -1, -2))


def negative_definite(matrices: Interval, added: Sequence[Interval] = ()) -> BoolArray:
    """Return which interval matrices (..., n, n) hold only negative definite symmetric ones.

    With Q from the eigenvectors of the midpoint, Q' F Q is near -I: Q' F Q = -I + E, |E| <= R. It
    is negative definite if the spectral radius of R is below one, for which R d < d with some
    d > 0 suffices; and then Q is regular and F is negative definite.

    Args:
        matrices: The matrices, shape (..., n, n).
        added: Further symmetric matrices, which broadcast against these: any multiples of their
            members by numbers from -1 to 1 may be added to the members of `matrices`.

    Returns:
        Whether that is shown, shape (...).
    """
    middle = matrices.midpoint
    middle = 0.5 * (middle + np.swapaxes(middle, -1, -2))
    usable = np.all(np.isfinite(middle), axis=(-1, -2))
    values, vectors = np.linalg.eigh(np.where(usable[..., None, None], middle, 0.0))
    usable &= values[..., -1] < 0.0
    size = np.where(values < 0.0, -values, 1.0)
    basis = vectors / np.sqrt(size)[..., None, :]
    turned = np.swapaxes(basis, -1, -2)
    # The radius is taken about this midpoint, whatever rounding made of it.
    reach = np.maximum(matrices.upper - middle, middle - matrices.lower)
    reach = np.maximum(reach, np.swapaxes(reach, -1, -2)) * (1.0 + _SLACK)
    reach = reach + _PRODUCT_ERROR * np.abs(middle)
    error = np.abs(turned @ middle @ basis + np.eye(middle.shape[-1]))
    for part in added:
        centre, radius = part.midpoint, part.radius
        error = error + np.abs(turned @ centre @ basis)
        reach = reach + radius * (1.0 + _SLACK) + _PRODUCT_ERROR * np.abs(centre)
    error = error + np.abs(turned) @ reach @ np.abs(basis)
    # What is not symmetric by rounding alone may count on either side.
    error = np.maximum(error, np.swapaxes(error, -1, -2))
    weight = np.ones(error.shape[:-1])
    for _ in range(4):
        weight = np.einsum("...ij,...j->...i", error, weight) + 1e-3 * weight
        weight /= weight.max(axis=-1, keepdims=True)
    bound = np.einsum("...ij,...j->...i", error, weight)
    proved: BoolArray = usable & np.all(bound < weight * (1.0 - _SLACK), axis=-1)
    return proved


def _pair(lower: Any, upper: Any) -> Interval:
    # Without the check of the constructor, for ends that are ordered by construction.
    value = Interval.__new__(Interval)
    value.lower, value.upper = lower, upper
    return value


def _ends(value: Number) -> tuple[Any, Any]:
    return (value.lower, value.upper) if isinstance(value, Interval) else (value, value)


def _interval(value: Number) -> Interval:
    if isinstance(value, Interval):
        return value
    array = np.asarray(value, dtype=np.float64)
    return _pair(array, array)


def _down(value: Any) -> Any:
    return value - (np.abs(value) * _ULP + _TINY)


def _up(value: Any) -> Any:
    return value + (np.abs(value) * _ULP + _TINY)


def _wave(angle: Interval, function: Any, peak: float) -> Interval:
    """Enclose the sine or cosine, whose maxima are at `peak` and every turn after it."""
    first, second = function(angle.lower), function(angle.upper)
    least, largest = np.minimum(first, second), np.maximum(first, second)
    unsure = np.maximum(np.abs(angle.lower), np.abs(angle.upper)) > _LARGEST_ANGLE
    largest = np.where(unsure | _meets(angle, peak), 1.0, largest + _SINE_ERROR)
    least = np.where(unsure | _meets(angle, peak + math.pi), -1.0, least - _SINE_ERROR)
    return _pair(np.maximum(least, -1.0), np.minimum(largest, 1.0))


def _meets(angle: Interval, place: float) -> BoolArray:
    """Return which intervals contain, or almost, place + 2 pi k for some integer k."""
    turn = 2.0 * math.pi
    number = np.ceil((angle.lower - _ANGLE_SLACK - place) / turn)
    found: BoolArray = place + turn * number <= angle.upper + _ANGLE_SLACK
    return found


_UFUNCS: dict[Any, Any] = {
    np.add: lambda a, b: a + b,
    np.subtract: lambda a, b: a - b,
    np.multiply: lambda a, b: a * b,
    np.true_divide: lambda a, b: a / b,
    np.negative: lambda a: -a,
    np.square: Interval.square,
    np.sin: Interval.sin,
    np.cos: Interval.cos,
}
