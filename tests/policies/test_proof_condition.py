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
from lagros_policies.contraction import Region, Samples, contraction_residual, load_metric
from lagros_policies.proof.condition import (
    ProofBox,
    largest_proved,
    prove_bounds,
    prove_contraction,
)
from lagros_policies.proof.matrices import negative_definite
from lagros_policies.proof.rates import rate_condition
from lagros_policies.tasks.cartpole.proof import PROVED_BOX, prove_cartpole

PROVED = Path(lagros_policies.__file__).parent / "pretrained" / "cartpole_proved_metric.json"
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
    system, metric = CartPole(), load_metric()
    box = ProofBox(angle, speed, speed, force, 0.2 * angle, 0.2 * speed)
    samples = draw(box, 1000, 3)
    worst = contraction_residual(system, replace(metric, contraction_rate=alpha), samples).max()
    proof = prove_contraction(system, metric, box, alpha, most_boxes=300, most_seconds=3.0)
    assert not (proof.proved and worst > 0.0)
    assert proof.violation is None or not proof.proved


def test_giving_up_is_not_a_proof_and_names_a_box(system, shipped):
    proof = prove_contraction(system, shipped, SMALL, most_boxes=1)
    assert not proof.proved
    assert proof.undecided.shape == (2, 3)
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
        prove_bounds(system, thin(shipped), 0.5, cells=50)


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


@pytest.mark.parametrize("apart", [True, False])
def test_the_matrix_between_corners_is_within_the_remainder(oracle, system, proved, apart):
    box = PROVED_BOX if apart else ProofBox(0.9, 1.5, 1.5, 1.0, 0.3, 0.5)
    condition = rate_condition(system, proved, box, 0.5)
    rng = np.random.default_rng(0)
    low = rng.uniform([0.0, -0.3, -1.4], [0.7, 0.2, 1.2], (30, 3))
    cells = Interval(low, low + np.array([0.1, 0.1, 0.15]))
    found = condition.examine(cells)
    reach = sum(np.maximum(np.abs(p.lower), np.abs(p.upper)) for p in found.remainders)
    choices = condition._choices(cells)
    corners = found.corners.midpoint.reshape(30, len(choices), 2, 2, 4, 4)
    for _ in range(10):
        x, s = rng.random((2, 30))
        states, others = np.zeros((2, 30, 4))
        states[:, 1] = cells.lower[:, 0] + 0.1 * x
        others[:, 1] = cells.lower[:, 1] + 0.1 * s + (0.0 if apart else states[:, 1])
        index = rng.choice([i for i, choice in enumerate(choices) if choice.real])
        choice = choices[index]
        states[:, 3], others[:, 3] = choice.rate, choice.other_rate
        one = np.stack([1.0 - x, x], axis=-1)
        two = np.stack([1.0 - s, s], axis=-1)
        linear = np.einsum("ka,kb,kabij->kij", one, two, corners[:, index])
        true = left_side(oracle, proved, states, others, choice.push[:, None], 0.5)
        assert np.all(np.abs(true - linear) <= reach + 1e-5)


@pytest.mark.parametrize("apart", [True, False])
def test_remainders_are_second_derivatives_by_differences(oracle, system, proved, apart):
    """With thin cells and nothing else that varies they are numbers: along x, and along y."""
    box = ProofBox(0.9, 0.0, 0.0, 0.0, 1.8 if apart else 0.3, 0.0)
    condition = rate_condition(system, proved, box, 0.5)
    rng = np.random.default_rng(3)
    angle, gap = rng.uniform(0.1, 0.6, 20), rng.uniform(-0.25, 0.25, 20)
    width, step = 1e-5, 1e-3
    low = np.stack([angle, gap, np.zeros(20)], axis=1)
    cells = Interval(low, low + np.array([width, width, 0.0]))

    def at(first, second):
        states, others = np.zeros((2, 20, 4))
        states[:, 1] = first
        others[:, 1] = second if apart else first + second
        return left_side(oracle, proved, states, others, np.zeros((20, 1)), 0.5)

    shifts = ((step, 0.0), (0.0, step))
    for part, shift in zip(condition.examine(cells).remainders, shifts, strict=True):
        ahead, behind = at(angle + shift[0], gap + shift[1]), at(angle - shift[0], gap - shift[1])
        second = (ahead - 2.0 * at(angle, gap) + behind) / step**2
        found = part.midpoint * 8.0 / width**2
        scale = 1.0 + np.abs(second).max(axis=(1, 2), keepdims=True)
        assert np.abs((found - second) / scale).max() < 2e-3


@pytest.mark.parametrize(
    "box",
    [
        pytest.param(ProofBox.apart(0.9, 1.5, 1.5, 9.0), id="apart"),
        pytest.param(ProofBox(0.9, 1.5, 1.5, 9.0, 0.3, 0.5), id="near"),
        pytest.param(ProofBox(0.9, 1.5, 1.5, 1.0, lean=1.0), id="leaning"),
    ],
)
def test_remainders_enclose_second_derivatives_at_any_force_and_rate(oracle, system, proved, box):
    condition = rate_condition(system, proved, box, 0.5)
    rng = np.random.default_rng(8)
    angle = rng.uniform(0.1, 0.8, 60)
    gap = rng.uniform(-0.25, 0.25, 60) * (box.angle_error > 0.0)
    width, step = 1e-5, 1e-3
    low = np.stack([angle, gap, np.full(60, -1.5)], axis=1)
    found = condition.examine(Interval(low, low + np.array([width, width, 3.0]))).remainders
    rate, speed, drive = np.clip(rng.uniform(-2.0, 2.0, (3, 60)), -1.0, 1.0)
    turn = np.clip(1.5 * rate + box.angular_rate_error * rng.uniform(-1, 1, 60), -1.5, 1.5)
    share = box.lean * rng.choice([0.0, 1.0], 60)
    apart = box.angle_error >= 2.0 * box.angle

    def at(first, second):
        states, others = np.zeros((2, 60, 4))
        states[:, 1], states[:, 3] = first, turn
        others[:, 1] = second if apart else first + second
        others[:, 2], others[:, 3] = 1.5 * speed, 1.5 * rate
        force = box.force * drive + share * 1.1 * 9.8 * np.tan(others[:, 1])
        return left_side(oracle, proved, states, others, force[:, None], 0.5)

    for part, (one, two) in zip(found, ((step, 0.0), (0.0, step)), strict=True):
        ahead, behind = at(angle + one, gap + two), at(angle - one, gap - two)
        second = (ahead - 2.0 * at(angle, gap) + behind) / step**2
        slack = 2e-3 * (1.0 + np.abs(second).max(axis=(1, 2), keepdims=True))
        assert np.all(part.lower * 8.0 / width**2 - slack <= second)
        assert np.all(second <= part.upper * 8.0 / width**2 + slack)


