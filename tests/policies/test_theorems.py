"""The theorems as functions, against sampling, finite differences and their own derivation."""

from dataclasses import replace

import numpy as np
import pytest

from lagros_policies.contraction import Samples
from lagros_policies.contraction.condition import condition_left
from lagros_policies.contraction.theorems import (
    contraction_distance,
    disturbed_rate,
    feasibility_residual,
    tube_ball,
    tube_ellipsoid,
)
from lagros_policies.proof.bounds import metric_drift
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.lipschitz import lipschitz_constant


def test_the_drift_bounds_the_relative_slope_of_the_metric_closely(metric, constant_metric):
    drift = metric_drift(metric, 0.0, 0.8)
    states = np.zeros((801, 4))
    states[:, 1] = np.linspace(-0.8, 0.8, 801)
    step = 1e-6
    ahead, behind = states.copy(), states.copy()
    ahead[:, 1] += step
    behind[:, 1] -= step
    slope = (metric.dual(ahead) - metric.dual(behind)) / (2 * step)
    relative = np.linalg.solve(metric.dual(states), slope)
    largest = np.abs(np.linalg.eigvals(relative)).max()
    assert largest <= drift * (1 + 1e-6)
    assert drift <= 1.25 * largest
    assert metric_drift(constant_metric, 0.0, 0.8) == 0.0


@pytest.mark.parametrize(("constant", "slope"), [(0.5, 1.4), (2.0, -1.4)])
def test_the_drift_of_few_cells_is_a_bound_or_an_error(metric, constant, slope):
    """A metric that shrinks, or grows, with the angle: midpoints alone would say too little."""
    coefficients = np.stack([constant * np.eye(4), slope * np.eye(4)])
    plain = replace(metric, coefficients=coefficients)
    angle = np.linspace(0.0, 0.8, 2001)
    largest = np.abs(slope * np.sin(angle) / (constant + slope * np.cos(angle))).max()
    proved = 0
    for cells in (1, 2, 4, 8, 64, 1000):
        try:
            assert metric_drift(plain, 0.0, 0.8, cells) >= largest
        except ValueError:
            continue
        proved += 1
    assert proved > 0


def test_the_disturbed_rate_is_what_the_worst_error_needs(metric, oracle):
    """At the angle and the error that feel the disturbance most, 2 lost V is what it adds."""
    angle = np.linspace(0.0, 0.8, 801)
    states = np.zeros((801, 4))
    states[:, 1] = angle
    turn = np.array([0.0, 1.0, 0.0, 0.0])
    dual, slope = metric.dual(states), metric.dual_rate(states, turn)
    values = np.abs(np.linalg.eigvals(np.linalg.solve(dual, slope)).real).max(axis=1)
    place = int(np.argmax(values))
    pairs, vectors = np.linalg.eig(np.linalg.solve(dual[place], slope[place]))
    pull = vectors[:, np.argmax(np.abs(pairs))].real
    error = dual[place] @ pull / np.linalg.norm(dual[place] @ pull)
    here, h = np.array([0.0, angle[place], 0.0, 0.0]), 1e-6
    push = np.array([0.0, 0.3, 0.0, 0.0])
    ahead, back = (here + side * h * push for side in (1.0, -1.0))
    moved = oracle.energy(metric, ahead, ahead - error) - oracle.energy(metric, back, back - error)
    added, energy = abs(float(moved)) / (2 * h), float(oracle.energy(metric, here, here - error))
    lost = metric.contraction_rate - disturbed_rate(metric, metric_drift(metric, 0.0, 0.8), 0.3)
    assert added <= 2.0 * lost * energy * (1 + 1e-4) <= 1.3 * added


