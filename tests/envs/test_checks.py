"""Each range check against the range it names, over random numbers and the edges."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs import checks

EDGES = (0.0, -0.0, 5e-324, -5e-324, 1, -1, 1.5, math.inf, -math.inf, math.nan)
NUMBERS = st.one_of(st.sampled_from(EDGES), st.floats(), st.integers(-5, 5))


def _exact(value: float) -> Fraction | None:
    """Return the number without rounding; None if it is not finite."""
    try:
        return Fraction(value)
    except (OverflowError, ValueError):
        return None


def _passes(check, *arguments) -> bool:
    try:
        check(*arguments)
    except ValueError:
        return False
    return True


@given(NUMBERS, st.integers(0, 3))
def test_a_check_passes_exactly_what_its_message_names(value, least):
    exact = _exact(value)
    finite = exact is not None
    assert _passes(checks.check_positive, "period", value) == (finite and exact > 0)
    assert _passes(checks.check_not_negative, "period", value) == (finite and exact >= 0)
    whole = finite and exact.denominator == 1 and exact >= least
    assert _passes(checks.check_whole, "period", value, least) == whole
    enough = value == math.inf or (finite and exact >= least)
    assert _passes(checks.check_at_least, "period", value, least) == enough
    more = value == math.inf or (finite and exact > least)
    assert _passes(checks.check_above, "period", value, least) == more
    assert _passes(checks.check_each, "period", (least, value), least) == enough
    assert not _passes(checks.check_each, "period", (), least)


@given(st.integers(0, 500), st.floats(1e-3, 10.0), st.floats(1e-3, 0.5))
def test_a_multiple_is_told_from_what_lies_between_two(count, unit, share):
    assert _passes(checks.check_multiple, "period", count * unit, "unit", unit)
    assert not _passes(checks.check_multiple, "period", (count + share) * unit, "unit", unit)
    assert _passes(
        checks.check_multiple, "period", (count + share) * unit, "unit", unit, 0.5 + 1e-9
    )


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: checks.check_positive("mass", 0.0), "mass=0.0 must be finite and > 0"),
        (
            lambda: checks.check_positive("limit", math.inf, "or None for no limit"),
            "limit=inf must be finite and > 0, or None for no limit",
        ),
        (lambda: checks.check_not_negative("bound", -1), "bound=-1 must be finite and >= 0"),
        (lambda: checks.check_at_least("agents", 0, 1), "agents=0 must be at least 1"),
        (lambda: checks.check_whole("passes", 1.5, 2), "passes=1.5 must be a whole number >= 2"),
        (lambda: checks.check_above("deadline", 0.0, 0), "deadline=0.0 must be > 0"),
        (
            lambda: checks.check_each("hidden", (8, 0), 1),
            "hidden=(8, 0) must be one number or more, each at least 1",
        ),
        (
            lambda: checks.check_multiple("limit", 0.25, "step", 0.1),
            "limit=0.25 must be a whole number of step=0.1",
        ),
        (lambda: checks.check_seed(-1), "seed=-1 must be a non-negative integer"),
    ],
)
def test_a_message_names_the_argument_its_value_and_what_would_do(check, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check()
