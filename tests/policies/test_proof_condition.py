"""The proof of contraction: it accepts what holds, and nothing that was seen to fail."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lagros_policies
from lagros_envs.numbers import Interval
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction import Samples, contraction_residual, load_metric
from lagros_policies.proof.bounds import prove_bounds
from lagros_policies.proof.condition import largest_proved, prove_contraction
from lagros_policies.proof.matrices import negative_definite
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.proof import PROVED_BOX, angle_box, prove_cartpole
from lagros_policies.tasks.cartpole.region import Region
from tests.policies.foreign import Pvtol
from tests.policies.shipped import shipped_metric

PROVED = Path(lagros_policies.__file__).parent / "pretrained" / "cartpole_proved_metric.json"
SMALL = ProofBox(0.1, 0.5, 0.5, 0.5, angle_error=0.05, angular_rate_error=0.2)


@pytest.fixture(scope="module")
def shipped():
    return shipped_metric()


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


def thin(metric):
    """Return a metric that is positive definite at the angles of its region, and not beyond."""
    coefficients = metric.coefficients.copy()
    # Less a multiple of 1 - cos(theta).
    coefficients[0] -= 1e6 * np.eye(4)
    coefficients[1] += 1e6 * np.eye(4)
    return replace(metric, coefficients=coefficients, region=Region(angle=1e-6))


def stretched(metric):
    scale = np.array([1.0, 1.0, 3.0, 1.0])
    return replace(metric, coefficients=metric.coefficients * scale[:, None] * scale[None, :])


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(stretched, id="scaled in one direction"),
        pytest.param(lambda m: replace(m, contraction_rate=0.6), id="larger alpha"),
        pytest.param(lambda m: replace(m, control_weight=1e-9), id="no control"),
        pytest.param(thin, id="not positive"),
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
    left = (
        slope @ dual
        + dual @ slope.T
        - metric.dual_rate(point.state, oracle.rates(point.state, point.control))
    )
    left += 2 * metric.contraction_rate * dual - 2 * metric.control_weight * gain @ gain.T
    assert np.linalg.eigvalsh(left).max() > 0.0


@settings(max_examples=6)
@given(st.floats(0.02, 0.6), st.floats(0.0, 2.0), st.floats(0.0, 4.0), st.floats(0.1, 0.7))
def test_no_box_with_a_sampled_failure_is_proved(angle, speed, force, alpha):
    system, metric = CartPole(), shipped_metric()
    box = ProofBox(angle, speed, speed, force, 0.2 * angle, 0.2 * speed)
    samples = draw(box, 1000, 3)
    worst = contraction_residual(system, replace(metric, contraction_rate=alpha), samples).max()
    proof = prove_contraction(system, metric, box, alpha, most_boxes=300, most_seconds=3.0)
    assert not (proof.proved and worst > 0.0)
    assert proof.violation is None or not proof.proved


def test_giving_up_is_not_a_proof_and_names_a_box(system, shipped):
    proof = prove_contraction(system, shipped, SMALL, most_boxes=1)
    assert not proof.proved
    assert proof.undecided.shape == (2, 5)
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
    bounds = prove_bounds(system, shipped, *angle_box(0.9), cells=500)
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
        prove_bounds(system, thin(shipped), *angle_box(0.5), cells=50)


def test_impossible_boxes_are_refused():
    with pytest.raises(ValueError, match=r"angle=1\.6"):
        ProofBox(1.6, 1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="force=-1"):
        ProofBox(0.5, 1.0, 1.0, -1.0)


@pytest.fixture(scope="module")
def proved():
    return load_metric(PROVED)


def left_side(oracle, metric, state, other, control, alpha):
    """Return the left side of (**) at points by the oracle's own Jacobian."""
    slope = oracle.jacobian(lambda x: oracle.rates(x, control), other)
    gain, dual = oracle.input_matrix(state), metric.dual(state)
    product = slope @ dual
    left = (
        product
        + np.swapaxes(product, -1, -2)
        - metric.dual_rate(state, oracle.rates(state, control))
    )
    left -= 2.0 * metric.control_weight * gain @ np.swapaxes(gain, -1, -2)
    return left + 2.0 * alpha * dual


