"""Attempts to make a proof say too much: rounding, polygons, what lies outside, what is printed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lagros_policies
from lagros_envs.numbers import Interval, exact
from lagros_policies.contraction import Metric, load_metric
from lagros_policies.contraction.double_integrator import certified_margin, design_axis, flow
from lagros_policies.contraction.ellipsoid import prove_tube
from lagros_policies.contraction.statement import at_most
from lagros_policies.contraction.tube_design import TubeDesign, design_contained
from lagros_policies.proof import hold
from lagros_policies.proof.condition import prove_contraction
from lagros_policies.proof.families import BoxCondition, held_ends, rate_matrices
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.certificate import (
    CartPoleQuestion,
    cartpole_certificate,
)
from lagros_policies.tasks.cartpole.plans import PlanBox
from lagros_policies.tasks.cartpole.proof import prove_cartpole

PROVED = Path(lagros_policies.__file__).parent / "pretrained" / "cartpole_proved_metric.json"
SMALL = ProofBox(0.1, 0.3, 0.3, 0.3)


@pytest.fixture(scope="module")
def proved():
    return load_metric(PROVED)


@pytest.mark.parametrize("lean", [0.0, 1.0])
def test_the_angle_after_a_hold_is_bounded_closely(lean, system, proved, oracle):
    box = ProofBox(0.9, 1.5, 1.5, 1.0, lean=lean)
    _, ended = held_ends(system, box.held_set(system), 0.1, (20, 10, 6))
    found = max(np.abs(ended[1].lower).max(), np.abs(ended[1].upper).max())
    rng = np.random.default_rng(1)
    state = np.clip(rng.uniform(-1.5, 1.5, (20_000, 4)), -1, 1) * [1.0, 0.9, 1.5, 1.5]
    force = rng.choice([-1.0, 1.0], (20_000, 1))
    force = force + rng.uniform(0, lean, (20_000, 1)) * 1.1 * 9.8 * np.tan(state[:, 1:2])
    largest = np.abs(oracle.step(state, force)[:, 1]).max()
    assert largest <= found <= largest + 0.01


def test_a_metric_that_is_none_where_a_hold_ends_is_refused(system, proved, monkeypatch):
    """W_bar of the shipped metric is indefinite at 1.3 rad: no V could be measured there."""
    assert np.linalg.eigvalsh(proved.dual(np.array([0.0, 1.3, 0.0, 0.0])))[0] < 0.0
    asked = {"system": system, "held_box": SMALL}
    assert prove_cartpole(proved, SMALL, **asked).statements[-1].holds
    far = [exact(np.full(1, 1.3))] * 4
    monkeypatch.setattr(hold, "held_ends", lambda *_: (far, far))
    found = prove_cartpole(proved, SMALL, **asked)
    assert found.held.search.proved
    assert not found.held.proved
    assert not found.statements[-1].holds


def test_nothing_follows_from_a_condition_that_was_not_proved(system, proved):
    fast = replace(proved, contraction_rate=2.0)
    found = cartpole_certificate(system, fast, CartPoleQuestion(SMALL, 0.05, 0.0, 3.15))
    assert not found.holds
    assert found.tube.certified is None
    assert not any("Theorem 1" in line.text for line in found.statements)
    json.dumps(found.as_json(), allow_nan=False)


def test_a_program_that_is_infeasible_somewhere_is_counted_as_such(system, proved):
    """Whatever was said of (14): without a gain the control of its proof contracts nothing."""
    weak = replace(proved, control_weight=1e-9)
    question = CartPoleQuestion(SMALL, 0.05, 0.0, 3.15)
    found = cartpole_certificate(system, weak, question, proofs=[])
    (line,) = [line for line in found.statements if line.kind == "observed"]
    assert "Theorem 2" in line.text
    assert not line.holds


def test_the_lipschitz_constant_counts_forces_that_lean(system, proved, oracle):
    box = ProofBox(0.8, 0.3, 0.3, 0.3, lean=1.0)
    question = CartPoleQuestion(box, 0.05, 0.0, 3.15)
    found = cartpole_certificate(system, proved, question, proofs=[]).details["lipschitz"]
    state = np.zeros((400, 4))
    state[:, 1] = np.linspace(-0.8, 0.8, 400)
    force = 1.1 * 9.8 * np.tan(state[:, 1:2]) + 0.3 * np.sign(state[:, 1:2])
    norms = [
        np.linalg.norm(oracle.jacobian(lambda x, u=u: oracle.rates(x, u), state), 2, axis=(1, 2))
        for u in (force, 0.0 * force)
    ]
    # The test says something: without the lean it would be less.
    assert 1.01 * norms[1].max() < norms[0].max() <= found


@given(st.floats(1e-9, 1e12), st.integers(2, 8))
def test_printed_bounds_are_never_below_those_that_were_proved(value, digits):
    printed = float(at_most(value, digits))
    assert value <= printed <= value * (1.0 + 10.0 ** (1 - digits)) * (1 + 1e-15)


def test_no_bound_is_printed_as_infinite_by_rounding():
    assert (at_most(2.0), at_most(0.0), at_most(1.99999)) == ("2", "0", "2")
    assert at_most(float("inf")) == "inf"


def test_the_record_alone_can_be_proved_again(system, proved):
    """W_bar and nu of the record are scaled, and so rounded: the proof holds of them as well."""
    question = CartPoleQuestion(SMALL, 0.05, 0.0, 3.15)
    record = json.loads(json.dumps(cartpole_certificate(system, proved, question).as_json()))
    region = {name: high for name, (_, high) in record["region"].items()}
    box = ProofBox(
        *(region[name] for name in ("theta", "p_dot", "theta_dot", "u_d")),
        angle_error=region["theta_error"],
        angular_rate_error=region["theta_dot_error"],
    )
    rebuilt = Metric(
        coefficients=np.array(record["metric"]["coefficients"]),
        contraction_rate=record["alpha"],
        condition_bound=record["chi"],
        control_weight=record["nu"],
        scaling=np.ones(4),
        region=proved.region,
    )
    assert record["metric"]["basis"].startswith("cos(theta)^i")
    assert prove_contraction(system, rebuilt, box).proved


def test_an_indefinite_ellipsoid_is_refused(system):
    plan = PlanBox(angle=0.05, velocity=0.2, angular_rate=0.1, force=0.2)
    tube = design_contained(system, plan, TubeDesign(disturbance_bound=0.05, floor=0.1))
    assert prove_tube(system, tube, 20.0).proved
    # A W with a negative eigenvalue along a direction of its own, which keeps the diagonal.
    values, vectors = np.linalg.eigh(tube.dual)
    wrong = (vectors * np.array([-values[0], *values[1:]])) @ vectors.T
    assert not prove_tube(system, replace(tube, dual=0.5 * (wrong + wrong.T)), 5.0).proved


@pytest.mark.parametrize("rate", [0.3, 2.0])
def test_the_margin_of_the_spacecraft_is_above_a_finer_integral(rate):
    """The gain of one hold by the midpoint rule, below the integral of what is convex."""
    metric = design_axis(rate)
    h, matrix = metric.period, metric.matrix
    times = (np.arange(20_000) + 0.5) * h / 20_000
    flows = np.array([flow(time) for time in times])
    sizes = np.linalg.eigvalsh(flows.transpose(0, 2, 1) @ matrix @ flows)[:, -1]
    error = h * np.sqrt(sizes).mean() / -np.expm1(-rate * h)
    step, push = flow(h), np.array([h * h / 2, h])
    root = np.linalg.cholesky(matrix).T
    growth = np.linalg.norm(root @ step @ np.linalg.inv(root), ord=2)
    deviation = growth / np.linalg.norm(root @ push)
    whole = error * (1 + h * h / 8 * deviation) + h / 2 + h * h / 8
    assert whole < certified_margin(metric, 1.0) < whole * (1 + 1e-7)


def test_a_width_is_what_a_proof_is_made_of(system, proved):
    """An enclosure that is a number only: the corners hold everywhere, and prove nothing."""
    condition = BoxCondition(SMALL.proof_set(system), rate_matrices(system, proved, 0.5))
    cells = condition.start()
    found = condition.examine(cells)
    widths = [np.abs(part.radius).max() + np.abs(part.midpoint).max() for part in found.remainders]
    assert widths[0] > 1e-9
    assert isinstance(found.corners, Interval)
    assert np.all(found.corners.upper > found.corners.lower)
