"""What settings may be, each with the one message that names a value that is not.

A number is what Python and NumPy call a real number. True, None, text and arrays are none, and
neither is an integer that no double reaches.
"""

from __future__ import annotations

import difflib
import math
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeGuard, Union, get_args, get_origin, get_type_hints

from lagros_envs.values import use_plain_numbers

# Control steps of an episode, whose states are kept.
MOST_STEPS = 1_000_000
# Of d_bar: under a thousandth of it nothing flies, and squares of the states stay numbers.
MOST_BOUND = 1e6
# As much as NumPy recommends as the entropy of a seed.
MOST_SEEDS = 1 << 128
# Of a coordinate, a size, a rate or a weight: observations hold it in single precision, and no
# distance comes near what counts as diverged.
LARGEST = 1e9
# Letters of a value in a message; a longer one is cut.
_SHOWN = 80


def check_positive(name: str, value: float, otherwise: str = "") -> None:
    """Check a number that must be finite and above zero.

    Args:
        name: What the caller calls it.
        value: The number.
        otherwise: What else may be given, such as "or None for no limit".

    Raises:
        ValueError: It is no number, or zero, negative, infinite or NaN.
    """
    holds = is_finite(value) and value > 0.0
    _check(holds, name, value, "finite and > 0", otherwise)


def check_not_negative(name: str, value: float, otherwise: str = "") -> None:
    """Check a number that must be finite and may be zero; arguments as in `check_positive`.

    Raises:
        ValueError: It is no number, or negative, infinite or NaN.
    """
    holds = is_finite(value) and value >= 0.0
    _check(holds, name, value, "finite and >= 0", otherwise)


def check_disturbance_bound(name: str, value: float, otherwise: str = "") -> None:
    """Check d_bar of a disturbance [units of the state per second]; the rest as `check_positive`.

    Raises:
        ValueError: It is no number, negative, NaN, or so large that no flight stays a number.
    """
    holds = is_number(value) and 0.0 <= value <= MOST_BOUND
    _check(holds, name, value, f"finite and >= 0, at most {MOST_BOUND:g}", otherwise)


def check_at_least(name: str, value: float, least: float, otherwise: str = "") -> None:
    """Check a number against the least that it may be; the rest as in `check_positive`.

    Raises:
        ValueError: It is no number, less than `least`, or NaN.
    """
    _check(is_number(value) and value >= least, name, value, f"at least {least}", otherwise)


def check_above(name: str, value: float, bound: float, otherwise: str = "") -> None:
    """Check a number that must exceed another and may be infinite; the rest as in `check_positive`.

    Raises:
        ValueError: It is no number, `bound` or less, or NaN.
    """
    _check(is_number(value) and value > bound, name, value, f"> {bound}", otherwise)


def check_at_most(name: str, value: float, most: float, otherwise: str = "") -> None:
    """Check a number against the most that it may be; the rest as in `check_positive`.

    Raises:
        ValueError: It is no number, more than `most`, or NaN.
    """
    _check(is_number(value) and value <= most, name, value, f"at most {most:g}", otherwise)


def check_constants(system: Any) -> None:
    """Check the constants of a body while it is built: positive, and with bounded inverses.

    Args:
        system: An instance of a frozen dataclass of numbers; NumPy's become Python's.

    Raises:
        ValueError: A constant is none of these; the message names it.
    """
    check_fields(system)
    use_plain_numbers(system)
    for item in fields(system):
        value = getattr(system, item.name)
        check_positive(item.name, value)
        # Less, and what is divided by it has no bound.
        check_at_least(item.name, value, 1.0 / LARGEST)
        check_at_most(item.name, value, LARGEST)


def check_fields(
    settings: Any,
    positive: Iterable[str] = (),
    not_negative: Iterable[str] = (),
    least: Mapping[str, int] | None = None,
) -> None:
    """Check every field of a dataclass against its annotation, then the ranges of those named.

    Numbers must be finite, integers whole, flags true or false, and so on through optional fields,
    tuples and literals; what is annotated otherwise (arrays, functions, mappings) is not looked at.

    Args:
        settings: An instance of a dataclass.
        positive: Names of numbers above zero.
        not_negative: Names of numbers that may be zero.
        least: By name, the least that a whole number may be.

    Raises:
        ValueError: A field has a value of another type, or a number that is not finite or out of
            range.
    """
    for name, hint in _hints(type(settings)).items():  # type: ignore[arg-type]
        value = getattr(settings, name)
        needed = _unmet(value, hint)
        _check(not needed, name, value, needed)
    for name in positive:
        check_positive(name, getattr(settings, name))
    for name in not_negative:
        check_not_negative(name, getattr(settings, name))
    for name, fewest in (least or {}).items():
        check_whole(name, getattr(settings, name), fewest)


def check_each(name: str, values: Sequence[int], least: int, most: int | None = None) -> None:
    """Check numbers that count something, of which there must be one or more.

    Args:
        name: What the caller calls them.
        values: The numbers.
        least: The least that each may be.
        most: The most; None for no limit.

    Raises:
        ValueError: There is none, or one is no integer or out of range.
    """
    needed = f"one whole number or more, each at least {least}"
    needed += "" if most is None else f" and at most {most}"
    check_several(name, values, needed)
    holds = all(is_whole(one) and one >= least for one in values)
    _check(holds and (most is None or max(values) <= most), name, values, needed)


def check_several(name: str, values: Sequence[Any], needed: str) -> None:
    """Check that there is a list or tuple with something in it.

    Args:
        name: What the caller calls it.
        values: The list; text is none, although Python counts its letters.
        needed: What it must be, for the message.

    Raises:
        ValueError: It is empty, or no list.
    """
    _check(isinstance(values, list | tuple) and len(values) > 0, name, values, needed)


