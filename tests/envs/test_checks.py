"""Each range check against the range it names, over random numbers and the edges."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import numpy as np
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
    whole = isinstance(value, int) and value >= least
    assert _passes(checks.check_whole, "period", value, least) == whole
    enough = value == math.inf or (finite and exact >= least)
    assert _passes(checks.check_at_least, "period", value, least) == enough
    more = value == math.inf or (finite and exact > least)
    assert _passes(checks.check_above, "period", value, least) == more
    assert _passes(checks.check_each, "period", (least, value), least) == whole
    assert not _passes(checks.check_each, "period", (), least)


@given(st.integers(1, 500), st.floats(1e-3, 10.0), st.floats(1e-3, 0.5))
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
            "hidden=(8, 0) must be one whole number or more, each at least 1",
        ),
        (
            lambda: checks.check_multiple("limit", 0.25, "step", 0.1),
            "limit=0.25 must be a whole number of step=0.1, from 1 to 1000000",
        ),
        (lambda: checks.check_seed(-1), "seed=-1 must be a non-negative integer below 2**128"),
    ],
)
def test_a_message_names_the_argument_its_value_and_what_would_do(check, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check()


NO_NUMBERS = ("0.5", "", None, True, np.True_, [1.0], np.ones(2), 1j, 10**400, 10**5000, object())
NO_WHOLES = (
    1.0,
    2.5,
    math.inf,
    math.nan,
    *(value for value in NO_NUMBERS if type(value) is not int),
)


@pytest.mark.parametrize("value", NO_NUMBERS, ids=range(len(NO_NUMBERS)))
def test_what_is_no_number_is_refused_by_every_check_of_a_number_in_one_line(value):
    for check, arguments in (
        (checks.check_positive, ()),
        (checks.check_not_negative, ()),
        (checks.check_at_least, (0.0,)),
        (checks.check_above, (0.0,)),
        (checks.check_multiple, ("unit", 1.0)),
    ):
        with pytest.raises(ValueError, match=r"^period=.{1,80} must be .+$"):
            check("period", value, *arguments)
    for values in ((1, value), value, ()):
        with pytest.raises(ValueError, match=r"^hidden=.{1,80} must be .+$"):
            checks.check_each("hidden", values, 2)


@pytest.mark.parametrize("value", NO_WHOLES, ids=range(len(NO_WHOLES)))
def test_what_cannot_be_counted_with_is_refused(value):
    with pytest.raises(ValueError, match=r"^jobs=.{1,80} must be a whole number >= 1$"):
        checks.check_whole("jobs", value)
    with pytest.raises(ValueError, match=r"^seed=.{1,80} must be a non-negative integer below"):
        checks.check_seed(value)


@pytest.mark.parametrize("value", [np.int64(3), np.uint8(3), np.float32(3.0), Fraction(3)])
def test_numbers_of_numpy_and_the_standard_library_are_numbers(value):
    checks.check_positive("bound", value)
    checks.check_multiple("time_limit", value, "period", 1.0)
    if isinstance(value, np.integer):
        checks.check_whole("jobs", value)
        checks.check_seed(value)


def test_a_count_has_a_most():
    checks.check_whole("jobs", 512, 1, 512)
    with pytest.raises(ValueError, match=r"^jobs=513 must be a whole number, 1 to 512$"):
        checks.check_whole("jobs", 513, 1, 512)


@pytest.mark.parametrize("value", [0.0, 1e-12, 1e6, 1e300])
def test_an_episode_of_no_step_or_of_too_many_is_no_multiple(value):
    with pytest.raises(
        ValueError, match=r"must be a whole number of period=0\.1, from 1 to 1000000"
    ):
        checks.check_multiple("time_limit", value, "period", 0.1)


@pytest.mark.parametrize("value", ["gusts", "", None, 1, ["gust"], {}])
def test_a_name_is_refused_with_the_valid_ones(value):
    with pytest.raises(ValueError, match=r"^kind=.+ must be one of none, gust") as error:
        checks.check_name("kind", value, ("none", "gust"))
    assert ("Did you mean 'gust'?" in str(error.value)) == (value == "gusts")
    checks.check_name("kind", "gust", ("none", "gust"))


def test_a_flag_is_true_or_false_and_nothing_else():
    checks.check_flag("filter", False)
    for value in (0, 1, "yes", None):
        with pytest.raises(ValueError, match=r"must be True or False"):
            checks.check_flag("filter", value)


def test_a_value_is_shown_on_one_line():
    assert checks.shown("a\nb") == repr("a\nb")
    assert "\n" not in checks.shown(np.eye(3))
    assert len(checks.shown("x" * 10**6)) == 80
