"""CV-STEM against the same program stated in cvxpy, and its condition against the definition."""

from dataclasses import replace
from types import SimpleNamespace

import cvxpy as cp
import numpy as np
import pytest
import scipy.linalg

from lagros_envs.dynamics import state_dependent_coefficient
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import (
    CvStemSettings,
    InfeasibleError,
    contraction_residual,
    design_metric,
    design_on_pool,
    search_rate,
    verify_metric,
)
from lagros_policies.tasks.cartpole import metric_design
from lagros_policies.tasks.cartpole.metric_design import (
    MetricDesignSettings,
    design_cartpole_metric,
    tube_samples,
)
from lagros_policies.tasks.cartpole.region import Region


def stated_in_cvxpy(oracle, samples, region, settings):
    """Return (chi, nu) of Theorem 2's program; the bounds on a finer grid of angles."""
    duals = [cp.Variable((4, 4), symmetric=True) for _ in range(settings.degree + 1)]
    chi, nu = cp.Variable(), cp.Variable(nonneg=True)
    rate = settings.contraction_rate + settings.margin
    slopes = oracle.sdc(samples.state, samples.nominal, samples.nominal_control)
    inputs = oracle.input_matrix(samples.state)
    conditions = []
    for state, slope, gain in zip(samples.state, slopes, inputs, strict=True):
        cosine, sine = np.cos(state[1]), np.sin(state[1])
        dual = sum(cosine**i * W for i, W in enumerate(duals))
        # d cos^i(theta) / dt = -i cos^(i-1) sin(theta) dtheta/dt
        factors = [-i * cosine ** (i - 1) * sine * state[3] if i else 0.0 for i in range(3)]
        moving = sum(factor * W for factor, W in zip(factors, duals, strict=False))
        left = -moving + slope @ dual + dual @ slope.T - 2 * nu * gain @ gain.T + 2 * rate * dual
        conditions.append((left + left.T) / 2 << 0)
    scale = np.diag(settings.scaling)
    for angle in np.linspace(0.0, region.angle, 61 if settings.degree else 1):
        dual = sum(np.cos(angle) ** i * W for i, W in enumerate(duals))
        scaled = scale @ dual @ scale
        conditions += [scaled >> np.eye(4), scaled << chi * np.eye(4)]
    problem = cp.Problem(cp.Minimize(chi + settings.control_penalty * nu), conditions)
    # Far below what is compared, and within reach of every BLAS.
    problem.solve(solver=cp.CLARABEL, tol_feas=1e-6, tol_gap_abs=1e-6, tol_gap_rel=1e-6)
    assert problem.status == "optimal"
    return float(chi.value), float(nu.value)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(CvStemSettings(0.6, 0, 0.1, margin=0.02, scaling=(1.0,) * 4), id="constant"),
        pytest.param(
            CvStemSettings(0.4, 2, 0.05, margin=0.1, scaling=(1.0, 2.0, 0.7, 1.3)), id="degree 2"
        ),
    ],
)
def test_metric_is_the_optimum_of_the_program_stated_in_cvxpy(
    oracle, system, region, samples, settings
):
    few = samples.take(np.arange(20))
    metric = design_metric(system, few, region, settings)
    chi, nu = stated_in_cvxpy(oracle, few, region, settings)
    assert metric.condition_bound == pytest.approx(chi, rel=1e-3)
    assert metric.control_weight == pytest.approx(nu, rel=1e-3)
    # W_bar itself keeps the bounds in the scaled states, between the angles of the program too.
    angles = np.zeros((500, 4))
    angles[:, 1] = np.linspace(-region.angle, region.angle, 500)
    scaled = metric.dual(angles) * np.outer(settings.scaling, settings.scaling)
    values = np.linalg.eigvalsh(scaled)
    assert values.min() > 1.0 - 1e-3
    assert values.max() < chi * (1.0 + 1e-3)
    # The margin is part of alpha at the samples, and not of the metric's own alpha.
    assert metric.contraction_rate == settings.contraction_rate
    residual = contraction_residual(system, metric, few)
    assert residual.max() == pytest.approx(-2.0 * settings.margin, abs=1e-4)


def test_infeasible_program_names_alpha_and_region(system, region, samples):
    with pytest.raises(InfeasibleError) as caught:
        design_metric(system, samples, region, CvStemSettings(37.5, degree=1))
    assert "37.5" in str(caught.value)
    assert repr(region) in str(caught.value)


