"""The condition over a hold: enclosures against the oracle, and what follows for u*."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lagros_policies
from lagros_envs.numbers import Interval
from lagros_policies.contraction import HeldControl, load_metric
from lagros_policies.proof.cells import search
from lagros_policies.proof.families import BoxCondition, hold_matrices
from lagros_policies.tasks.cartpole.box import ProofBox

PROVED = Path(lagros_policies.__file__).parent / "pretrained" / "cartpole_proved_metric.json"
PERIOD, RATE = 0.1, 0.5
SMALL = ProofBox(0.1, 0.3, 0.3, 0.3)


def condition_of(system, metric, box, rate):
    where = box.held_set(system)
    return BoxCondition(where, hold_matrices(system, metric, rate, PERIOD, where))


@pytest.fixture(scope="module")
def metric():
    return load_metric(PROVED)


def matrices(oracle, metric, places, rate=RATE):
    """Return the condition's matrices at angles, rates and pushes (n, 3) by complex steps."""
    point = np.zeros((len(places), 5))
    point[:, 1], point[:, 3], point[:, 4] = places.T
    full = oracle.jacobian(lambda z: oracle.step(z[:, :4], z[:, 4:]), point)
    slope, gain = full[..., :4], full[..., 4]
    share = gain[:, :3] / gain[:, 3:]
    left = np.concatenate([np.broadcast_to(np.eye(3), (len(places), 3, 3)), -share[..., None]], -1)
    after = metric.dual(oracle.step(point[:, :4], point[:, 4:]))
    before = slope @ metric.dual(point[:, :4]) @ np.swapaxes(slope, -1, -2)
    inner = before - np.exp(-2.0 * rate * PERIOD) * after
    return left @ inner @ np.swapaxes(left, -1, -2)


def test_corners_are_the_oracles_and_what_lies_between_is_within_the_remainder(
    oracle, system, metric
):
    rng = np.random.default_rng(0)
    low = rng.uniform([0.0, -1.5, -1.7], [0.85, 1.3, 1.2], (20, 3))
    cells = Interval(low, low + np.array([0.05, 0.2, 0.5]))
    box = ProofBox(0.9, 1.5, 1.5, 1.0)
    found = condition_of(system, metric, box, RATE).examine(cells)
    signs = np.array(list(np.ndindex(2, 2, 2)))
    for index, corner in enumerate(signs):
        expected = matrices(oracle, metric, np.where(corner, cells.upper, cells.lower))
        assert np.abs(found.corners.midpoint[:, index] - expected).max() < 1e-7
    reach = sum(np.maximum(np.abs(p.lower), np.abs(p.upper)) for p in found.remainders)
    for _ in range(30):
        share = rng.random((20, 3))
        weights = np.prod(np.where(signs[None], share[:, None], 1.0 - share[:, None]), axis=-1)
        linear = np.einsum("kc,kcij->kij", weights, found.corners.midpoint)
        true = matrices(oracle, metric, low + share * (cells.upper - cells.lower))
        assert np.all(np.abs(true - linear) <= reach + 1e-7)
    # Not so wide that nothing could be proved with it.
    assert np.median(reach) < 5.0


def test_a_small_box_is_proved_and_a_rate_that_is_too_fast_refused(oracle, system, metric):
    assert search(condition_of(system, metric, SMALL, RATE), 400, 10**5, 60.0).proved
    found = search(condition_of(system, metric, SMALL, 2.5), 400, 10**5, 60.0)
    assert not found.proved
    point = found.failure
    place = np.array([[point.state[1], point.state[3], point.control[0]]])
    assert np.linalg.eigvalsh(matrices(oracle, metric, place, rate=2.5)).max() > 0.0


def test_a_metric_without_stiffness_is_refused(system, metric):
    bad = replace(metric, coefficients=np.eye(4)[None] * 1.0)
    found = search(condition_of(system, bad, SMALL, 0.3), 400, 10**5, 60.0)
    assert found.failure is not None


def test_u_star_finds_contracting_forces_where_that_was_proved(system, metric):
    rng = np.random.default_rng(1)
    half = np.array([3.0, 0.9, 1.5, 1.5])
    state = rng.uniform(-1.0, 1.0, (3000, 4)) * half
    control = rng.uniform(-1.0, 1.0, (3000, 1))
    law = HeldControl(system, metric, metric.contraction_rate, PERIOD)
    for _ in range(3):
        error = 1e-5 * rng.standard_normal((3000, 4))
        a, b, c = law.quadratic(state, state - error, control)
        assert np.all(b * b - a * c > 0.0)


def test_the_lean_widens_the_forces_with_the_angle(system):
    where = ProofBox(0.9, 1.5, 1.5, 1.0, lean=1.0).held_set(system)
    for cells in (where.cells((6, 6, 4)), where.cells((12, 12, 16))):
        rng = np.random.default_rng(5)
        place = np.clip(rng.uniform(-1.3, 1.3, (3000, 3)), -1.0, 1.0) * [0.9, 1.5, 1.75]
        place[:, 0] = np.abs(place[:, 0])
        lean = 1.1 * 9.8 * np.tan(place[:, 0])
        place[:, 2] += rng.choice([0.0, 0.5, 1.0], 3000) * lean
        inside = (cells.lower - 1e-9 <= place[:, None]) & (place[:, None] <= cells.upper + 1e-9)
        assert np.all(np.any(np.all(inside, axis=2), axis=1))
    # A large push near the upright is in none.
    assert not np.any((cells.lower[:, 0] < 0.02) & (cells.lower[:, 2] > 4.0))


@pytest.mark.slow
def test_the_shipped_proof_over_the_hold_can_be_made_again(system, metric):
    box = ProofBox(0.9, 1.5, 1.5, 1.0, lean=1.0)
    assert search(condition_of(system, metric, box, RATE), 400, 10**6, 600.0).proved