def test_the_disturbed_rate_covers_what_moves_the_metric(metric, oracle):
    """dV/dt under a disturbance of the angle exceeds the paper's bound, and not ours."""
    drift, bound = metric_drift(metric, 0.0, 0.8), 0.3
    rng = np.random.default_rng(2)
    state = rng.uniform(-0.4, 0.4, (4000, 4))
    nominal = state - rng.uniform(-0.3, 0.3, (4000, 4))
    h = 1e-6
    push = np.zeros((4000, 4))
    push[:, 1] = bound * rng.choice([-1.0, 1.0], 4000)
    # What the disturbance adds to dV/dt, by moving x alone and keeping e.
    moved = oracle.energy(metric, state + h * push, nominal + h * push)
    back = oracle.energy(metric, state - h * push, nominal - h * push)
    added = (moved - back) / (2 * h)
    energy = oracle.energy(metric, state, nominal)
    lost = metric.contraction_rate - disturbed_rate(metric, drift, bound)
    assert np.all(added <= 2.0 * lost * energy + 1e-7)
    assert added.max() > 0.0


def test_the_lipschitz_constant_encloses_sampled_norms(system, oracle):
    box = ProofBox(0.7, 1.0, 2.0, 6.0)
    found = lipschitz_constant(system, box, cells=500)
    rng = np.random.default_rng(0)
    state = rng.uniform(-1, 1, (4000, 4)) * [1.0, 0.7, 1.0, 2.0]
    force = rng.choice([-6.0, 6.0], (4000, 1))
    slope = oracle.jacobian(lambda x: oracle.rates(x, force), state)
    norms = np.linalg.norm(slope, ord=2, axis=(1, 2))
    growth = np.linalg.eigvalsh(0.5 * (slope + np.swapaxes(slope, 1, 2)))[:, -1]
    assert norms.max() <= found.upper
    assert 0.9 * found.lower <= norms.max()
    assert found.lower <= found.upper <= 1.1 * found.lower
    assert growth.max() <= found.growth <= found.upper


def test_few_cells_make_the_lipschitz_constant_larger_not_smaller(system, oracle):
    box = ProofBox(0.7, 1.0, 2.0, 6.0)
    state = np.zeros((2001, 4))
    state[:, 1] = np.linspace(-0.7, 0.7, 2001)
    corners = [(force, speed) for force in (-6.5, 6.5) for speed in (-2.0, 2.0)]
    largest = growth = 0.0
    for force, speed in corners:
        state[:, 3] = speed
        u = np.full((2001, 1), force)
        slope = oracle.jacobian(lambda x, u=u: oracle.rates(x, u), state)
        largest = max(largest, np.linalg.norm(slope, ord=2, axis=(1, 2)).max())
        symmetric = 0.5 * (slope + np.swapaxes(slope, 1, 2))
        growth = max(growth, np.linalg.eigvalsh(symmetric)[:, -1].max())
    for cells in (2, 5, 11):
        found = lipschitz_constant(system, box, cells)
        assert largest <= found.upper
        assert growth <= found.growth


def test_a_box_with_a_lean_is_refused(system):
    with pytest.raises(ValueError, match="lean"):
        lipschitz_constant(system, replace(ProofBox(0.3, 1.0, 1.0, 1.0), lean=1.0))


def gain_residual(system, metric, samples, share=1.0):
    """Theorem 2's condition for K = -share B'M, over the trace: 1/2 is the display in its proof."""
    weighed = replace(metric, control_weight=share * metric.control_weight)
    left = condition_left(system, weighed, samples)
    dual = metric.dual(samples.state)
    return np.linalg.eigvalsh(left)[:, -1] / np.trace(dual, axis1=-2, axis2=-1)


@pytest.mark.parametrize("share", [0.5, 1.0, 2.0])
def test_the_gain_of_the_proof_gives_minus_two_nu(share, system, metric, samples, oracle):
    """W (dM/dt + 2 sym(M A + M B K) + 2 alpha M) W nu, from M and K themselves."""
    few = samples.take(np.arange(50))
    state, nominal, control = few.state, few.nominal, few.nominal_control
    nu = metric.control_weight
    big = nu * np.linalg.inv(metric.dual(state))
    gain = oracle.input_matrix(state)
    feedback = -share * np.swapaxes(gain, 1, 2) @ big
    slope = oracle.sdc(state, nominal, control)
    inner = big @ (slope + gain @ feedback)
    h = 1e-6
    turned = state.copy()
    turned[:, 1] += h * state[:, 3]
    behind = state.copy()
    behind[:, 1] -= h * state[:, 3]
    rate = (np.linalg.inv(metric.dual(turned)) - np.linalg.inv(metric.dual(behind))) * nu / (2 * h)
    left = rate + inner + np.swapaxes(inner, 1, 2) + 2 * metric.contraction_rate * big
    dual = metric.dual(state)
    congruent = dual @ left @ dual / nu
    expected = np.linalg.eigvalsh(congruent)[:, -1] / np.trace(dual, axis1=1, axis2=2)
    found = gain_residual(system, metric, few, share)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