def test_residual_is_the_largest_relative_eigenvalue_of_the_condition(
    oracle, system, metric, samples
):
    state, nominal, control = samples.state, samples.nominal, samples.nominal_control
    # dW_bar/dt by moving along the flow, whatever W_bar depends on.
    h = 1e-5
    ahead, behind = (oracle.step(state, control, time, 1) for time in (h, -h))
    moving = (metric.dual(ahead) - metric.dual(behind)) / (2 * h)
    slope, gain = oracle.sdc(state, nominal, control), oracle.input_matrix(state)
    dual = metric.dual(state)
    product = slope @ dual
    left = (
        -moving
        + product
        + np.swapaxes(product, 1, 2)
        - 2 * metric.control_weight * gain @ np.swapaxes(gain, 1, 2)
        + 2 * metric.contraction_rate * dual
    )
    expected = [scipy.linalg.eigh(a, b)[0][-1] for a, b in zip(left, dual, strict=True)]
    residual = contraction_residual(system, metric, samples)
    assert residual == pytest.approx(np.array(expected), rel=1e-5, abs=1e-5)
    assert residual.max() <= 0.0  # the pool that the metric was designed on


def test_a_metric_that_is_not_positive_has_an_infinite_residual(system, metric, samples):
    """It is infinite where it is none, and what it is where it is one."""
    one = samples.state[:, 0] > 0.0
    sign = np.where(one, 1.0, -1.0)[:, None, None]
    broken = SimpleNamespace(
        contraction_rate=metric.contraction_rate,
        control_weight=metric.control_weight,
        dual=lambda state: sign * metric.dual(state),
        dual_rate=lambda state, motion: sign * metric.dual_rate(state, motion),
    )
    residual = contraction_residual(system, broken, samples)
    assert 0 < one.sum() < len(one)
    assert np.all(residual[~one] == np.inf)
    whole = contraction_residual(system, metric, samples)
    assert residual[one] == pytest.approx(whole[one], rel=1e-12)


def test_sdc_matrix_in_the_region_turns_the_error_into_the_difference_of_the_rates(
    oracle, system, samples
):
    slope = state_dependent_coefficient(
        system, samples.state, samples.nominal, samples.nominal_control
    )
    error = samples.state - samples.nominal
    difference = oracle.rates(samples.state, samples.nominal_control)
    difference = difference - oracle.rates(samples.nominal, samples.nominal_control)
    product = np.einsum("sij,sj->si", slope, error)
    assert product == pytest.approx(difference, abs=1e-9)


def test_pool_is_satisfied_where_the_first_program_alone_fails(system, region, samples):
    settings = CvStemSettings(0.5, 2, 0.1, 0.05, (1.0, 3.0, 1.0, 1.5))
    alone = design_metric(system, samples.take(np.arange(20)), region, settings)
    assert contraction_residual(system, alone, samples).max() > 0.0
    pooled = design_on_pool(system, samples, region, settings, first=20)
    assert contraction_residual(system, pooled, samples).max() <= 0.0
    with pytest.raises(RuntimeError, match="margin"):
        design_on_pool(system, samples, region, settings, first=20, rounds=1)


def test_line_search_takes_the_rate_of_the_least_tube(system, region, samples):
    few = samples.take(np.arange(30))
    settings = CvStemSettings(0.5, 0, 0.1, 0.02, (1.0,) * 4)
    rates = [0.2, 0.6, 1.2, 40.0]
    best, curve = search_rate(system, few, region, settings, rates)
    assert [rate for rate, _ in curve] == rates
    assert curve[-1][1] == np.inf
    for rate, radius in curve[:-1]:
        metric = design_metric(system, few, region, replace(settings, contraction_rate=rate))
        assert radius == pytest.approx(metric.condition_bound**0.5 / rate)
    assert (best.contraction_rate, min(radius for _, radius in curve)) in curve
    with pytest.raises(InfeasibleError, match="40"):
        search_rate(system, few, region, settings, [30.0, 40.0])


def test_verification_counts_what_breaks_the_condition_or_the_bounds(
    system, metric, region, plans, make_plans, make_samples
):
    fresh = make_samples(region, make_plans(6, seed=77), 2000, seed=3)
    checked = verify_metric(system, metric, fresh, seed=3).verification
    residual = contraction_residual(system, metric, fresh)
    assert checked.samples == 2000
    assert checked.seed == 3
    assert checked.worst == residual.max()
    assert checked.violations == int(np.sum(residual > 0.0))
    # Faster than the metric contracts: broken almost everywhere, and both figures say so.
    fast = verify_metric(system, replace(metric, contraction_rate=9.0), fresh, 3).verification
    assert fast.worst > 0.0
    assert fast.violations > 1900
    # The condition does not change with the scale of W_bar and nu together; the bounds do.
    scaled = replace(
        metric,
        coefficients=0.5 * metric.coefficients,
        control_weight=0.5 * metric.control_weight,
    )
    small = verify_metric(system, scaled, fresh, 3).verification
    assert small.worst == pytest.approx(checked.worst, rel=1e-6)
    assert small.violations > 1900


