"""Taylor models: polynomials of several variables in [-1, 1], each with a bound of what they leave.

A `TaylorModel` is a number type like any other: an equation of motion that runs on it gives a
polynomial in the variables and a rest that encloses everything else, what is cut off and what
floats round alike (Makino and Berz, 2003). Where intervals forget that two numbers depend on one
variable, these remember it up to the degree of the polynomial.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any, Union

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers.functions import power

Number = Union["TaylorModel", FloatArray, float]

# Of the polynomials.
DEGREE = 3
# A product sums up to 2^9 products of floats, each rounded by 2^-53; what is subtracted to find
# what is cut off errs by as much. Relative to the sums of the absolute coefficients.
_PRODUCT_ERROR = 2.0**-42
# One operation on coefficients, and the same operation on floats: what a simulation rounds is
# enclosed as well, also where a compiler fuses two operations.
_ROUNDING = 2.0**-50
# Bounds are sums of a few hundred positive floats.
_WIDER = 1.0 + 2.0**-42
# NumPy's elementary functions, relative to a number of at most that size.
_FUNCTION_ERROR = 2e-15


@lru_cache(maxsize=64)
def monomials(variables: int, lone: int, pushes: int) -> Monomials:
    """Return the monomials of so many variables; see `Monomials`."""
    return Monomials(variables, lone, pushes)


class Monomials:
    """Which powers a Taylor model keeps, and which products of them.

    Kept are the monomials of the variables up to a degree; lone variables, on which a system
    depends linearly, alone; and pushes, alone and times one variable.

    Args:
        variables: Number of variables.
        lone: Number of lone variables.
        pushes: Number of pushes.

    Attributes:
        exponents: Of variables, lone variables and pushes in each monomial, shape (count, ...).
        count: Number of monomials; the first is the constant.
        first: Where variables, lone variables and pushes stand alone, one slice each.
        starts: Where each kind of monomial begins: by degree, then lone, pushes, products.
    """

    def __init__(self, variables: int, lone: int, pushes: int) -> None:
        """List the monomials and their products."""
        total = variables + lone + pushes
        self.variables = variables
        rows: list[tuple[int, ...]] = []
        starts = []
        for order in range(DEGREE + 1):
            starts.append(len(rows))
            rows += itertools.combinations_with_replacement(range(variables), order)
        starts.append(len(rows))
        rows += [(index,) for index in range(variables, variables + lone)]
        starts.append(len(rows))
        rows += [(index,) for index in range(variables + lone, total)]
        starts.append(len(rows))
        rows += [(v, d) for d in range(variables + lone, total) for v in range(variables)]
        # An empty kind has no place where it begins.
        ends = [*starts[1:], len(rows)]
        self.kinds = [
            (kind, begin)
            for kind, (begin, end) in enumerate(zip(starts, ends, strict=True))
            if end > begin
        ]
        self.count = len(rows)
        self.members = rows
        lone_at, push_at, pair_at = starts[DEGREE + 1 :]
        self.first = slice(1, 1 + variables), slice(lone_at, push_at), slice(push_at, pair_at)
        self.mixed = slice(pair_at, self.count)
        self._degrees = [slice(*ends) for ends in itertools.pairwise(starts[: DEGREE + 2])]
        self.starts = np.array([begin for _, begin in self.kinds])
        self.exponents = np.zeros((self.count, total), dtype=np.int64)
        for place, row in enumerate(rows):
            for index in row:
                self.exponents[place, index] += 1
        self._index_products(rows)

    def _index_products(self, rows: list[tuple[int, ...]]) -> None:
        places = {row: place for place, row in enumerate(rows)}
        found = []
        for (i, one), (j, two) in itertools.product(enumerate(rows), enumerate(rows)):
            place = places.get(tuple(sorted((*one, *two))))
            if place is not None:
                found.append((place, i, j))
        found.sort()
        table = np.array(found)
        # Layer by layer: the first product of every monomial, the second of those that have one.
        counts = np.bincount(table[:, 0], minlength=self.count)
        rank = np.arange(len(table)) - np.searchsorted(table[:, 0], table[:, 0])
        order = np.argsort(-counts, kind="stable")
        self.place = np.argsort(order)
        table = table[np.lexsort((self.place[table[:, 0]], rank))]
        self.left, self.right = table[:, 1].copy(), table[:, 2].copy()
        ends = np.cumsum(np.bincount(rank))
        self.layers = [slice(*pair) for pair in itertools.pairwise([0, *ends.tolist()])]
        factors = [math.prod(map(math.factorial, row)) for row in self.exponents.tolist()]
        totals = [math.factorial(sum(row)) for row in self.exponents.tolist()]
        weights = np.array(factors) / np.array(totals)
        weights[self.mixed] = 1.0
        self.weights = np.zeros((len(self.starts), self.count))
        self.weights[
            np.searchsorted(self.starts, range(self.count), side="right") - 1, range(self.count)
        ] = weights
        alone = [place for place, (kind, _) in enumerate(self.kinds) if kind == DEGREE + 1]
        self.lone_kind = alone[0] if alone else None

    def of_degree(self, degree: int) -> slice:
        """Return where the monomials of the variables of a degree are."""
        return self._degrees[degree]

    @cached_property
    def cuts(self) -> FloatArray:
        """Which products of two kinds are cut off, as a whole: ones in a matrix of zeros."""
        cut = np.ones((len(self.kinds),) * 2)
        for one, two in zip(self.left, self.right, strict=True):
            cut[self._kind(one), self._kind(two)] = 0.0
        return cut

    def _kind(self, place: int) -> int:
        return int(np.searchsorted(self.starts, place, side="right")) - 1


class TaylorModel:
    """Arrays of functions of the variables: polynomials, each plus or minus a rest.

    Attributes:
        monomials: Of the polynomials.
        parts: Coefficients, shape (count, ...).
        rest: Bound of the distance from the polynomial, for all variables in [-1, 1], shape (...);
            inf where nothing is known.
    """

    __slots__ = ("_norms", "_size", "monomials", "parts", "rest")
    # NumPy must leave `array * model` to TaylorModel.__rmul__.
    __array_ufunc__ = None

    def __init__(
        self, monomials: Monomials, parts: FloatArray, rest: Any, size: Any = None
    ) -> None:
        """Store polynomial and rest."""
        self.monomials, self.parts, self.rest = monomials, parts, rest
        self._size = size
        self._norms: Any = None

    @property
    def size(self) -> FloatArray:
        """A bound of the sum of the absolute coefficients, shape (...)."""
        if self._size is None:
            self._size = np.abs(self.parts).sum(axis=0) * _WIDER
        size: FloatArray = self._size
        return size

    @property
    def norms(self) -> FloatArray:
        """Bounds of each kind of monomials over the domain, shape (kinds, ...)."""
        if self._norms is None:
            kept = self.monomials
            norms = np.sqrt(_combined(kept.weights, self.parts * self.parts))
            if kept.lone_kind is not None:
                norms[kept.lone_kind] = np.abs(self.parts[kept.first[1]]).sum(axis=0)
            self._norms = norms * _WIDER + 1e-150
        found: FloatArray = self._norms
        return found

    @property
    def constant(self) -> FloatArray:
        """The value at zero, shape (...)."""
        value: FloatArray = self.parts[0]
        return value

    @property
    def reach(self) -> FloatArray:
        """A bound of the distance from the value at zero, shape (...)."""
        moving: FloatArray = (self.norms[1:].sum(axis=0) + self.rest) * _WIDER
        return moving

    def __add__(self, other: Number) -> TaylorModel:
        """Add polynomials and rests."""
        if isinstance(other, TaylorModel):
            size = self.size + other.size
            rest = (self.rest + other.rest + _ROUNDING * size) * _WIDER
            return TaylorModel(self.monomials, self.parts + other.parts, rest, size)
        return self._moved(self.parts, other)

    __radd__ = __add__

    def __neg__(self) -> TaylorModel:
        """Change the sign, exactly."""
        return TaylorModel(self.monomials, -self.parts, self.rest, self._size)

    def __sub__(self, other: Number) -> TaylorModel:
        """Subtract polynomials and add rests."""
        if isinstance(other, TaylorModel):
            size = self.size + other.size
            rest = (self.rest + other.rest + _ROUNDING * size) * _WIDER
            return TaylorModel(self.monomials, self.parts - other.parts, rest, size)
        return self._moved(self.parts, -other)

    def __rsub__(self, other: FloatArray | float) -> TaylorModel:
        """Subtract from a constant."""
        return self._moved(-self.parts, other)

    def __mul__(self, other: Number) -> TaylorModel:
        """Multiply polynomials; what exceeds the degree goes to the rest."""
        if not isinstance(other, TaylorModel):
            factor = np.abs(other)
            size = self.size * factor
            rest = (self.rest * factor + _ROUNDING * size) * _WIDER
            return TaylorModel(self.monomials, self.parts * other, rest, size)
        kept, one, two = self.monomials, self, other
        products = one.parts.take(kept.left, axis=0)
        products *= two.parts.take(kept.right, axis=0)
        total = products[kept.layers[0]]
        for layer in kept.layers[1:]:
            total[: layer.stop - layer.start] += products[layer]
        parts = total.take(kept.place, axis=0)
        sizes, others = one.norms, two.norms
        cut = (sizes * _combined(kept.cuts, others)).sum(axis=0)
        first, second = sizes.sum(axis=0), others.sum(axis=0)
        rest = one.rest * (second + two.rest) + first * two.rest
        rest = (rest + cut + _PRODUCT_ERROR * (one.size * two.size)) * _WIDER
        return TaylorModel(kept, parts, rest)

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> TaylorModel:
        """Multiply by the reciprocal."""
        if isinstance(other, TaylorModel):
            return self * other.reciprocal()
        return self * (1.0 / np.asarray(other, float))

    def __rtruediv__(self, other: FloatArray | float) -> TaylorModel:
        """Multiply the reciprocal by a constant."""
        return self.reciprocal() * other

    def __pow__(self, exponent: int) -> Any:
        """Multiply repeatedly."""
        return power(self, exponent)

    def __abs__(self) -> TaylorModel:
        """Return the model or its negative; around zero, a constant and a rest."""
        value, reach = self.constant, self.reach
        clear = np.abs(value) > reach
        parts = self.parts * np.where(clear, np.sign(value), 0.0)
        half = 0.5 * (np.abs(value) + reach) * _WIDER
        parts[0] += np.where(clear, 0.0, half)
        return TaylorModel(self.monomials, parts, np.where(clear, self.rest, half * _WIDER))

    def sin(self) -> TaylorModel:
        """Return the sines of angles [rad]."""
        sine, cosine = np.sin(self.constant), np.cos(self.constant)
        return self._composed((sine, cosine, -sine, -cosine), 1.0, 1.0)

    def cos(self) -> TaylorModel:
        """Return the cosines of angles [rad]."""
        sine, cosine = np.sin(self.constant), np.cos(self.constant)
        return self._composed((cosine, -sine, -cosine, sine), 1.0, 1.0)

    def tan(self) -> TaylorModel:
        """Return the tangents of angles [rad]; nothing is known where there may be a pole."""
        return self.sin() * self.cos().reciprocal()

    def exp(self) -> TaylorModel:
        """Return the exponentials."""
        value = np.exp(self.constant)
        return self._composed((value,) * 4, value * np.exp(self.reach), value)

    def sqrt(self) -> TaylorModel:
        """Return the square roots; nothing is known where a number may not be positive."""
        value = np.where(self.constant > 0.0, self.constant, 1.0)
        least = np.where(self.constant > 0.0, (self.constant - self.reach) / _WIDER, 0.0)
        positive = least > 0.0
        low = np.where(positive, least, 1.0)
        root = np.sqrt(value)
        slopes = [root]
        for order in range(3):
            slopes.append(slopes[-1] * ((0.5 - order) / value))
        fourth = np.where(positive, 0.9375 / (low**3 * np.sqrt(low)), np.inf)
        return self._composed(tuple(slopes), fourth, root)

    def reciprocal(self) -> TaylorModel:
        """Return one divided by the numbers; nothing is known where one may be zero."""
        size = np.abs(self.constant)
        least = (size - self.reach) / _WIDER
        clear = least > 0.0
        value = 1.0 / np.where(size > 0.0, self.constant, 1.0)
        slopes = [value]
        for order in range(3):
            slopes.append(slopes[-1] * (-(order + 1.0) * value))
        fourth = np.where(clear, 24.0 / np.where(clear, least, 1.0) ** 5, np.inf)
        return self._composed(tuple(slopes), fourth, np.abs(value))

    def _composed(self, slopes: Sequence[FloatArray], fourth: Any, size: Any) -> TaylorModel:
        """Return f of the model, from f, f', f'', f''' at the constant and a bound of f''''.

        f(c + h) is the cubic in h, by Horner's rule, and at most |h|^4 / 24 times the bound.
        """
        offset = self.parts.copy()
        offset[0] = 0.0
        h = TaylorModel(self.monomials, offset, self.rest)
        value = h * (slopes[3] * (1.0 / 6.0)) + slopes[2] * 0.5
        value = h * value + slopes[1]
        value = h * value + slopes[0]
        reach = h.reach
        largest = sum(np.abs(slope) * reach**order for order, slope in enumerate(slopes))
        error = reach**4 * fourth / 24.0 + _FUNCTION_ERROR * (largest + size)
        rest = (value.rest + error) * _WIDER
        return TaylorModel(self.monomials, value.parts, np.where(rest < np.inf, rest, np.inf))

    def _moved(self, parts: FloatArray, constant: FloatArray | float) -> TaylorModel:
        """Return parts of this size with a constant added."""
        moved = parts.copy() if parts is self.parts else parts
        moved[0] = moved[0] + constant
        size = self.size + np.abs(constant)
        rest = (self.rest + _ROUNDING * size) * _WIDER
        return TaylorModel(self.monomials, moved, rest, size)


def _combined(matrix: FloatArray, rows: FloatArray) -> FloatArray:
    """Return sums of rows (k, ...) by the weights of a matrix (j, k), shape (j, ...)."""
    flat = rows.reshape(len(rows), -1)
    return (matrix @ flat).reshape(-1, *rows.shape[1:])
