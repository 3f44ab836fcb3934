"""The ranges that numbers must lie in, each with the one message that names a number outside it."""

from __future__ import annotations

import math
from collections.abc import Sequence


def check_positive(name: str, value: float, otherwise: str = "") -> None:
    """Check a number that must be finite and above zero.

    Args:
        name: What the caller calls it.
        value: The number.
        otherwise: What else may be given, such as "or None for no limit".

    Raises:
        ValueError: It is zero, negative, infinite or NaN.
    """
    _check(math.isfinite(value) and value > 0.0, name, value, "finite and > 0", otherwise)


def check_not_negative(name: str, value: float, otherwise: str = "") -> None:
    """Check a number that must be finite and may be zero; arguments as in `check_positive`.

    Raises:
        ValueError: It is negative, infinite or NaN.
    """
    _check(math.isfinite(value) and value >= 0.0, name, value, "finite and >= 0", otherwise)


def check_at_least(name: str, value: float, least: float, otherwise: str = "") -> None:
    """Check a number against the least that it may be; the rest as in `check_positive`.

    Raises:
        ValueError: It is less than `least`, or NaN.
    """
    _check(value >= least, name, value, f"at least {least}", otherwise)


def check_above(name: str, value: float, bound: float, otherwise: str = "") -> None:
    """Check a number that must exceed another and may be infinite; the rest as in `check_positive`.

    Raises:
        ValueError: It is `bound` or less, or NaN.
    """
    _check(value > bound, name, value, f"> {bound}", otherwise)


def check_each(name: str, values: Sequence[float], least: float) -> None:
    """Check numbers, of which there must be one or more, against the least that each may be.

    Args:
        name: What the caller calls them.
        values: The numbers.
        least: The least that each may be.

    Raises:
        ValueError: There is none, or one is less than `least` or NaN.
    """
    holds = len(values) > 0 and all(value >= least for value in values)
    _check(holds, name, values, f"one number or more, each at least {least}")


def check_multiple(
    name: str, value: float, unit_name: str, unit: float, tolerance: float = 1e-9
) -> None:
    """Check a number that must be a whole number of another.

    Args:
        name: What the caller calls it.
        value: The number.
        unit_name: What the caller calls the other.
        unit: The other, above zero.
        tolerance: How far from whole their ratio may be.

    Raises:
        ValueError: Their ratio is further from whole.
    """
    ratio = value / unit
    whole = abs(ratio - round(ratio)) <= tolerance
    _check(whole, name, value, f"a whole number of {unit_name}={unit!r}")


def check_whole(name: str, value: float, least: int = 1) -> None:
    """Check a number that counts something.

    Args:
        name: What the caller calls it.
        value: The number; 2.0 counts as whole.
        least: The least that it may be.

    Raises:
        ValueError: It is less than `least`, has a fraction, is infinite or NaN.
    """
    whole = math.isfinite(value) and value == int(value) and value >= least
    _check(whole, name, value, f"a whole number >= {least}")


def check_seed(seed: int) -> None:
    """Check a seed.

    Raises:
        ValueError: It is negative.
    """
    _check(seed >= 0, "seed", seed, "a non-negative integer")


def _check(holds: bool, name: str, value: object, needed: str, otherwise: str = "") -> None:
    if not holds:
        raise ValueError(f"{name}={value!r} must be {needed}{otherwise and ', ' + otherwise}")
