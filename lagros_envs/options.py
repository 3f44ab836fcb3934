"""What users hand over from call to call: the options of `reset`, and actions.

Everything is checked before anything is assigned, so that a refused call leaves an environment as
it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import LARGEST, shown, suggestion

# Axes of any option.
_DEEPEST = 4


def known_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of a reset as a dictionary of its own.

    Args:
        options: As given to reset; None for none.
        known: The names that the environment knows.

    Raises:
        ValueError: They are no mapping, or hold a name that is not known.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(
            f"options={shown(options)} must be a dictionary or None; its entries may be "
            f"{', '.join(known)}"
        )
    for name in options:
        if name not in known:
            raise ValueError(
                f"options has no entry {shown(name)}; its entries may be {', '.join(known)}."
                f"{suggestion(name, known)}"
            )
    return dict(options)


def real_numbers(value: Any) -> FloatArray | None:
    """Return a copy in double precision of what is made of real numbers, or None.

    Text, dates, truth values, complex numbers, objects, masked arrays and nested lists of different
    lengths are not.
    """
    if isinstance(value, np.ma.MaskedArray):
        return None
    # Among numbers in a list NumPy takes True for 1.
    if isinstance(value, list | tuple) and _holds_flags(value):
        return None
    try:
        array = np.asarray(value)
    # Whatever the object raises that says how to turn it into an array.
    except Exception:
        return None
    if array.dtype.kind not in "fiu":
        return None
    with np.errstate(over="ignore"):
        return array.astype(np.float64)


def _holds_flags(values: Sequence[Any]) -> bool:
    """Return whether True or False is in lists, however deep; no deeper than any array."""
    left: list[tuple[Any, int]] = [(values, 0)]
    while left:
        one, depth = left.pop()
        if isinstance(one, bool | np.bool_):
            return True
        if isinstance(one, list | tuple) and depth < _DEEPEST:
            left += [(part, depth + 1) for part in one]
    return False


def option_numbers(
    name: str,
    value: Any,
    *shapes: tuple[int, ...],
    looked_at: BoolArray | None = None,
    meaning: str = "",
) -> FloatArray:
    """Return a copy of an option in double precision.

    Args:
        name: Of the option.
        value: Of the option.
        shapes: It must have one of them.
        looked_at: Which of the first axis count; all of them if left out.
        meaning: What it is, for the message.

    Raises:
        ValueError: It is not made of numbers of the shape that are finite and of a size that an
            observation can hold.
    """
    wanted = " or ".join(map(str, shapes)) + (meaning and f", {meaning}")
    numbers = real_numbers(value)
    if numbers is None:
        raise ValueError(
            f"options[{name!r}]={shown(value)} must be finite numbers of shape {wanted}"
        )
    if numbers.shape not in shapes:
        raise ValueError(
            f"options[{name!r}] has shape {numbers.shape}; it must be finite and of shape {wanted}"
        )
    counted = numbers if looked_at is None else numbers[looked_at]
    # A comparison with nan is false.
    wrong = ~(np.abs(counted) <= LARGEST)
    if wrong.any():
        raise ValueError(
            f"options[{name!r}] holds {counted[wrong][0]:g}; it must be finite, and no number "
            f"beyond +-{LARGEST:g}"
        )
    return numbers


def nominal_option(
    options: dict[str, Any],
    shape: tuple[int, ...],
    meaning: str,
    looked_at: BoolArray | None = None,
) -> FloatArray | None:
    """Return a copy of the option `nominal`, x_d at every control instant, if there is one.

    Args:
        options: As given to reset.
        shape: That it must have.
        meaning: What it is, for the message.
        looked_at: Which of the first axis have to be finite; all of them if left out.

    Raises:
        ValueError: The trajectory has the wrong shape, or numbers that are not finite or too large.
    """
    value = options.get("nominal")
    if value is None:
        return None
    meaning = f"{meaning} at every control instant"
    return option_numbers("nominal", value, shape, looked_at=looked_at, meaning=meaning)


def checked_actions(actions: Any, shape: tuple[int, ...], meaning: str) -> FloatArray:
    """Return what was passed to `step` as numbers in double precision.

    Args:
        actions: What was passed.
        shape: That it must have; where it has two axes, the first one counts rows.
        meaning: What the numbers of the last axis are, for the message.

    Returns:
        An array of its own, of that shape.

    Raises:
        ValueError: It is not made of numbers, has another shape, or is not finite.
    """
    values = real_numbers(actions)
    if values is None or values.shape != shape:
        found = f"is {shown(actions)}" if values is None else f"has shape {values.shape}"
        raise ValueError(f"the action {found}; it must be numbers of shape {shape}, {meaning}")
    finite = np.isfinite(values)
    # Counting is several times faster than `all`.
    if np.count_nonzero(finite) < finite.size:
        rows = np.unique(np.nonzero(~finite)[0]).tolist()
        where = f" in the rows {rows}" if values.ndim > 1 else ""
        raise ValueError(f"the action is not finite{where}: {values[~finite][0]}")
    return values
