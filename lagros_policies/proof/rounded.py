"""Sums and products of many numbers in floats, with what rounding can make of them.

A sum of n products in floats differs from the exact one by no more than n u / (1 - n u) times the
sum of their sizes, in whatever order it is taken, u = 2^-53 (Higham, "Accuracy and Stability of
Numerical Algorithms", 2002, eq. 3.5). That is many times faster than to round every operation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import Interval
from lagros_envs.numbers.interval import ordered

# Of a bound that is itself a sum of up to some thousand rounded terms; and of what underflows.
ABOVE, TINY = 2.0**-40, 1e-290
_MOST = 4000


def product_error(terms: int) -> float:
    """Return the share of sum |a_i b_i| by which a computed sum of so many products may err.

    Raises:
        ValueError: They are too many for `above`.
    """
    if terms > _MOST:
        raise ValueError(f"terms={terms} must be {_MOST} at most: layers of a network are no wider")
    return (terms + 4) * 2.0**-52


def above(value: Any) -> Any:
    """Return a bound above a number that was computed of sizes: sums, products, maxima of them."""
    return value + (np.abs(value) * ABOVE + TINY)


def linear(values: Interval, matrix: FloatArray, offset: FloatArray | float = 0.0) -> Interval:
    """Enclose values @ matrix + offset for intervals (..., i) and numbers (i, j), (j,)."""
    middle = values.midpoint
    centre = middle @ matrix + offset
    share = product_error(len(matrix))
    # One product bounds both: how far the values go, and what rounding does to the sum.
    radius = (values.radius + share * np.abs(middle)) @ np.abs(matrix)
    radius = above(radius + share * np.abs(offset))
    return ordered(centre - radius, centre + radius)


def within(value: Interval, other: Interval) -> Interval:
    """Return what two enclosures of the same numbers have in common."""
    low, high = np.maximum(value.lower, other.lower), np.minimum(value.upper, other.upper)
    return ordered(low, np.maximum(low, high))


def symmetric(size: FloatArray) -> Interval:
    """Return the intervals [-size, size]."""
    return ordered(-size, size)
