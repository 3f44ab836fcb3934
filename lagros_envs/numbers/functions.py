"""The elementary functions of every kind of number: what an equation of motion may call."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def sin(x: Any) -> Any:
    """Return the sine of an angle [rad]."""
    return _of("sin", x)


def cos(x: Any) -> Any:
    """Return the cosine of an angle [rad]."""
    return _of("cos", x)


def tan(x: Any) -> Any:
    """Return the tangent of an angle [rad]."""
    return _of("tan", x)


def exp(x: Any) -> Any:
    """Return e to the power of a number."""
    return _of("exp", x)


def sqrt(x: Any) -> Any:
    """Return the square root of a number that is not negative."""
    return _of("sqrt", x)


def where(condition: Any, yes: Any, no: Any) -> Any:
    """Return one number where a comparison holds, another elsewhere; for rules, not for physics."""
    if isinstance(condition, bool):
        return yes if condition else no
    own = getattr(condition, "where", None)
    return np.where(condition, yes, no) if own is None else own(yes, no)


def minimum(x: Any, limit: Any) -> Any:
    """Return the smaller of a number and a limit; NaN stays NaN. For features, not for physics."""
    if isinstance(x, np.ndarray) or isinstance(limit, np.ndarray):
        return np.minimum(x, limit)
    return where(x > limit, limit, x)


def maximum(x: Any, limit: Any) -> Any:
    """Return the larger of a number and a limit; NaN stays NaN. For features, not for physics."""
    if isinstance(x, np.ndarray) or isinstance(limit, np.ndarray):
        return np.maximum(x, limit)
    return where(x <= limit, limit, x)


def _of(name: str, x: Any) -> Any:
    if isinstance(x, float | int):
        # `math` is ten times faster than NumPy on one number.
        return getattr(math, name)(x)
    own = getattr(x, name, None)
    return getattr(np, name)(x) if own is None else own()


def power(base: Any, exponent: Any) -> Any:
    """Return base ** exponent by products alone, for kinds of number that have nothing faster.

    Args:
        base: A number of any kind.
        exponent: An integer; a negative one divides.

    Returns:
        The power; the float 1.0 for the exponent zero.

    Raises:
        TypeError: The exponent is not an integer.
    """
    if isinstance(exponent, float) and exponent.is_integer():
        exponent = int(exponent)
    if isinstance(exponent, bool) or not isinstance(exponent, int | np.integer):
        raise TypeError(
            f"the exponent {exponent!r} is not an integer: an equation of motion takes integer "
            "powers; write a root as functions.sqrt"
        )
    if exponent < 0:
        return 1.0 / power(base, -exponent)
    result: Any = None
    while exponent:
        if exponent & 1:
            result = base if result is None else result * base
        exponent >>= 1
        if exponent:
            base = base * base
    return 1.0 if result is None else result
