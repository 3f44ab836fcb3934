"""Every kind of number gives one answer: random formulas against 50 digits."""

import math

import mpmath
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lagros_envs.dynamics.straight_line import ArrayFunction, scalar_source, straight_line
from lagros_envs.numbers import Dual, Interval, Recorded, Series, dual, exact, functions, variable
from lagros_envs.numbers.functions import power


class Fifty:
    """The functions on mpmath's numbers."""

    sin, cos, tan, exp, sqrt = map(
        staticmethod, (mpmath.sin, mpmath.cos, mpmath.tan, mpmath.exp, mpmath.sqrt)
    )


# Each maps numbers of moderate size to numbers of moderate size, away from poles and bends.
ONE = {
    "sign": lambda f, a: -a,
    "square": lambda f, a: (0.25 * a) ** 2,
    "cube": lambda f, a: (a * 0.25) ** 3,
    "fourth": lambda f, a: (a / 4.0) ** 4,
    "inverse": lambda f, a: (2.0 + f.sin(a)) ** -1,
    "inverse square": lambda f, a: (2.0 + f.cos(a)) ** -2,
    "abs": lambda f, a: abs(f.sin(a) - 1.5),
    "sqrt": lambda f, a: f.sqrt(1.0 + (0.5 * a) ** 2),
    "sin": lambda f, a: f.sin(a),
    "cos": lambda f, a: f.cos(a),
    "tan": lambda f, a: f.tan(0.7 * f.sin(a)),
    "exp": lambda f, a: f.exp(f.cos(a) - 1.0),
    "over": lambda f, a: 1.5 / (2.5 - f.cos(a)),
    "less": lambda f, a: 0.3 - a,
}
TWO = {
    "+": lambda f, a, b: a + b,
    "-": lambda f, a, b: a - b,
    "*": lambda f, a, b: 0.2 * (a * b),
    "/": lambda f, a, b: a / (2.0 + f.sin(b)),
}


def grow(children):
    one = st.tuples(st.sampled_from(sorted(ONE)), children)
    two = st.tuples(st.sampled_from(sorted(TWO)), children, children)
    return one | two


formulas = st.recursive(st.sampled_from(["x", "y"]), grow, max_leaves=6)
numbers = st.floats(-2.0, 2.0)


def value(formula, f, x, y):
    if isinstance(formula, str):
        return {"x": x, "y": y}[formula]
    name, *parts = formula
    return (ONE | TWO)[name](f, *(value(part, f, x, y) for part in parts))


def fifty(formula, x, y):
    # More than 50 where mpmath differentiates numerically and asks for more.
    with mpmath.workdps(max(50, mpmath.mp.dps)):
        return value(formula, Fifty, mpmath.mpf(x), mpmath.mpf(y))


def close(found, wanted):
    return abs(float(found) - float(wanted)) <= 1e-11 * (1.0 + abs(float(wanted)))


@given(formulas, numbers, numbers)
def test_floats_arrays_and_recorded_numbers_agree_with_50_digits(formula, x, y):
    wanted = fifty(formula, x, y)
    assert close(value(formula, functions, x, y), wanted)
    arrays = np.array([x, 0.5]), np.array([y, -0.5])
    for namespace in (functions, np):
        assert close(value(formula, namespace, *arrays)[0], wanted)
    step = straight_line(lambda pair: [value(formula, functions, *pair)], ["x", "y"])
    buffers = ArrayFunction(step, (2,))
    buffers.inputs[:] = arrays
    assert close(buffers()[0, 0], wanted)
    source = straight_line(lambda pair: [value(formula, functions, *pair), pair[1]], ["x", "y"])
    spelled = {}
    exec(scalar_source(source, 1), spelled)
    assert close(spelled["held"](x, y)[0], wanted)


def rules(x, y):
    low = (x <= y) & (y > 0.5)
    return [functions.where(low, x, y * y), functions.where(x > y, 1.0, x), low, abs(x) <= abs(y)]


@given(numbers, numbers)
@example(0.5, 0.5)
@example(math.inf, 1.0)
@example(math.nan, 1.0)
def test_rules_are_the_same_on_floats_arrays_and_recorded_numbers(x, y):
    wanted = [
        x if x <= y and y > 0.5 else y * y,
        1.0 if x > y else x,
        x <= y and y > 0.5,
        abs(x) <= abs(y),
    ]
    np.testing.assert_array_equal(rules(x, y), wanted)
    arrays = np.array([x, 0.5]), np.array([y, -0.5])
    np.testing.assert_array_equal([row[0] for row in rules(*arrays)], wanted)
    step = straight_line(lambda pair: rules(*pair), ["x", "y"])
    buffers = ArrayFunction(step, (2,))
    buffers.inputs[:] = arrays
    np.testing.assert_array_equal(buffers()[:, 0], wanted)
    spelled = {}
    exec(scalar_source(straight_line(lambda pair: rules(*pair)[:2], ["x", "y"]), 1), spelled)
    np.testing.assert_array_equal(spelled["held"](x, y), wanted[:2])


