"""The proof of contraction: it accepts what holds, and nothing that was seen to fail."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lagros_envs.dynamics import CartPole
from lagros_policies.contraction import Samples, contraction_residual, load_metric
from lagros_policies.contraction.intervals import Interval, negative_definite
from lagros_policies.contraction.prove import (
    ProofBox,
    largest_proved,
    prove_bounds,
    prove_contraction,
)

SMALL = ProofBox(0.1, 0.5, 0.5, 0.5, angle_error=0.05, angular_rate_error=0.2)


@pytest.fixture(scope="module")
def shipped():
    return load_metric()


def draw(box, count, seed):
    """Return triples (x, x_d, u_d) of the box, at its faces more often than inside."""
    rng = np.random.default_rng(seed)
    half = np.array([1.0, box.angle, box.velocity, box.angular_rate])
    error = np.array([1.0, box.angle_error, 9.0, box.angular_rate_error])
    parts = np.clip(rng.uniform(-1.5, 1.5, (2, count, 4)), -1.0, 1.0)
    state = parts[0] * half
    nominal = np.clip(state + parts[1] * error, -half, half)
    control = np.clip(rng.uniform(-1.5, 1.5, (count, 1)), -1.0, 1.0) * box.force
    return Samples(state, nominal, control)


def test_the_shipped_metric_is_proved_around_the_upright_and_samples_agree(system, shipped):
    proof = prove_contraction(system, shipped, SMALL)
    assert proof.proved
    assert proof.violation is None
    assert proof.undecided is None
    assert contraction_residual(system, shipped, draw(SMALL, 5000, 0)).max() < 0.0


def stretched(metric):
    scale = np.array([1.0, 1.0, 3.0, 1.0])
    return replace(metric, coefficients=metric.coefficients * scale[:, None] * scale[None, :])


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(stretched, id="scaled in one direction"),
        pytest.param(lambda m: replace(m, contraction_rate=0.6), id="larger alpha"),
        pytest.param(lambda m: replace(m, control_weight=1e-9), id="no control"),
        pytest.param(lambda m: replace(m, coefficients=-m.coefficients), id="negative"),
    ],
)
def test_bad_metrics_are_refused_with_a_point_that_fails(system, shipped, oracle, spoil):
    metric = spoil(shipped)
    proof = prove_contraction(system, metric, SMALL)
    assert not proof.proved
    point = proof.violation
    assert point is not None
    # The point again, by the oracle's own Jacobian.
    slope = oracle.jacobian(lambda x: oracle.rates(x, point.control), point.nominal)
    gain, dual = oracle.input_matrix(point.state), metric.dual(point.state)
    left = slope @ dual + dual @ slope.T - metric.dual_rate(point.state)
    left += 2 * metric.contraction_rate * dual - 2 * metric.control_weight * gain @ gain.T
    assert np.linalg.eigvalsh(left).max() > 0.0


@settings(max_examples=8)
@given(st.floats(0.02, 0.6), st.floats(0.0, 2.0), st.floats(0.0, 4.0), st.floats(0.1, 0.7))
def test_no_box_with_a_sampled_failure_is_proved(angle, speed, force, alpha):
    system, metric = CartPole(), load_metric()
    box = ProofBox(angle, speed, speed, force, 0.2 * angle, 0.2 * speed)
    samples = draw(box, 2000, 3)
    worst = contraction_residual(system, replace(metric, contraction_rate=alpha), samples).max()
    proof = prove_contraction(system, metric, box, alpha, most_boxes=300, most_seconds=5.0)
    assert not (proof.proved and worst > 0.0)
    assert proof.violation is None or not proof.proved


def test_giving_up_is_not_a_proof_and_names_a_box(system, shipped):
    proof = prove_contraction(system, shipped, SMALL, most_boxes=1)
    assert not proof.proved
    assert proof.undecided.shape == (2, 6)
    assert np.all(proof.undecided[0] <= proof.undecided[1])


@pytest.mark.slow
def test_the_largest_box_is_proved_and_smaller_than_one_that_fails(system, shipped):
    whole = ProofBox(0.4, 2.0, 2.0, 4.0, 0.1, 0.5)
    found = largest_proved(system, shipped, whole, rounds=3, most_seconds=90.0)
    assert found.proved
    assert 0.0 < found.box.angle < whole.angle


@given(st.integers(0, 10**6), st.floats(0.0, 0.5))
def test_definite_interval_matrices_have_definite_members(seed, radius):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((4, 4))
    middle = -root @ root.T - 0.3 * np.eye(4)
    if negative_definite(Interval(middle - radius, middle + radius)):
        # The extreme members (vertices s_i s_j radius) decide for symmetric matrices.
        for signs in np.ndindex(2, 2, 2, 2):
            s = 2.0 * np.array(signs) - 1.0
            assert np.linalg.eigvalsh(middle + radius * np.outer(s, s)).max() < 0.0
    assert radius > 0.05 or bool(negative_definite(Interval(middle, middle)))


def test_bounds_enclose_those_of_a_grid_closely(system, shipped, oracle):
    bounds = prove_bounds(system, shipped, 0.9, cells=500)
    states = np.zeros((801, 4))
    states[:, 1] = np.linspace(-0.9, 0.9, 801)
    scaled = shipped.dual(states) * shipped.scaling[:, None] * shipped.scaling[None, :]
    values = np.linalg.eigvalsh(scaled)
    assert values.min() - 1.0 < bounds.least <= values.min()
    assert values.max() <= bounds.largest < values.max() + 1.0
    assert bounds.condition >= values.max() / values.min()
    norms = np.linalg.norm(oracle.input_matrix(states), axis=(1, 2))
    assert norms.max() <= bounds.control_gain < norms.max() * 1.01


def test_bounds_of_a_matrix_that_is_not_positive_are_refused(system, shipped):
    with pytest.raises(ValueError, match="not shown to be positive"):
        prove_bounds(system, replace(shipped, coefficients=-shipped.coefficients), 0.5, cells=50)


def test_impossible_boxes_are_refused():
    with pytest.raises(ValueError, match=r"angle=1\.6"):
        ProofBox(1.6, 1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="force=-1"):
        ProofBox(0.5, 1.0, 1.0, -1.0)
