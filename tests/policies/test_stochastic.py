"""Mean-square bounds against exact covariances, brute-force Ito terms and simulated paths."""

from types import SimpleNamespace

import numpy as np
import pytest

from lagros_envs.dynamics import hold_step
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.contraction.control import error_energy
from lagros_policies.contraction.double_integrator import AxisMetric, design_axis
from lagros_policies.remarks.stochastic import (
    MeanSquareBound,
    held_mean_square,
    mean_square_bound,
    noisy_hold_step,
)
from lagros_policies.tasks.cartpole.region import Region
from lagros_policies.tasks.spacecraft.wrench_control import WrenchTracking
from tests.policies.shipped import shipped_metric

BODY, PERIOD = Spacecraft(), 0.1


def test_it_is_exact_for_a_linear_system_whose_metric_is_tight():
    # de = -alpha e dt + g dw, M = I: both inequalities are equalities, and E||e||^2 is known.
    alpha, g, start = 0.7, np.array([0.3, 0.1, 0.0, 0.2]), 1.5
    metric = SimpleNamespace(
        scaling=np.ones(4),
        region=Region(),
        contraction_rate=alpha,
        matrix=lambda states: np.broadcast_to(np.eye(4), (*states.shape[:-1], 4, 4)),
        matrix_rate=lambda states, motion: np.zeros((*states.shape[:-1], 4, 4)),
    )
    times = np.linspace(0.0, 5.0, 7)
    known = start * np.exp(-2 * alpha * times) + np.sum(g**2) / (2 * alpha) * (
        1.0 - np.exp(-2 * alpha * times)
    )
    without_angle = mean_square_bound(metric, g * [1, 0, 1, 1], start)
    assert without_angle.mean_square(times) == pytest.approx(
        known - 0.1**2 / (2 * alpha) * (1.0 - np.exp(-2 * alpha * times))
    )
    # ||e||^2 is E V over the least eigenvalue of M, wherever in the region that is.
    stiff = SimpleNamespace(
        **{
            **vars(metric),
            "matrix": lambda states: (
                np.diag([0.25, 4.0, 1.0, 1.0]) * np.cos(states[..., 1])[..., None, None]
            ),
        }
    )
    bound = mean_square_bound(stiff, g * [1, 0, 1, 1], start)
    least = 0.25 * np.cos(Region().angle)
    assert bound.least_eigenvalue == pytest.approx(least)
    assert bound.mean_square(times) == pytest.approx(bound.energy(times) / least)
    # With noise on the angle eps > 0 costs a little of the rate, but a constant metric nearly none.
    bound = mean_square_bound(metric, g, start).mean_square(times)
    assert np.all(bound >= known - 1e-12)
    assert bound == pytest.approx(known, rel=2e-3)


def test_ito_terms_of_the_shipped_metric_by_differences():
    metric, intensity = shipped_metric(), np.array([0.05, 0.02, 0.1, 0.1])
    bound = mean_square_bound(metric, intensity)
    rng = np.random.default_rng(0)
    state = rng.uniform(-1.0, 1.0, (4000, 4)) * [2.0, metric.region.angle - 0.01, 2.0, 3.0]
    error = rng.standard_normal((4000, 4)) * 10.0 ** rng.uniform(-3.0, 0.5, (4000, 1))
    nominal = state - error
    energy = error_energy(metric.matrix(state), error)
    step, generator = 1e-4, np.zeros(4000)
    for channel, g in enumerate(intensity):
        ahead, behind = state.copy(), state.copy()
        ahead[:, channel] += step
        behind[:, channel] -= step
        above = error_energy(metric.matrix(ahead), ahead - nominal)
        below = error_energy(metric.matrix(behind), behind - nominal)
        generator += 0.5 * g**2 * (above - 2.0 * energy + below) / step**2
    allowed = bound.power + 2.0 * (metric.contraction_rate - bound.rate) * energy
    assert np.all(generator <= allowed * (1.0 + 1e-4) + 1e-6)
    assert np.max(generator / allowed) > 0.3