@pytest.mark.parametrize(
    "bad",
    [
        {"contraction_rate": 0.0},
        {"contraction_rate": float("nan")},
        {"degree": -1},
        {"control_penalty": 0.0},
        {"margin": -0.1},
        {"scaling": (1.0, 0.0, 1.0, 1.0)},
    ],
)
def test_settings_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        CvStemSettings(**bad)


@pytest.mark.parametrize(
    "bad", [{"angle": 1.6}, {"angular_rate": 0.0}, {"force": float("inf")}, {"angle_error": -0.1}]
)
def test_regions_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Region(**bad)


def test_region_contains_what_keeps_every_bound():
    region = Region(
        angle=1.0, angular_rate=2.0, angle_error=0.4, angular_rate_error=1.5, force=10.0
    )
    rng = np.random.default_rng(0)
    state, nominal = rng.uniform(-1.6, 1.6, (2, 4000, 4))
    state[:, 3] *= 1.6
    control = rng.uniform(-14.0, 14.0, (4000, 1))
    inside = region.contains(state, nominal, control)
    for x, x_d, u_d, answer in zip(state, nominal, control, inside, strict=True):
        expected = (
            abs(x[1]) <= 1.0
            and abs(x_d[1]) <= 1.0
            and abs(x[3]) <= 2.0
            and abs(x_d[3]) <= 2.0
            and abs(x[1] - x_d[1]) <= 0.4
            and abs(x[3] - x_d[3]) <= 1.5
            and abs(u_d[0]) <= 10.0
        )
        assert answer == expected
    assert 50 < inside.sum() < 3000


def test_region_bounds_each_quantity_and_neither_position_nor_speed():
    region = Region(
        angle=1.0, angular_rate=2.0, angle_error=0.4, angular_rate_error=1.5, force=10.0
    )
    zero, still = np.zeros(4), np.zeros(1)
    assert region.contains(np.array([1e3, 0.0, 1e3, 0.0]), zero, still)
    outside = {
        "state angle": ([0, 1.01, 0, 0], [0, 0.8, 0, 0], [0]),
        "nominal angle": ([0, 0.8, 0, 0], [0, 1.01, 0, 0], [0]),
        "state rate": ([0, 0, 0, 2.01], [0, 0, 0, 1.0], [0]),
        "nominal rate": ([0, 0, 0, 1.0], [0, 0, 0, -2.01], [0]),
        "angle error": ([0, 0.21, 0, 0], [0, -0.2, 0, 0], [0]),
        "rate error": ([0, 0, 0, 0.8], [0, 0, 0, -0.71], [0]),
        "force": ([0, 0, 0, 0], [0, 0, 0, 0], [-10.1]),
    }
    for name, triple in outside.items():
        state, nominal, control = (np.array(part, float) for part in triple)
        assert not region.contains(state, nominal, control), name


SMALL = MetricDesignSettings(plans=10, pool=300, checks=250, seed=3)


def test_design_from_nothing_is_verified_and_repeatable(system):
    metric = design_cartpole_metric(SMALL)
    again = design_cartpole_metric(SMALL)
    assert np.array_equal(metric.coefficients, again.coefficients)
    assert metric.verification == again.verification
    assert metric.region == SMALL.region
    assert metric.contraction_rate == SMALL.cvstem.contraction_rate
    assert (metric.verification.samples, metric.verification.seed) == (250, 3)
    other = design_cartpole_metric(replace(SMALL, seed=4))
    assert not np.array_equal(metric.coefficients, other.coefficients)


def test_design_and_check_share_no_episode(monkeypatch):
    seen = []

    def spy(function, place):
        def call(*arguments):
            seen.append(arguments[place].nominal[:, 1])
            return function(*arguments)

        return call

    monkeypatch.setattr(metric_design, "design_on_pool", spy(design_on_pool, 1))
    monkeypatch.setattr(metric_design, "verify_metric", spy(verify_metric, 2))
    metric_design.design_cartpole_metric(SMALL)
    pool, checks = seen
    assert (len(pool), len(checks)) == (300, 250)
    assert not np.any(np.isin(pool, checks))


def test_samples_of_the_tubes_fill_the_region_and_keep_to_it():
    triples = tube_samples(SMALL, CartPoleSettings(), 1, 400)
    assert triples.state.shape == (400, 4)
    inside = SMALL.region.contains(triples.state, triples.nominal, triples.nominal_control)
    assert np.all(inside)
    error = np.abs(triples.state - triples.nominal)
    # The box of errors is filled to its edges.
    assert error[:, 1].max() > 0.9 * SMALL.region.angle_error
    assert error[:, 3].max() > 0.9 * SMALL.region.angular_rate_error


@pytest.mark.parametrize("bad", [{"plans": 0}, {"pool": 0}, {"checks": 0}])
def test_design_settings_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        MetricDesignSettings(**bad)
