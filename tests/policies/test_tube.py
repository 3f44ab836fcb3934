"""The tubes of Theorem 1, Lemma 1 and Theorem 3 against the inequalities they come from."""

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given
from hypothesis import strategies as st

from lagros_policies.contraction import Tube, certified_tube, diverging_bound, tighten

positive = st.floats(0.1, 3.0)
bounds = st.floats(0.0, 2.0)
TIMES = np.linspace(0.0, 9.0, 31)


def integrate(rate_of, start):
    answer = scipy.integrate.solve_ivp(
        lambda t, y: rate_of(y), (0.0, 9.0), [start], t_eval=TIMES, rtol=1e-9, atol=1e-13
    )
    return answer.y[0]


@given(
    rate=positive,
    least=positive,
    condition=st.floats(1.0, 50.0),
    disturbance=bounds,
    error=bounds,
    gain=bounds,
    start=bounds,
)
def test_radius_solves_the_comparison_equation_of_theorem_1(
    rate, least, condition, disturbance, error, gain, start
):
    # M between I / largest and I / least: R' = -alpha R + d / sqrt(least), |e| = sqrt(largest) R.
    largest = condition * least
    push = gain * error + disturbance
    length = integrate(lambda R: -rate * R + push / np.sqrt(least), start)
    tube = Tube(rate, condition, disturbance, error, gain, start * np.sqrt(largest))
    assert tube.radius(TIMES) == pytest.approx(np.sqrt(largest) * length, rel=1e-6, abs=1e-9)
    assert tube.radius(2.1) == pytest.approx(float(tube.radius(np.array(2.1))))
    assert isinstance(tube.radius(2.1), float)
    assert tube.radius(1e6) == pytest.approx(tube.steady_radius)


@given(
    lipschitz=st.floats(0.05, 2.0),
    disturbance=bounds,
    error=bounds,
    gain=bounds,
    start=bounds,
)
def test_diverging_bound_solves_the_equation_of_gronwall(
    lipschitz, disturbance, error, gain, start
):
    push = gain * error + disturbance
    expected = integrate(lambda e: lipschitz * e + push, start)
    found = diverging_bound(TIMES, lipschitz, disturbance, error, gain, start)
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_diverging_bound_grows_where_the_tube_settles():
    tube = Tube(0.6, 300.0, 0.1)
    late = diverging_bound(np.array([0.0, 9.0]), 1.5, 0.1)
    assert late[0] == 0.0
    assert late[1] > 1e3 * tube.steady_radius
    with pytest.raises(ValueError, match="lipschitz"):
        diverging_bound(TIMES, 0.0, 0.1)


def test_certified_tube_has_the_rate_and_condition_of_the_metric(metric):
    angles = np.zeros((2000, 4))
    angles[:, 1] = np.linspace(-metric.region.angle, metric.region.angle, 2000)
    values = 1.0 / np.linalg.eigvalsh(metric.dual(angles))
    tube = certified_tube(metric, 0.3, learning_error=0.2, control_gain=1.4)
    expected = (1.4 * 0.2 + 0.3) / metric.contraction_rate
    expected *= np.sqrt(values.max() / values.min())
    assert tube.steady_radius == pytest.approx(expected, rel=1e-4)
    assert tube.radius(0.0) == 0.0


def test_chi_bounds_the_condition_of_the_tube_in_unscaled_states(constant_metric):
    assert np.all(constant_metric.scaling == 1.0)
    tube = certified_tube(constant_metric, 0.3)
    assert tube.condition == pytest.approx(constant_metric.condition_bound, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("contraction_rate", 0.0),
        ("contraction_rate", float("nan")),
        ("condition", 0.99),
        ("disturbance_bound", -0.1),
        ("learning_error", float("inf")),
        ("control_gain", -1.0),
        ("initial_radius", float("nan")),
    ],
)
def test_tube_refuses_numbers_out_of_range(name, value):
    settings = {"contraction_rate": 0.5, "condition": 2.0, "disturbance_bound": 0.1}
    with pytest.raises(ValueError, match=name):
        Tube(**{**settings, name: value})


vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@given(
    centre=vectors,
    half=st.lists(st.floats(0.1, 3.0), min_size=3, max_size=3).map(np.array),
    share=st.floats(0.0, 0.99),
    place=vectors,
    direction=vectors,
    distance=st.floats(0.0, 1.0),
)
def test_whatever_is_within_the_tube_of_a_tightened_point_is_admissible(
    centre, half, share, place, direction, distance
):
    low, high = centre - half, centre + half
    radius = share * half.min()
    tight_low, tight_high = tighten(low, high, np.array(radius))
    middle, reach = (tight_low + tight_high) / 2, (tight_high - tight_low) / 2
    point = middle + place * reach
    length = np.linalg.norm(direction)
    xi = point + distance * radius * (direction / length if length > 0 else direction)
    assert np.all(xi >= low - 1e-12)
    assert np.all(xi <= high + 1e-12)
    # No larger set will do: beyond its edge some xi of the tube is outside.
    beyond = tight_high + 1e-6
    assert np.all(beyond + radius > high)
    assert np.all(tight_low - 1e-6 - radius < low)


def test_tightening_follows_a_radius_that_grows():
    radius = Tube(0.6, 4.0, 0.1).radius(TIMES)
    low, high = tighten(np.array(-1.5), np.array(1.5), radius)
    assert np.array_equal(high, 1.5 - radius)
    assert np.array_equal(low, -high)
    assert np.all(np.diff(high) < 0.0)


def test_tube_wider_than_the_interval_is_refused():
    with pytest.raises(ValueError, match=r"wider.*disturbance"):
        tighten(np.array([-1.0, -1.0]), np.array([1.0, 1.0]), np.array([0.5, 1.1]))
