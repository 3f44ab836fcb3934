"""Dual numbers: forward-mode derivatives of a function written for scalars.

A `Dual` carries a value and its gradient along k seed directions. Passing duals through an equation
of motion gives its exact Jacobian, so that no derivative of the physics is written by hand.
"""

from __future__ import annotations

from typing import Any, Union

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers.functions import cos, exp, power, sin, sqrt, tan

Number = Union["Dual", FloatArray, float]


class Dual:
    """Values with gradients along k directions.

    Attributes:
        value: The values, shape (...), or one float.
        gradient: Their derivatives, shape (k, ...); of the shape of the values for one direction.
    """

    __slots__ = ("gradient", "value")
    # NumPy must leave `array * dual` to Dual.__rmul__ rather than build an object array.
    __array_ufunc__ = None

    def __init__(self, value: Any, gradient: Any) -> None:
        """Pair a value with its gradient."""
        self.value = value
        self.gradient = gradient

    def __add__(self, other: Number) -> Dual:
        """Sum rule."""
        if isinstance(other, Dual):
            return Dual(self.value + other.value, self.gradient + other.gradient)
        return Dual(self.value + other, self.gradient)

    __radd__ = __add__

    def __neg__(self) -> Dual:
        """Sign change."""
        return Dual(-self.value, -self.gradient)

    def __sub__(self, other: Number) -> Dual:
        """Difference rule."""
        if isinstance(other, Dual):
            return Dual(self.value - other.value, self.gradient - other.gradient)
        return Dual(self.value - other, self.gradient)

    def __rsub__(self, other: FloatArray | float) -> Dual:
        """Difference with a constant on the left."""
        return Dual(other - self.value, -self.gradient)

    def __mul__(self, other: Number) -> Dual:
        """Product rule."""
        if isinstance(other, Dual):
            gradient = self.gradient * other.value + other.gradient * self.value
            return Dual(self.value * other.value, gradient)
        return Dual(self.value * other, self.gradient * other)

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Dual:
        """Quotient rule."""
        if isinstance(other, Dual):
            quotient = self.value / other.value
            gradient = (self.gradient - other.gradient * quotient) / other.value
            return Dual(quotient, gradient)
        return Dual(self.value / other, self.gradient / other)

    def __rtruediv__(self, other: FloatArray | float) -> Dual:
        """Quotient of a constant by a dual."""
        quotient = other / self.value
        return Dual(quotient, -self.gradient * (quotient / self.value))

    def __pow__(self, exponent: int) -> Any:
        """Power rule, for integers."""
        return power(self, exponent)

    def __abs__(self) -> Dual:
        """Follow the sign; the derivative at zero is taken as zero."""
        return Dual(abs(self.value), self.gradient * _sign(self.value))

    def sin(self) -> Dual:
        """Chain rule of the sine."""
        return Dual(sin(self.value), self.gradient * cos(self.value))

    def cos(self) -> Dual:
        """Chain rule of the cosine."""
        return Dual(cos(self.value), self.gradient * -sin(self.value))

    def tan(self) -> Dual:
        """Chain rule of the tangent."""
        value = tan(self.value)
        return Dual(value, self.gradient * (1.0 + value * value))

    def exp(self) -> Dual:
        """Chain rule of the exponential."""
        value = exp(self.value)
        return Dual(value, self.gradient * value)

    def sqrt(self) -> Dual:
        """Chain rule of the square root."""
        value = sqrt(self.value)
        return Dual(value, self.gradient / (2.0 * value))


def _sign(value: Any) -> Any:
    own = getattr(value, "sign", None)
    return np.sign(value) if own is None else own()


def seed(arrays: list[FloatArray]) -> list[Dual]:
    """Turn k arrays of one shape into duals that differentiate by each of them.

    Args:
        arrays: k arrays, each of shape (...).

    Returns:
        k duals; the gradient of the i-th is the i-th unit vector, shape (k, ...).
    """
    count = len(arrays)
    duals = []
    for index, array in enumerate(arrays):
        gradient = np.zeros((count, *array.shape))
        gradient[index] = 1.0
        duals.append(Dual(array, gradient))
    return duals


def gradients(values: list[Number], count: int, shape: tuple[int, ...]) -> FloatArray:
    """Stack the gradients of results into a Jacobian.

    Args:
        values: n results; one that does not depend on the seeds may be a plain number.
        count: Number k of seeds.
        shape: Batch shape.

    Returns:
        Jacobian of shape (*shape, n, k).
    """
    jacobian = np.zeros((*shape, len(values), count))
    for row, value in enumerate(values):
        if isinstance(value, Dual):
            jacobian[..., row, :] = np.moveaxis(value.gradient, 0, -1)
    return jacobian