@settings(max_examples=25)
@given(formulas, numbers, numbers)
def test_duals_give_the_derivatives_of_50_digits(formula, x, y):
    one, two = dual.seed([np.array(x), np.array(y)])
    found = value(formula, functions, one, two)
    assert close(found.value, fifty(formula, x, y))
    with mpmath.workdps(50):
        by_x = mpmath.diff(lambda t: fifty(formula, t, y), x)
        by_y = mpmath.diff(lambda t: fifty(formula, x, t), y)
    assert np.allclose(found.gradient, [float(by_x), float(by_y)], rtol=1e-9, atol=1e-9)


@given(formulas, numbers, numbers, st.floats(0.0, 0.3), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_intervals_enclose_the_values_of_50_digits(formula, x, y, width, first, second):
    found = value(formula, functions, Interval(x, x + width), Interval(y, y + width))
    inside = min(x + first * width, x + width), min(y + second * width, y + width)
    exactly = fifty(formula, *inside)
    assert mpmath.mpf(float(found.lower)) <= exactly <= mpmath.mpf(float(found.upper))
    sharp = value(formula, functions, exact(x), exact(y))
    assert float(sharp.upper - sharp.lower) < 1e-10


@settings(max_examples=25)
@given(formulas, numbers, numbers)
def test_series_enclose_the_derivatives_of_50_digits(formula, x, y):
    found = value(formula, functions, variable(exact(x), 2), exact(y))
    with mpmath.workdps(50):
        parts = mpmath.taylor(lambda t: fifty(formula, t, y), mpmath.mpf(x), 2)
    found = found.parts if isinstance(found, Series) else [found]
    for enclosure, wanted in zip(found, parts, strict=False):
        slack = mpmath.mpf(10) ** -15
        assert mpmath.mpf(float(enclosure.lower)) - slack <= wanted
        assert wanted <= mpmath.mpf(float(enclosure.upper)) + slack


@settings(max_examples=25)
@given(formulas, numbers, numbers, st.floats(0.0, 0.2), st.floats(0.0, 1.0))
def test_duals_of_intervals_enclose_derivatives_inside(formula, x, y, width, share):
    place = Interval(x, x + width)
    found = value(formula, functions, Dual(place, exact(1.0)), exact(y))
    inside = min(x + share * width, x + width)
    with mpmath.workdps(50):
        wanted = mpmath.diff(lambda t: fifty(formula, t, y), inside)
    if isinstance(found, Dual):
        slope = found.gradient
        assert float(slope.lower) - 1e-12 <= float(wanted) <= float(slope.upper) + 1e-12


def test_absolute_values_where_they_bend():
    assert (abs(Interval(-2.0, 1.0)).lower, abs(Interval(-2.0, 1.0)).upper) == (0.0, 2.0)
    slope = abs(Dual(Interval(-2.0, 1.0), exact(1.0))).gradient
    assert slope.lower <= -1.0
    assert slope.upper >= 1.0
    with pytest.raises(ZeroDivisionError, match="around zero"):
        abs(variable(Interval(-0.1, 0.1), 1))
    np.testing.assert_array_equal(
        abs(variable(exact([-2.0, 3.0]), 1)).derivative(1).midpoint, [-1.0, 1.0]
    )


def test_poles_and_roots_of_negative_intervals_are_refused():
    with pytest.raises(ZeroDivisionError, match="pole"):
        Interval(1.5, 1.6).tan()
    with pytest.raises(ZeroDivisionError, match="pole"):
        Interval(-1.6, -1.5).tan()
    with pytest.raises(ValueError, match="negative"):
        Interval(-0.1, 2.0).sqrt()
    # A sum of squares around zero holds no negative number, but for rounding.
    around = Interval(-0.1, 0.2)
    assert (around * around + around * around).sqrt().contains(np.array([0.0, 0.2 * 2**0.5])).all()
    assert Interval(1.5, 1.57).tan().upper > 1255.0


@pytest.mark.parametrize("exponent", [0.5, True, "2", 1.5])
def test_only_integer_powers_are_powers(exponent):
    numbers = [
        Dual(np.array(2.0), np.array(1.0)),
        exact(2.0),
        variable(exact(2.0), 1),
    ]
    for number in numbers:
        with pytest.raises(TypeError, match="integer"):
            number**exponent


@given(st.floats(-3.0, 3.0), st.integers(0, 9))
def test_powers_are_those_of_fractions(base, exponent):
    assert math.isclose(power(base, exponent), base**exponent, rel_tol=1e-14, abs_tol=1e-300)
    box = Interval(min(base, 0.5), max(base, 0.5)) ** exponent
    low, high = (np.min(box.lower), np.max(box.upper)) if exponent else (box, box)
    assert low <= base**exponent <= high


def test_recorded_numbers_do_not_branch():
    with pytest.raises(TypeError, match="branch"):
        straight_line(lambda pair: [pair[0] if pair[0] else pair[1]], ["x", "y"])
    assert isinstance(straight_line(lambda pair: [-pair[0]], ["x"]).outputs[0], str)
    assert Recorded.__name__ == "Recorded"