def check_multiple(
    name: str,
    value: float,
    unit_name: str,
    unit: float,
    tolerance: float = 1e-9,
    most: int = MOST_STEPS,
) -> None:
    """Check a number that must be another, a whole number of times.

    Args:
        name: What the caller calls it.
        value: The number.
        unit_name: What the caller calls the other.
        unit: The other, above zero.
        tolerance: How far from whole their ratio may be.
        most: The most that their ratio may be; the least is 1.

    Raises:
        ValueError: Their ratio is out of range, or further from whole.
    """
    ratio = value / unit if is_number(value) else math.nan
    whole = math.isfinite(ratio) and abs(ratio - round(ratio)) <= tolerance
    holds = whole and 1 <= round(ratio) <= most
    _check(holds, name, value, f"a whole number of {unit_name}={shown(unit)}, from 1 to {most}")


def check_whole(name: str, value: float, least: int = 1, most: int | None = None) -> None:
    """Check a number that counts something.

    Args:
        name: What the caller calls it.
        value: The number: an integer of Python or NumPy, so that it can be counted with.
        least: The least that it may be.
        most: The most; None for no limit.

    Raises:
        ValueError: It is no integer, or out of range.
    """
    holds = is_whole(value) and value >= least and (most is None or value <= most)
    needed = f"a whole number >= {least}" if most is None else f"a whole number, {least} to {most}"
    _check(holds, name, value, needed)


def check_seed(seed: int) -> None:
    """Check a seed.

    Raises:
        ValueError: It is no integer, negative or enormous.
    """
    holds = is_whole(seed) and 0 <= seed < MOST_SEEDS
    _check(holds, "seed", seed, "a non-negative integer below 2**128")


def check_flag(name: str, value: bool, otherwise: str = "") -> None:
    """Check what must be true or false; arguments as in `check_positive`.

    Raises:
        ValueError: It is neither True nor False.
    """
    _check(isinstance(value, bool), name, value, "True or False", otherwise)


def check_instance(name: str, value: object, *kinds: type, otherwise: str = "") -> None:
    """Check an object that must be of one of some classes.

    Raises:
        ValueError: It is of none of them.
    """
    needed = " or ".join(f"a {kind.__name__}" for kind in kinds)
    _check(isinstance(value, kinds), name, value, needed, otherwise)


def check_name(name: str, value: str, valid: Iterable[str]) -> None:
    """Check a name against those that are known; the message suggests a close one.

    Raises:
        ValueError: It is none of them.
    """
    names = list(valid)
    # A suggestion takes long to find: not for a name that is known.
    if not (isinstance(value, str) and value in names):
        _check(False, name, value, f"one of {', '.join(names)}.{suggestion(value, names)}")


def suggestion(given: Any, names: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" where one of the names is close to the given one, else ""."""
    # A long text is no slip of the keyboard, and comparing it takes long.
    if not isinstance(given, str) or len(given) > _SHOWN:
        return ""
    close = difflib.get_close_matches(given.lower(), list(names), n=1, cutoff=0.5)
    return f" Did you mean {close[0]!r}?" if close else ""


def shown(value: object) -> str:
    """Return a value as messages show it: one line, not too long, whatever it is."""
    try:
        text = repr(value)
    except Exception:
        # Python writes no integer of more than 4300 digits.
        text = f"<{type(value).__name__} that cannot be shown>"
    text = " ".join(text.split())
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}…"


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a real number that a double reaches, NaN and infinity included."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True


def is_finite(value: object) -> TypeGuard[float]:
    """Return whether a value is a number, and finite."""
    return is_number(value) and math.isfinite(value)


def is_whole(value: object) -> TypeGuard[int]:
    """Return whether a value is an integer; True is none."""
    return not isinstance(value, bool) and isinstance(value, Integral)


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {item.name: hints[item.name] for item in fields(kind)}


def _unmet(value: object, hint: Any) -> str:
    """Return what a value of an annotation must be; "" where it is that."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        unmet = [_unmet(value, part) for part in parts]
        return " or ".join(unmet) if all(unmet) else ""
    if origin is Literal:
        known = any(type(value) is type(part) and value == part for part in parts)
        return "" if known else f"one of {', '.join(map(str, parts))}"
    if origin is tuple:
        return _unmet_tuple(value, parts)
    if hint is float:
        return "" if is_finite(value) else "a finite number"
    if hint is int:
        fits = is_whole(value) and abs(value) < MOST_SEEDS
        return "" if fits else "a whole number below 2**128"
    if hint is bool:
        return "" if isinstance(value, bool) else "True or False"
    if hint is types.NoneType:
        return "" if value is None else "None"
    if is_dataclass(hint):
        # No subclass: written as JSON, it would come back as its base.
        return "" if type(value) is hint else f"a {hint.__name__}"  # type: ignore[union-attr]
    if hint in (str, Path):
        return "" if isinstance(value, hint) else f"a {'text' if hint is str else hint.__name__}"
    return ""


def _unmet_tuple(value: object, parts: tuple[Any, ...]) -> str:
    endless = len(parts) == 2 and parts[1] is Ellipsis
    count = "one" if endless else str(len(parts))
    if not isinstance(value, list | tuple) or not (endless or len(value) == len(parts)):
        return "a tuple" if endless else f"a tuple of {count}"
    pairs = zip(value, [parts[0]] * len(value) if endless else parts, strict=True)
    unmet = [needed for needed in (_unmet(one, part) for one, part in pairs) if needed]
    return f"a tuple, each entry {unmet[0]}" if unmet else ""


def _check(holds: bool, name: str, value: object, needed: str, otherwise: str = "") -> None:
    if not holds:
        raise ValueError(f"{name}={shown(value)} must be {needed}{otherwise and ', ' + otherwise}")
