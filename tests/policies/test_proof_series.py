"""Enclosures of derivatives, against 50 digits and against the oracle's complex steps."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.numbers import Dual, Interval, Series, dual, exact, functions, variable
from lagros_envs.numbers.functions import cos, sin
from lagros_policies.contraction import Basis, BoxRegion, Metric
from lagros_policies.proof.enclosures import constant, enclosed_metric, held_slopes, slopes
from tests.policies.foreign import positive
from tests.policies.shipped import shipped_metric


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


def test_slopes_are_the_oracles_and_over_cells_enclose_those_inside(oracle, system):
    rng = np.random.default_rng(0)
    point = rng.uniform(-1.0, 1.0, (200, 5)) * [5.0, 1.3, 4.0, 6.0, 40.0]
    thin = [variable(exact(part), 2) for part in point.T]
    slope, gain = slopes(system, thin[:4], thin[4:])
    expected = oracle.jacobian(lambda x: oracle.rates(x, point[:, 4:]), point[:, :4])
    np.testing.assert_allclose(slope.parts[0].midpoint, expected, atol=1e-8)
    np.testing.assert_allclose(gain.parts[0].midpoint, oracle.input_matrix(point[:, :4]))
    assert slope.parts[0].radius.max() < 1e-8
    wide = [variable(Interval(part - 0.01, part + 0.01), 2) for part in point.T]
    for _ in range(20):
        inside = point + rng.uniform(-0.01, 0.01, point.shape)
        full = oracle.jacobian(lambda z: oracle.rates(z[..., :4], z[..., 4:]), inside)
        for found, true in zip(
            slopes(system, wide[:4], wide[4:]), np.split(full, [4], -1), strict=True
        ):
            part = found.parts[0]
            assert np.all(Interval(part.lower - 1e-9, part.upper + 1e-9).contains(true))
    for whole, part in zip(slopes(system, wide[:4], wide[4:]), (slope, gain), strict=True):
        for order in range(3):
            assert np.all(whole.parts[order].lower <= part.parts[order].upper)
            assert np.all(part.parts[order].lower <= whole.parts[order].upper)


def test_the_map_of_a_hold_and_its_slopes_are_the_oracles(oracle, system):
    rng = np.random.default_rng(1)
    point = rng.uniform(-1.0, 1.0, (50, 5)) * [5.0, 0.9, 2.0, 2.0, 10.0]
    thin = [constant(part, 0) for part in point.T]
    ended, slope, gain = held_slopes(system, thin[:4], thin[4:], 0.1)
    full = oracle.jacobian(lambda z: oracle.step(z[:, :4], z[:, 4:]), point)
    after = np.stack([one.parts[0].midpoint for one in ended], axis=-1)
    np.testing.assert_allclose(after, oracle.step(point[:, :4], point[:, 4:]), atol=1e-9)
    np.testing.assert_allclose(slope.parts[0].midpoint, full[..., :4], atol=1e-9)
    np.testing.assert_allclose(gain.parts[0].midpoint, full[..., 4:], atol=1e-9)


def test_a_metric_and_its_rate_are_enclosed_sharply():
    metric, angle = shipped_metric(), np.linspace(-1.1, 1.1, 23)
    states, motion = np.zeros((23, 4)), np.zeros(4)
    states[:, 1], motion[1] = angle, 1.0
    zero = constant(np.zeros(23), 1)
    place = [Dual(zero, zero) for _ in range(4)]
    place[1] = Dual(variable(exact(angle), 1), zero + 1.0)
    found = enclosed_metric(metric, place)
    rate = metric.dual_rate(states, motion)
    np.testing.assert_allclose(found.value.parts[0].midpoint, metric.dual(states), atol=1e-9)
    for part in (found.value.derivative(1), found.gradient.parts[0]):
        np.testing.assert_allclose(part.midpoint, rate, atol=1e-8)
        assert part.radius.max() < 1e-8 * np.abs(rate).max()
    # Coefficients of both signs, some thousand times larger than what they add up to.
    wide = enclosed_metric(metric, [constant(Interval(angle - 0.01, angle + 0.01), 0)] * 4)
    assert np.all(wide.parts[0].contains(metric.dual(states)))
    assert np.median(wide.parts[0].radius) < 0.1 * np.abs(metric.dual(states)).max()


def test_a_metric_of_several_coordinates_is_enclosed():
    rng = np.random.default_rng(2)
    basis = Basis(("1", "x[0]^2*cos(x[1])", "sin(x[1])^3", "x[0]*x[2]", "cos(x[1])"))
    parts = np.stack([positive(3), *(0.05 * positive(3, seed) for seed in range(1, 5))])
    box = BoxRegion((-1.0,) * 3, (1.0,) * 3, (1.0,) * 3, (0.0,), (1.0,))
    metric = Metric(parts, 0.2, 50.0, 3.0, np.ones(3), box, basis=basis)
    states = rng.uniform(-1.0, 1.0, (40, 3))
    thin = enclosed_metric(metric, [constant(part, 0) for part in states.T]).parts[0]
    np.testing.assert_allclose(thin.midpoint, metric.dual(states), rtol=1e-12)
    cells = [constant(Interval(part - 0.1, part + 0.1), 0) for part in states.T]
    wide = enclosed_metric(metric, cells).parts[0]
    for _ in range(20):
        assert np.all(wide.contains(metric.dual(states + rng.uniform(-0.1, 0.1, states.shape))))