def test_the_shipped_metric_meets_equation_14_at_triples_anywhere_in_its_box(system, proved):
    samples = draw(PROVED_BOX, 5000, 5)
    assert contraction_residual(system, proved, samples).max() < 0.0


def test_what_the_shipped_file_claims(proved):
    record = json.loads(PROVED.read_text())["proved"]
    assert all(part["holds"] and part["kind"] == "proved" for part in record["statements"])
    assert record["settings"]["box"]["angle"] >= 0.9
    assert record["settings"]["box"]["velocity"] >= 1.5
    assert record["settings"]["box"]["angular_rate"] >= 1.5
    assert proved.contraction_rate >= 0.5
    assert any(
        "(14)" in part["text"] and "anywhere" in part["text"] for part in record["statements"]
    )


def test_a_failure_in_a_tiny_corner_is_refused(oracle, system, proved):
    """Raise alpha until the condition fails next to one vertex of the box, and nowhere else."""
    box = ProofBox(0.9, 1.5, 1.5, 1.0)
    edge = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0
    angles = np.repeat(np.linspace(0.0, 0.9, 201), 8)
    states = np.zeros((len(angles), 4))
    states[:, 1] = angles
    states[:, 2:] = 1.5 * np.tile(edge[:, :2], (201, 1))
    control = np.tile(edge[:, 2:], (201, 1))
    left = left_side(oracle, proved, states, states, control, 0.0)
    root = np.linalg.inv(np.linalg.cholesky(proved.dual(states)))
    worst = np.linalg.eigvalsh(root @ left @ np.swapaxes(root, -1, -2))[:, -1]
    limit = -0.5 * worst.max()
    inside = draw(box, 4000, 2)
    inside = replace(inside, nominal=inside.state)
    above = replace(proved, contraction_rate=limit + 2e-4)
    assert np.mean(contraction_residual(system, above, inside) > 0.0) < 0.02
    assert prove_contraction(system, proved, box, limit - 0.02).proved
    refused = prove_contraction(system, proved, box, limit + 2e-4)
    assert not refused.proved
    assert refused.violation is not None


def test_the_statements_of_a_small_box_hold_and_those_of_a_bad_metric_do_not(system, proved):
    box = ProofBox(0.3, 0.5, 0.5, 0.5)
    good = prove_cartpole(proved, box, system)
    assert [part.holds for part in good.statements] == [True, True]
    assert "x_d = x" in good.statements[0].text
    bad = prove_cartpole(thin(proved), box, system)
    assert [part.holds for part in bad.statements] == [False, False]
    assert bad.statements[0].verdict == "NO"
    # Time that is up shows nothing.
    late = prove_cartpole(proved, PROVED_BOX, system, most_seconds=0.0).statements[0]
    assert (late.holds, late.verdict) == (False, "not shown")


def test_other_systems_are_refused(proved):
    with pytest.raises(TypeError, match="CartPole"):
        prove_contraction(Pvtol(), proved, SMALL)


@pytest.mark.slow
def test_the_shipped_proof_can_be_made_again(system, proved):
    found = prove_contraction(system, proved, PROVED_BOX, most_seconds=300.0)
    assert found.proved
    # Figures of benchmarks/studies/proofs.md.
    assert found.boxes < 2000
    # Sampling with an optimiser finds 0.55498 1/s to be the largest rate, at a vertex of the box.
    assert prove_contraction(system, proved, PROVED_BOX, 0.5549, most_seconds=300.0).proved
    refused = prove_contraction(system, proved, PROVED_BOX, 0.5551, most_seconds=300.0)
    assert refused.violation is not None