def test_too_much_noise_of_the_angle_is_refused():
    with pytest.raises(ValueError, match="noise of x"):
        mean_square_bound(shipped_metric(), [0.0, 2.0, 0.0, 0.0])


@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_paths_of_the_spacecraft_stay_below_the_held_bound(rate):
    place, speed, steps, paths = 0.1, 0.2, 80, 600
    law = WrenchTracking(BODY, design_axis(rate), design_axis(0.3))
    bound = held_mean_square(law.plane, place, speed, steps)
    rng = np.random.default_rng(1)
    intensity = np.array([place, place, 0.0, speed, speed, 0.0])
    state = np.zeros((paths, 6))
    measured = np.zeros((3, steps + 1))
    for step in range(1, steps + 1):
        thrust = law.control(state, np.zeros(6), np.zeros(3))
        state = noisy_hold_step(BODY, state, thrust, PERIOD, intensity, rng, substeps=2)
        errors = np.stack([state[:, :2], state[:, 3:5]], axis=-1)
        energy = np.einsum("...ai,ij,...aj->...", errors, law.plane.matrix, errors)
        squares = np.sum(errors**2, axis=1)
        measured[:, step] = energy.mean(), squares[:, 0].mean(), squares.sum(axis=1).mean()
    # Four standard errors of a mean of squares over 600 paths.
    slack = 1.0 + 4.0 * np.sqrt(2.0 / paths)
    for values, limit in zip(measured, (bound.energy, bound.position, bound.state), strict=True):
        assert np.all(values <= slack * limit + 1e-12)
    # The energy is nowhere near zero: the bound says something.
    assert measured[0, -1] > 0.5 * bound.energy[-1]


def test_noise_of_one_hold_has_the_covariance_that_the_bound_feeds_in():
    place, speed, paths = 0.3, 0.5, 40_000
    intensity = np.array([place, place, 0.0, speed, speed, 0.0])
    rng = np.random.default_rng(2)
    state = noisy_hold_step(BODY, np.zeros((paths, 6)), np.zeros(8), 1.0, intensity, rng)
    seen = np.cov(state[:, [0, 3]].T)
    known = np.array([[place**2 + speed**2 / 3, speed**2 / 2], [speed**2 / 2, speed**2]])
    assert seen == pytest.approx(known, rel=0.05)
    # tr(M Q) of one axis, from the same covariance: one step from zero.
    metric = AxisMetric(1.0, 4.0, 0.5)
    covariance = np.array(
        [
            [place**2 * 0.5 + speed**2 * 0.125 / 3, speed**2 * 0.125],
            [speed**2 * 0.125, speed**2 * 0.5],
        ]
    )
    bound = held_mean_square(metric, place, speed, 1, axes=1)
    assert bound.energy[1] == pytest.approx(np.trace(metric.matrix @ covariance))


def test_without_noise_the_step_is_the_step():
    rng = np.random.default_rng(3)
    state = rng.uniform(-1.0, 1.0, (20, 4))
    force = rng.uniform(-5.0, 5.0, (20, 1))
    noisy = noisy_hold_step(CartPole(), state, force, PERIOD, np.zeros(4), rng)
    assert noisy == pytest.approx(hold_step(CartPole(), state, force, PERIOD), abs=1e-5)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: MeanSquareBound(0.0, 1.0, 1.0), "rate"),
        (lambda: MeanSquareBound(1.0, -1.0, 1.0), "power"),
        (lambda: mean_square_bound(shipped_metric(), [0.1, 0.1]), "intensity"),
        (lambda: held_mean_square(AxisMetric(1.0, 4.0, 0.0), 0.1, 0.1, 3), "period"),
        (lambda: held_mean_square(AxisMetric(1.0, 4.0), -0.1, 0.1, 3), "intensity"),
    ],
)
def test_wrong_values_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
