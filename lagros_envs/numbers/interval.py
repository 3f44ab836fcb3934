"""Interval arithmetic on arrays, rounded outwards: what is computed encloses what is true.

An `Interval` is a number type like any other: the equations of motion run on it, and duals of
intervals enclose their Jacobians. NumPy rounds + - * / and the square root to the nearest double,
so widening each result by at least one unit in the last place encloses the exact one.
"""

from __future__ import annotations

import math
from typing import Any, Union

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.numbers.functions import power

Number = Union["Interval", FloatArray, float]

# |x| 2^-52 is between one and two units in the last place of x. The second term covers underflow
# and is no subnormal number, which would slow every product down.
_ULP = 2.0**-52
_TINY = 1e-300
# What rounding outwards may leave of a sum of squares below zero.
_BELOW = 1e-290
# NumPy's sine and cosine are taken to err by 4 units in the last place at most, 4.5e-16 up to one.
_SINE_ERROR = 2e-15
# The same for its tangent and exponential, relative to the value.
_RELATIVE_ERROR = 2e-15
# Beyond this the reduction of the angle is not trusted and the answer is [-1, 1].
_LARGEST_ANGLE = 1e4
# How far the extrema of the sine are looked for outside the interval: too many only widens.
_ANGLE_SLACK = 1e-10


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
        return ordered(self.lower[index], self.upper[index])

    def __add__(self, other: Number) -> Interval:
        """Enclose the sums."""
        if not isinstance(other, _PLAIN):
            return NotImplemented
        low, high = ends(other)
        return ordered(_down(self.lower + low), _up(self.upper + high))

    __radd__ = __add__

    def __neg__(self) -> Interval:
        """Change the sign, exactly."""
        return ordered(-self.upper, -self.lower)

    def __sub__(self, other: Number) -> Interval:
        """Enclose the differences."""
        if not isinstance(other, _PLAIN):
            return NotImplemented
        low, high = ends(other)
        return ordered(_down(self.lower - high), _up(self.upper - low))

    def __rsub__(self, other: Number) -> Interval:
        """Enclose the differences from a constant."""
        return -self + other

    def __mul__(self, other: Number) -> Interval:
        """Enclose the products; an interval times itself is its square."""
        if not isinstance(other, _PLAIN):
            return NotImplemented
        if other is self:
            return self.square()
        if not isinstance(other, Interval):
            first, second = self.lower * other, self.upper * other
            return ordered(_down(np.minimum(first, second)), _up(np.maximum(first, second)))
        low, high = other.lower, other.upper
        first, second = self.lower * low, self.lower * high
        third, fourth = self.upper * low, self.upper * high
        least = np.minimum(np.minimum(first, second), np.minimum(third, fourth))
        largest = np.maximum(np.maximum(first, second), np.maximum(third, fourth))
        return ordered(_down(least), _up(largest))

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Interval:
        """Enclose the quotients.

        Raises:
            ZeroDivisionError: A divisor contains zero, or almost.
        """
        if not isinstance(other, _PLAIN):
            return NotImplemented
        low, high = ends(other)
        if np.any((np.asarray(low) <= _TINY) & (np.asarray(high) >= -_TINY)):
            raise ZeroDivisionError("a divisor contains zero, or almost: use smaller intervals")
        return self * ordered(_down(1.0 / np.asarray(high)), _up(1.0 / np.asarray(low)))

    def __rtruediv__(self, other: Number) -> Interval:
        """Enclose the quotients of a constant."""
        return _interval(other) / self

    def square(self) -> Interval:
        """Enclose the squares, which are not negative."""
        first, second = self.lower * self.lower, self.upper * self.upper
        around = (self.lower <= 0.0) & (self.upper >= 0.0)
        least = np.where(around, 0.0, np.maximum(_down(np.minimum(first, second)), 0.0))
        return ordered(least, _up(np.maximum(first, second)))

    def sin(self) -> Interval:
        """Enclose the sines of angles [rad]."""
        return _wave(self, np.sin, 0.5 * math.pi)

    def cos(self) -> Interval:
        """Enclose the cosines of angles [rad]."""
        return _wave(self, np.cos, 0.0)

    def tan(self) -> Interval:
        """Enclose the tangents of angles [rad].

        Raises:
            ZeroDivisionError: An interval holds a pole, or almost, or is too far from zero.
        """
        unsure = np.maximum(np.abs(self.lower), np.abs(self.upper)) > _LARGEST_ANGLE
        if np.any(unsure | _meets(self, 0.5 * math.pi) | _meets(self, 1.5 * math.pi)):
            raise ZeroDivisionError("the tangent has a pole there, or almost: use smaller angles")
        return _monotone(np.tan(self.lower), np.tan(self.upper))

    def exp(self) -> Interval:
        """Enclose the exponentials, which are not negative."""
        value = _monotone(np.exp(self.lower), np.exp(self.upper))
        return ordered(np.maximum(value.lower, 0.0), value.upper)

    def sqrt(self) -> Interval:
        """Enclose the square roots; of what rounding alone put below zero, those from zero on.

        Raises:
            ValueError: An interval holds negative numbers.
        """
        if np.any(self.lower < -_BELOW):
            raise ValueError("an interval under a square root holds negative numbers")
        least = np.maximum(_down(np.sqrt(np.maximum(self.lower, 0.0))), 0.0)
        return ordered(least, _up(np.sqrt(self.upper)))

    def sign(self) -> Interval:
        """Enclose the signs; an interval around zero has all from -1 to 1."""
        return ordered(np.sign(self.lower), np.sign(self.upper))

    def __abs__(self) -> Interval:
        """Enclose the absolute values, exactly."""
        first, second = np.abs(self.lower), np.abs(self.upper)
        around = (self.lower <= 0.0) & (self.upper >= 0.0)
        least = np.where(around, 0.0, np.minimum(first, second))
        return ordered(least, np.maximum(first, second))

    def __lt__(self, other: Number) -> Truth:
        """Return where it can be, and must be, less."""
        low, high = ends(other)
        return Truth(self.lower < high, self.upper < low)

    def __le__(self, other: Number) -> Truth:
        """Return where it can be, and must be, at most."""
        low, high = ends(other)
        return Truth(self.lower <= high, self.upper <= low)

    def __gt__(self, other: Number) -> Truth:
        """Return where it can be, and must be, more."""
        low, high = ends(other)
        return Truth(self.upper > low, self.lower > high)

    def __ge__(self, other: Number) -> Truth:
        """Return where it can be, and must be, at least."""
        low, high = ends(other)
        return Truth(self.upper >= low, self.lower >= high)

    def __pow__(self, exponent: int) -> Any:
        """Enclose integer powers: even ones are squares, odd ones increase."""
        if not isinstance(exponent, int | np.integer) or exponent < 3:
            return power(self, exponent)
        if exponent % 2 == 0:
            return power(self, exponent // 2).square()
        low, high = (power(exact(end), exponent) for end in (self.lower, self.upper))
        return ordered(low.lower, high.upper)


class Truth:
    """What a comparison of intervals comes to, element by element; the rules of a task join them.

    Attributes:
        can: Whether it holds for some numbers of the intervals, or is not known to hold for none.
        must: Whether it holds for all of them.
    """

    __slots__ = ("can", "must")

    def __init__(self, can: Any, must: Any) -> None:
        """Pair the two, arrays that broadcast."""
        self.can: BoolArray = np.asarray(can, bool)
        self.must: BoolArray = np.asarray(must, bool)

    def __and__(self, other: Truth | bool) -> Truth:
        """Return where both hold."""
        can, must = _truth(other)
        return Truth(self.can & can, self.must & must)

    __rand__ = __and__

    def __or__(self, other: Truth | bool) -> Truth:
        """Return where at least one holds."""
        can, must = _truth(other)
        return Truth(self.can | can, self.must | must)

    __ror__ = __or__

    def where(self, yes: Number, no: Number) -> Interval:
        """Enclose the choice between two numbers."""
        (low, high), (other_low, other_high) = ends(yes), ends(no)
        lower = np.where(self.can, low, np.inf)
        upper = np.where(self.can, high, -np.inf)
        lower = np.where(self.must, lower, np.minimum(lower, other_low))
        return ordered(lower, np.where(self.must, upper, np.maximum(upper, other_high)))

    def __bool__(self) -> bool:
        """Refuse.

        Raises:
            TypeError: Always: intervals may do both.
        """
        raise TypeError("what intervals are compared by must not branch: use where, & and |")


def _truth(value: Truth | bool) -> tuple[Any, Any]:
    return (value.can, value.must) if isinstance(value, Truth) else (value, value)


# What an interval works with itself; duals and series of intervals answer in its place.
_PLAIN = (Interval, np.ndarray, float, int, np.number)


def exact(values: Any) -> Interval:
    """Return the intervals that hold one number each, shape (...)."""
    return _interval(np.asarray(values, float))


def ordered(lower: Any, upper: Any) -> Interval:
    """Pair ends that are ordered by construction: the check of the constructor is left out."""
    value = Interval.__new__(Interval)
    value.lower, value.upper = lower, upper
    return value


def ends(value: Number) -> tuple[Any, Any]:
    """Return lower and upper ends; a number is both."""
    return (value.lower, value.upper) if isinstance(value, Interval) else (value, value)


def _interval(value: Number) -> Interval:
    if isinstance(value, Interval):
        return value
    array = np.asarray(value, dtype=np.float64)
    return ordered(array, array)


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
    return ordered(np.maximum(least, -1.0), np.minimum(largest, 1.0))


def _meets(angle: Interval, place: float) -> BoolArray:
    """Return which intervals contain, or almost, place + 2 pi k for some integer k."""
    turn = 2.0 * math.pi
    number = np.ceil((angle.lower - _ANGLE_SLACK - place) / turn)
    found: BoolArray = place + turn * number <= angle.upper + _ANGLE_SLACK
    return found


def _monotone(low: Any, high: Any) -> Interval:
    """Enclose an increasing function that NumPy rounds well enough at both ends."""
    return ordered(
        _down(low - _RELATIVE_ERROR * np.abs(low)), _up(high + _RELATIVE_ERROR * np.abs(high))
    )


_UFUNCS: dict[Any, Any] = {
    np.less: lambda a, b: a < b,
    np.less_equal: lambda a, b: a <= b,
    np.greater: lambda a, b: a > b,
    np.greater_equal: lambda a, b: a >= b,
    np.add: lambda a, b: a + b,
    np.subtract: lambda a, b: a - b,
    np.multiply: lambda a, b: a * b,
    np.true_divide: lambda a, b: a / b,
    np.negative: lambda a: -a,
    np.square: Interval.square,
    np.absolute: abs,
    np.sin: Interval.sin,
    np.cos: Interval.cos,
    np.tan: Interval.tan,
    np.exp: Interval.exp,
    np.sqrt: Interval.sqrt,
}