def test_the_display_in_the_proof_is_stronger_than_the_equation(system, metric, samples):
    equation = gain_residual(system, metric, samples, 1.0)
    display = gain_residual(system, metric, samples, 0.5)
    assert np.all(equation <= display + 1e-12)
    assert equation.max() < 0.0
    # Not the reverse: a nu for which the equation holds and the display does not.
    tight = metric
    while (
        gain_residual(
            system, replace(tight, control_weight=0.7 * tight.control_weight), samples
        ).max()
        < 0
    ):
        tight = replace(tight, control_weight=0.7 * tight.control_weight)
    assert gain_residual(system, tight, samples, 1.0).max() < 0.0
    assert gain_residual(system, tight, samples, 0.5).max() > 0.0


def test_the_program_for_the_control_is_feasible_where_the_condition_holds(system, metric, pool):
    assert feasibility_residual(system, metric, pool).max() <= 1e-9
    wrong = replace(metric, control_weight=1e-3 * metric.control_weight)
    assert feasibility_residual(system, wrong, pool).max() > 0.0


def test_the_distance_is_that_of_the_nearest_control_that_contracts(system, metric, pool, oracle):
    few = pool.take(np.arange(40))
    control = few.nominal_control + np.linspace(-8.0, 8.0, 40)[:, None]
    distance = contraction_distance(system, metric, few, control)
    assert np.any(distance == 0.0)
    assert np.any(distance > 0.1)
    for index in range(40):
        state, nominal = few.state[index], few.nominal[index]

        def excess(force, state=state, nominal=nominal, index=index):
            args = (metric, state, nominal, few.nominal_control[index], force)
            energy = oracle.energy(metric, state, nominal)
            return oracle.energy_rate(*args) + 2 * metric.contraction_rate * energy

        near = [control[index] + side * distance[index] for side in (-1.0, 1.0)]
        scale = abs(excess(control[index])) + 1e-6
        # At that distance, on one side or the other, a control contracts; nearer by, none does.
        assert min(excess(force) for force in near) <= 1e-4 * scale
        if distance[index] > 1e-3:
            closer = [control[index] + 0.99 * side * distance[index] for side in (-1.0, 1.0)]
            assert min(excess(force) for force in closer) > 0.0


def test_states_fill_the_ball_and_the_ellipsoid_evenly():
    rng = np.random.default_rng(1)
    nominal = rng.standard_normal((40_000, 4))
    radius = rng.uniform(0.0, 2.0, 40_000)
    shares = np.linalg.norm(tube_ball(rng, nominal, radius) - nominal, axis=1) / radius
    assert shares.max() <= 1.0 + 1e-12
    # Uniform in four dimensions: the fourth power of the share is uniform in [0, 1].
    assert np.mean(shares**4) == pytest.approx(0.5, abs=0.01)
    root = rng.standard_normal((4, 4))
    dual = root @ root.T + np.eye(4)
    error = tube_ellipsoid(rng, nominal, dual, np.full(40_000, 2.0)) - nominal
    energy = np.sum(np.linalg.solve(dual, error.T).T * error, axis=1)
    assert energy.max() <= 2.0 * (1 + 1e-9)
    # Uniform in an ellipsoid: the covariance is W energy / (n + 2).
    np.testing.assert_allclose(error.T @ error / 40_000, dual * 2.0 / 6.0, atol=0.06)


def test_negative_radii_are_refused():
    with pytest.raises(ValueError, match="radius"):
        tube_ball(np.random.default_rng(0), np.zeros((1, 4)), np.array([-1.0]))


def test_samples_are_what_the_residuals_take(system, metric):
    one = Samples(np.full((1, 4), 0.1), np.zeros((1, 4)), np.zeros((1, 1)))
    assert gain_residual(system, metric, one).shape == (1,)
    assert feasibility_residual(system, metric, one).shape == (1,)
