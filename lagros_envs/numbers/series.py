"""Taylor series in one variable with interval coefficients: enclosures of higher derivatives.

A `Series` is a number type like `dual.Dual`: the equations of motion run on it, and duals of series
enclose the derivatives of a Jacobian.
"""

from __future__ import annotations

from typing import Any, Union

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers.dual import Dual
from lagros_envs.numbers.functions import power
from lagros_envs.numbers.interval import Interval, exact

Number = Union["Series", Dual, Interval, FloatArray, float]


class KinkError(ZeroDivisionError):
    """A derivative is asked for where there is none."""


class Series:
    """A function of one variable near a point or over an interval of it: f, f', f''/2, f'''/6 ...

    Attributes:
        parts: Enclosures of the k-th derivative over k!, from k = 0 to the order.
    """

    __slots__ = ("parts",)

    def __init__(self, parts: list[Interval]) -> None:
        """Store the coefficients."""
        self.parts = parts

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """Let NumPy's sine and cosine, and arrays on the left of an operator, work on series."""
        if method != "__call__" or options or ufunc not in _UFUNCS:
            return NotImplemented
        first = inputs[0] if isinstance(inputs[0], Series) else _constant(inputs[0], inputs[1])
        return _UFUNCS[ufunc](first, *inputs[1:])

    def derivative(self, order: int) -> Interval:
        """Enclose the derivative of an order that the series reaches."""
        factor = 1.0
        for number in range(2, order + 1):
            factor *= number
        return self.parts[order] * factor

    def differentiated(self) -> Series:
        """Return the series of the derivative, one order shorter."""
        return Series([part * float(k) for k, part in enumerate(self.parts) if k > 0])

    def __add__(self, other: Number) -> Series:
        """Add coefficient by coefficient."""
        if isinstance(other, Series):
            return Series([a + b for a, b in zip(self.parts, other.parts, strict=True)])
        if isinstance(other, Dual):
            return NotImplemented
        return Series([self.parts[0] + other, *self.parts[1:]])

    __radd__ = __add__

    def __neg__(self) -> Series:
        """Change the sign, exactly."""
        return Series([-part for part in self.parts])

    def __sub__(self, other: Number) -> Series:
        """Subtract coefficient by coefficient."""
        if isinstance(other, Series):
            return Series([a - b for a, b in zip(self.parts, other.parts, strict=True)])
        if isinstance(other, Dual):
            return NotImplemented
        return Series([self.parts[0] - other, *self.parts[1:]])

    def __rsub__(self, other: Interval | FloatArray | float) -> Series:
        """Subtract from a constant."""
        return -self + other

    def __mul__(self, other: Number) -> Series:
        """Multiply by the Cauchy product."""
        if isinstance(other, Series):
            return Series([_cross(self.parts, other.parts, k) for k in range(len(self.parts))])
        if isinstance(other, Dual):
            return NotImplemented
        return Series([part * other for part in self.parts])

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Series:
        """Divide, coefficient after coefficient."""
        if isinstance(other, Dual):
            return NotImplemented
        if not isinstance(other, Series):
            return Series([part / other for part in self.parts])
        quotient: list[Interval] = []
        for k, part in enumerate(self.parts):
            known = part
            for j in range(k):
                known = known - quotient[j] * other.parts[k - j]
            quotient.append(known / other.parts[0])
        return Series(quotient)

    def __rtruediv__(self, other: Interval | FloatArray | float) -> Series:
        """Divide a constant."""
        return _constant(other, self) / self

    def __pow__(self, exponent: int) -> Any:
        """Raise to an integer power."""
        return power(self, exponent)

    def sign(self) -> FloatArray:
        """Return the sign, which does not change.

        Raises:
            KinkError: The function may be zero, where its absolute value has no derivative.
        """
        sign = self.parts[0].sign()
        if np.any(sign.lower * sign.upper <= 0.0):
            raise KinkError("abs of a series around zero has no derivative: use smaller intervals")
        return sign.lower

    def __abs__(self) -> Series:
        """Return the series itself or its negative; see `sign`."""
        sign = self.sign()
        return Series([part * sign for part in self.parts])

    def sin(self) -> Series:
        """Return the sine."""
        return _waves(self)[0]

    def cos(self) -> Series:
        """Return the cosine."""
        return _waves(self)[1]

    def tan(self) -> Series:
        """Return the tangent."""
        sine, cosine = _waves(self)
        return sine / cosine

    def exp(self) -> Series:
        """Return the exponential, from e' = a' e."""
        slopes, values = self.differentiated().parts, [self.parts[0].exp()]
        for k in range(1, len(self.parts)):
            values.append(_cross(slopes, values, k - 1) / float(k))
        return Series(values)

    def sqrt(self) -> Series:
        """Return the square root, from s s = a."""
        roots = [self.parts[0].sqrt()]
        for k in range(1, len(self.parts)):
            known = self.parts[k]
            for j in range(1, k):
                known = known - roots[j] * roots[k - j]
            roots.append(known / (roots[0] * 2.0))
        return Series(roots)


def variable(place: Interval, order: int) -> Series:
    """Return the variable itself, near points or over intervals, up to an order of at least 1."""
    zero = exact(np.zeros(place.shape))
    return Series([place, zero + 1.0, *[zero] * (order - 1)])


def _waves(angle: Series) -> tuple[Series, Series]:
    """Return sine and cosine from sin' = angle' cos and cos' = -angle' sin."""
    sines, cosines = [angle.parts[0].sin()], [angle.parts[0].cos()]
    slopes = angle.differentiated().parts
    for k in range(1, len(angle.parts)):
        sines.append(_cross(slopes, cosines, k - 1) / float(k))
        cosines.append(-_cross(slopes, sines, k - 1) / float(k))
    return Series(sines), Series(cosines)


def _cross(left: list[Interval], right: list[Interval], order: int) -> Interval:
    """Return the coefficient of that order of a product."""
    total = left[0] * right[order]
    for j in range(1, order + 1):
        total = total + left[j] * right[order - j]
    return total


def _constant(value: Any, like: Series) -> Series:
    """Return a constant as a series of the order of another."""
    first = value if isinstance(value, Interval) else exact(value)
    return Series([first, *[exact(np.zeros(first.shape))] * (len(like.parts) - 1)])


_UFUNCS: dict[Any, Any] = {
    np.add: lambda a, b: a + b,
    np.subtract: lambda a, b: a - b,
    np.multiply: lambda a, b: a * b,
    np.true_divide: lambda a, b: a / b,
    np.negative: lambda a: -a,
    np.absolute: abs,
    np.sin: Series.sin,
    np.cos: Series.cos,
    np.tan: Series.tan,
    np.exp: Series.exp,
    np.sqrt: Series.sqrt,
}
