"""One metric and one gain for all plans: what they promise, in flight and at samples."""

import numpy as np
import pytest

from lagros_envs.balls import onto_unit_sphere
from lagros_envs.dynamics import hold_step, linearise_hold
from lagros_policies.contraction import InfeasibleError
from lagros_policies.contraction.basis import harmonics
from lagros_policies.contraction.sampled import SampledDesign, design_sampled, push_slope
from tests.policies.toys import Car, Puck

PERIOD, WEIGHTS = 0.1, (1.0, 1.0, 0.2, 0.2)


@pytest.fixture(scope="module")
def puck():
    states, controls = np.zeros((3, 4)), np.zeros((3, 2))
    return design_sampled(Puck(), PERIOD, states, controls, SampledDesign(0.5, WEIGHTS, 0.05))


def test_no_flight_of_a_linear_system_leaves_the_ellipsoid(puck):
    """The puck is linear, so that what holds to first order holds."""
    dual, gain = puck.dual(np.zeros(4)), puck.gain(np.zeros(4))
    bound, rng = 0.3, np.random.default_rng(0)
    error, worst = np.zeros((2000, 4)), 0.0
    inverse = np.linalg.inv(dual)
    kept = onto_unit_sphere(rng.standard_normal((2000, 4)), np.eye(4)[0])
    for step in range(80):
        if step % 20 == 0:
            kept = onto_unit_sphere(rng.standard_normal((2000, 4)), np.eye(4)[0])
        climbing = onto_unit_sphere(error @ inverse, np.eye(4)[0])
        push = np.where(np.arange(2000)[:, None] % 2, kept, climbing)
        error = hold_step(Puck(), error, error @ gain.T, PERIOD, bound * push)
        energy = np.einsum("si,ij,sj->s", error, inverse, error)
        worst = max(worst, float(energy.max()) / bound**2)
        assert np.all(np.abs(error) <= bound * np.sqrt(np.diagonal(dual)))
    assert 0.2 < worst <= 1.0


def test_a_dearer_control_is_a_smaller_gain_and_a_wider_tube(puck):
    states, controls = np.zeros((3, 4)), np.zeros((3, 2))
    dear = design_sampled(Puck(), PERIOD, states, controls, SampledDesign(0.5, WEIGHTS, 5.0))
    place = np.zeros(4)
    assert np.linalg.norm(dear.gain(place)) < np.linalg.norm(puck.gain(place))
    cost = [np.trace(np.diag(WEIGHTS) @ one.dual(place)) for one in (puck, dear)]
    assert cost[0] < cost[1]


def test_the_condition_holds_at_all_samples_though_few_are_in_the_program():
    rng = np.random.default_rng(1)
    count = 400
    states = np.zeros((count, 4))
    states[:, 2], states[:, 3] = rng.uniform(-1.5, 1.5, count), rng.uniform(1.0, 2.0, count)
    controls = rng.uniform(-0.5, 0.5, (count, 2))
    basis = harmonics(2, 2)
    rate = 0.3
    found = design_sampled(
        Car(), PERIOD, states, controls, SampledDesign(rate, (1.0, 1.0, 0.3, 0.3), 0.1, basis)
    )
    following, by_state, by_control = linearise_hold(Car(), states, controls, PERIOD)
    metric = np.linalg.inv(found.dual(states))
    after = np.linalg.inv(found.dual(following))
    closed = by_state + by_control @ found.gain(states)
    left = np.exp(-2.0 * rate * PERIOD) * metric - np.swapaxes(closed, 1, 2) @ after @ closed
    assert np.linalg.eigvalsh(left).min() > -1e-5 * np.abs(metric).max()


def test_the_slope_by_the_push_is_that_of_differences():
    rng = np.random.default_rng(2)
    states, controls = rng.standard_normal((5, 4)), rng.standard_normal((5, 2))
    found = push_slope(Car(), states, controls, PERIOD)
    for column in range(4):
        push = 1e-5 * np.eye(4)[column]
        ends = [hold_step(Car(), states, controls, PERIOD, sign * push) for sign in (1.0, -1.0)]
        assert found[..., column] == pytest.approx((ends[0] - ends[1]) / 2e-5, abs=1e-8)


def test_a_rate_that_no_gain_reaches_is_refused():
    states, controls = np.zeros((3, 4)), np.zeros((3, 2))
    # At rest the car cannot be steered sideways.
    with pytest.raises(InfeasibleError, match="lower the rate, or take a richer basis"):
        design_sampled(Car(), PERIOD, states, controls, SampledDesign(0.5, WEIGHTS))
