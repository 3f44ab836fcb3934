"""Enclosures of derivatives, against 50 digits and against the oracle's complex steps."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.numbers import Interval, Series, dual, exact, functions, variable
from lagros_envs.numbers.functions import cos, sin
from lagros_policies.contraction import load_metric
from lagros_policies.proof.motion import (
    accelerations,
    control_square,
    jacobian_parts,
    metric_series,
)


def series_of(x):
    return (sin(x) * cos(x) - 0.3 / (2.0 - x * x * 0.25)) / (1.3 - 0.1 * cos(x * 2.0) * cos(x))


def digits_of(t):
    top = mpmath.sin(t) * mpmath.cos(t) - mpmath.mpf(0.3) / (2 - t * t * mpmath.mpf(0.25))
    low = mpmath.mpf(1.3) - mpmath.mpf(0.1) * mpmath.cos(t * 2) * mpmath.cos(t)
    return top / low


@given(st.floats(-1.4, 1.4))
def test_derivatives_at_a_point_enclose_those_of_50_digits_and_are_sharp(place):
    found = series_of(variable(exact(place), 3))
    with mpmath.workdps(50):
        coefficients = mpmath.taylor(digits_of, mpmath.mpf(place), 3)
        for order, value in enumerate(coefficients):
            part = found.parts[order]
            assert mpmath.mpf(float(part.lower)) <= value + mpmath.mpf(10) ** -25
            assert value - mpmath.mpf(10) ** -25 <= mpmath.mpf(float(part.upper))
            assert part.upper - part.lower < 1e-10


@given(st.floats(-1.3, 1.3), st.floats(0.0, 0.1), st.floats(0.0, 1.0))
def test_derivatives_over_an_interval_enclose_those_inside(low, width, share):
    found = series_of(variable(Interval(low, low + width), 3))
    inside = series_of(variable(exact(min(low + share * width, low + width)), 3))
    for whole, part in zip(found.parts, inside.parts, strict=True):
        assert whole.lower <= part.upper
        assert part.lower <= whole.upper


def test_duals_of_series_give_mixed_derivatives():
    # d/dy of sin(x y) at y = 2 is x cos(2 x); its series in x by hand.
    x = variable(exact(0.4), 2)
    product = functions.sin(dual.Dual(x * 2.0, x))
    by_hand = x * cos(x * 2.0)
    for found, expected in zip(product.gradient.parts, by_hand.parts, strict=True):
        assert found.midpoint == pytest.approx(expected.midpoint, abs=1e-14)


def test_arrays_on_the_left_and_divided_constants_are_understood():
    x = variable(exact(np.array([0.3, 0.7])), 2)
    both = np.array([2.0, 3.0]) * x + 1.0 / x
    np.testing.assert_allclose(both.parts[0].midpoint, [0.6 + 1 / 0.3, 2.1 + 1 / 0.7])
    np.testing.assert_allclose(both.derivative(2).midpoint, [2 / 0.3**3, 2 / 0.7**3])
    np.testing.assert_allclose((np.array([1.0, 1.0]) - x).parts[1].midpoint, -1.0)
    assert isinstance(sin(x), Series)
    assert sin(0.5) == np.sin(0.5)
    assert cos(0.5) == np.cos(0.5)


def test_the_parts_of_the_jacobian_give_the_oracles(oracle, system):
    rng = np.random.default_rng(0)
    point = rng.uniform(-1.0, 1.0, (200, 5)) * [5.0, 1.3, 4.0, 6.0, 40.0]
    parts = jacobian_parts(system, accelerations(system, exact(point[:, 1]), 1))
    push = point[:, 4] - oracle.mu_cart * point[:, 2]
    wide = (slice(None), None, None)
    found = parts.at(0, push[wide], np.zeros(200)[wide], point[:, 3][wide], point[:, 3][wide] ** 2)
    expected = oracle.jacobian(lambda x: oracle.rates(x, point[:, 4:]), point[:, :4])
    assert np.abs(found.midpoint - expected).max() < 1e-8
    assert found.radius.max() < 1e-8
    square = oracle.input_matrix(point[:, :4])
    held = control_square(accelerations(system, exact(point[:, 1]), 1)).parts[0]
    np.testing.assert_allclose(
        held.midpoint, square @ np.swapaxes(square, -1, -2), rtol=1e-9, atol=1e-12
    )


def test_the_balance_holds_the_pole_still(oracle, system):
    angle = np.linspace(-1.2, 1.2, 25)
    force = accelerations(system, exact(angle), 1).balance.parts[0].midpoint
    states = np.zeros((25, 4))
    states[:, 1] = angle
    assert np.abs(oracle.rates(states, force[:, None])[:, 3]).max() < 1e-9


def test_the_parts_over_cells_enclose_derivatives_inside(system):
    ends = np.linspace(-1.0, 1.0, 21)
    cells = Interval(ends[:-1], ends[1:])
    wide = jacobian_parts(system, accelerations(system, cells, 3))
    rng = np.random.default_rng(1)
    for _ in range(5):
        inside = exact(rng.uniform(cells.lower, cells.upper))
        thin = jacobian_parts(system, accelerations(system, inside, 3))
        for name in ("still", "by_push", "by_rate", "by_square", "by_balance"):
            for order in range(3):
                whole = getattr(wide, name).derivative(order)
                part = getattr(thin, name).derivative(order)
                assert np.all(whole.lower <= part.upper)
                assert np.all(part.lower <= whole.upper)


def test_the_metrics_series_is_the_metric_and_its_rate():
    metric, angle = load_metric(), np.linspace(-1.1, 1.1, 23)
    series = metric_series(metric, variable(exact(angle), 1))
    states, motion = np.zeros((23, 4)), np.zeros(4)
    states[:, 1], motion[1] = angle, 1.0
    rate = metric.dual_rate(states, motion)
    np.testing.assert_allclose(series.parts[0].midpoint, metric.dual(states), atol=1e-9)
    np.testing.assert_allclose(series.derivative(1).midpoint, rate, atol=1e-8)
