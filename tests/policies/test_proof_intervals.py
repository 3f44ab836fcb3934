"""Interval arithmetic against exact rational arithmetic."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.numbers import Interval, exact
from lagros_policies.proof.matrices import matmul

NUMBERS = st.floats(-1e6, 1e6)


@st.composite
def interval_and_point(draw):
    low, high = sorted((draw(NUMBERS), draw(NUMBERS)))
    return Interval(low, high), Fraction(draw(st.floats(low, high)))


def holds(interval, value):
    return Fraction(float(interval.lower)) <= value <= Fraction(float(interval.upper))


@given(interval_and_point(), interval_and_point())
def test_results_enclose_the_exact_rational_ones(first, second):
    (a, x), (b, y) = first, second
    assert holds(a + b, x + y)
    assert holds(a - b, x - y)
    assert holds(a * b, x * y)
    assert holds(a.square(), x * x)
    assert holds(-a, -x)
    assert holds(3.7 - a, Fraction(3.7) - x)
    assert holds(a * -0.3, x * Fraction(-0.3))
    if b.lower <= 1e-300 and b.upper >= -1e-300:
        with pytest.raises(ZeroDivisionError, match="contains zero"):
            a / b
    else:
        assert holds(a / b, x / y)


def rational_sine(x, shift=0):
    """Return bounds of sin (shift 0) or cos (shift 1) by the Taylor series, in fractions."""
    total, term = Fraction(0), Fraction(1) if shift else x
    for k in range(1 + (1 - shift), 80, 2):
        total += term
        term *= -x * x / (k * (k + 1))
    return total - abs(term), total + abs(term)


@given(st.floats(-7, 7))
def test_sine_and_cosine_enclose_the_series_and_are_sharp(angle):
    for interval, shift in ((exact(angle).sin(), 0), (exact(angle).cos(), 1)):
        low, high = rational_sine(Fraction(angle), shift)
        assert Fraction(float(interval.lower)) <= low
        assert high <= Fraction(float(interval.upper))
        assert interval.upper - interval.lower < 1e-14


@given(st.floats(-20, 20), st.floats(0, 10))
def test_sine_and_cosine_of_intervals_have_the_true_range(low, width):
    angle = Interval(low, low + width)
    grid = np.linspace(low, low + width, 4001)
    for found, values in ((angle.sin(), np.sin(grid)), (angle.cos(), np.cos(grid))):
        assert np.all(found.contains(values))
        # The grid misses an extremum by less than (width / 4000)^2 / 8.
        assert found.lower > values.min() - 1e-5
        assert found.upper < values.max() + 1e-5


def test_enormous_angles_are_given_up_safely():
    found = exact(1e9).sin()
    assert (found.lower, found.upper) == (-1.0, 1.0)


def test_a_number_times_itself_is_a_square():
    value = Interval(-2.0, 1.0)
    assert (value * value).lower == 0.0
    assert (value * Interval(-2.0, 1.0)).lower < -1.9


def test_arrays_on_the_left_work_like_arrays_on_the_right():
    value, numbers = Interval([1.0, -2.0], [2.0, 3.0]), np.array([2.0, -1.0])
    for left, right in ((numbers * value, value * numbers), (numbers + value, value + numbers)):
        np.testing.assert_array_equal(left.lower, right.lower)
        np.testing.assert_array_equal(left.upper, right.upper)
    with pytest.raises(TypeError):
        np.arctan(value)


def test_ends_in_the_wrong_order_are_refused():
    with pytest.raises(ValueError, match="swap the ends"):
        Interval([0.0, 2.0], [1.0, 1.0])
    with pytest.raises(ValueError, match="NaN"):
        Interval(np.nan, 1.0)


def test_matrix_products_enclose_products_of_members():
    rng = np.random.default_rng(0)
    first, second = rng.standard_normal((2, 50, 4, 4))
    product = matmul(Interval(first - 0.1, first + 0.1), Interval(second - 0.2, second + 0.2))
    for _ in range(20):
        a = first + rng.uniform(-0.1, 0.1, first.shape)
        b = second + rng.uniform(-0.2, 0.2, second.shape)
        assert np.all(product.contains(a @ b))