@pytest.mark.parametrize(
    "box",
    [
        pytest.param(PROVED_BOX, id="apart"),
        pytest.param(ProofBox(0.9, 1.5, 1.5, 1.0, 0.3, 0.5), id="near"),
        pytest.param(ProofBox(0.9, 1.5, 1.5, 1.0, lean=1.0), id="differential"),
    ],
)
def test_every_point_of_the_set_lies_in_a_cell_that_counts(system, proved, box):
    condition = rate_condition(system, proved, box, 0.5)
    cells = condition.start()
    counts = cells[~condition.examine(cells).empty]
    samples = draw(box, 3000, 7)
    # The upper half of x stands for both, by symmetry.
    sign = np.where(samples.state[:, 1] < 0.0, -1.0, 1.0)
    angle, other = sign * samples.state[:, 1], sign * samples.nominal[:, 1]
    apart = box.angle_error >= 2.0 * box.angle
    places = np.stack([angle, other if apart else other - angle, samples.nominal[:, 3]], axis=1)
    slack = 1e-12
    inside = (counts.lower - slack <= places[:, None]) & (places[:, None] <= counts.upper + slack)
    assert np.all(np.any(np.all(inside, axis=2), axis=1))


@pytest.mark.parametrize(("error", "lean"), [(0.0, 0.0), (3.0, 0.0), (0.0, 1.0)])
def test_rates_inside_a_cell_are_between_its_corners(oracle, system, proved, error, lean):
    """The oracle's matrix at any rates of x and y, and any force, along any direction."""
    box = ProofBox(0.5, 1.0, 6.0, 2.0, 0.0, error, lean)
    condition = rate_condition(system, proved, box, 0.5)
    low, high = (-6.0, 6.0) if error == 0.0 else (-3.0, 3.0)
    cell = Interval(np.array([[0.4, 0.0, low]]), np.array([[0.4, 0.0, high]]))
    corners = condition.examine(cell).corners.midpoint[0]
    rng = np.random.default_rng(4)
    states, others = np.zeros((2, 300, 4))
    states[:, 1] = others[:, 1] = 0.4
    others[:, 3] = np.clip(rng.uniform(1.5 * low, 1.5 * high, 300), low, high)
    states[:, 3] = others[:, 3] + error * np.clip(rng.uniform(-1.5, 1.5, 300), -1.0, 1.0)
    others[:, 2] = np.clip(rng.uniform(-1.5, 1.5, 300), -1.0, 1.0) * box.velocity
    force = np.clip(rng.uniform(-1.5, 1.5, (300, 1)), -1.0, 1.0) * box.force
    force = force + lean * rng.choice([0.0, 0.4, 1.0], (300, 1)) * 1.1 * 9.8 * np.tan(0.4)
    true = left_side(oracle, proved, states, others, force, 0.5)
    direction = rng.standard_normal((400, 4))
    hull = np.einsum("di,vij,dj->dv", direction, corners, direction).max(axis=1)
    values = np.einsum("di,kij,dj->dk", direction, true, direction)
    assert np.all(values <= hull[:, None] * (1 + np.sign(hull[:, None]) * 1e-6) + 1e-3)


def test_a_force_that_leans_with_x_d_is_covered_at_y(system, proved):
    """u_d leans with the angle of x_d; the push at y is its own balance and what they differ by."""
    box = ProofBox(0.9, 1.0, 1.0, 2.0, 0.2, 0.0, lean=0.7)
    push = rate_condition(system, proved, box, 0.5).push
    other = np.linspace(-0.9, 0.9, 181)
    near = np.clip(other[:, None] + np.linspace(-0.2, 0.2, 21), -0.9, 0.9)
    gap = 0.7 * 1.1 * 9.8 * np.abs(np.tan(near) - np.tan(other)[:, None]).max()
    assert 2.0 + 0.5 * 1.0 + gap <= push <= 2.0 + 0.5 * 1.0 + 1.6 * gap


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


def test_other_systems_are_refused(proved):
    with pytest.raises(TypeError, match="CartPole"):
        prove_contraction(object(), proved, SMALL)


@pytest.mark.slow
def test_the_shipped_proof_can_be_made_again(system, proved):
    found = prove_contraction(system, proved, PROVED_BOX, most_seconds=300.0)
    assert found.proved
    # Figures of docs/certificates.md.
    assert found.boxes < 2000
    # Sampling with an optimiser finds 0.55498 1/s to be the largest rate, at a vertex of the box.
    assert prove_contraction(system, proved, PROVED_BOX, 0.5549, most_seconds=300.0).proved
    refused = prove_contraction(system, proved, PROVED_BOX, 0.5551, most_seconds=300.0)
    assert refused.violation is not None
