"""The certificate, checked by an outsider who has nothing but its JSON and the equations."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from lagros_envs.dynamics import jacobian
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.contraction.double_integrator import design_axis
from lagros_policies.contraction.statement import Statement
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.certificate import (
    CartPoleQuestion,
    cartpole_certificate,
    region_of,
)
from lagros_policies.tasks.cartpole.region import Region
from lagros_policies.tasks.spacecraft import certificate as certificate_spacecraft
from lagros_policies.tasks.spacecraft.certificate import spacecraft_certificate
from tests.policies.shipped import shipped_metric

BOX = ProofBox(0.06, 0.3, 0.3, 0.3, angle_error=0.03, angular_rate_error=0.1)
KEYS = {
    *("alpha", "chi", "nu", "b_bar", "epsilon_l", "d_bar", "region", "metric", "tube"),
    "statements",
}


@pytest.fixture(scope="module")
def cartpole(system):
    question = CartPoleQuestion(BOX, 0.3, 0.2, 3.15)
    return cartpole_certificate(system, shipped_metric(), question)


def spacecraft_of_task():
    return spacecraft_certificate(
        design_axis(2.0),
        design_axis(0.3),
        Spacecraft(),
        disturbance_bound=0.4,
        paper_radius=0.125,
    )


@pytest.fixture(scope="module")
def spacecraft():
    return spacecraft_of_task()


@pytest.mark.parametrize("name", ["cartpole", "spacecraft"])
def test_the_record_has_the_keys_and_survives_json(name, request):
    found = request.getfixturevalue(name)
    assert found.holds
    record = json.loads(json.dumps(found.as_json(), allow_nan=False))
    assert set(record) >= KEYS
    assert set(record["tube"]) == {"paper", "certified", "observed"}
    assert set(record["metric"]) == {"basis", "coefficients"}
    for line in record["statements"]:
        assert set(line) == {"text", "kind", "holds", "seconds"}
        assert line["kind"] in ("proved", "calibrated", "observed")
    for low, high in record["region"].values():
        assert low <= high


def test_an_outsider_rebuilds_the_metric_and_finds_every_claim_true(cartpole, oracle):
    record = json.loads(json.dumps(cartpole.as_json()))
    region = {name: high for name, (_, high) in record["region"].items()}
    rng = np.random.default_rng(1)
    count = 3000
    half = [1.0, region["theta"], region["p_dot"], region["theta_dot"]]
    nominal = rng.uniform(-1, 1, (count, 4)) * half
    reach = [1.0, region["theta_error"], 9.0, region["theta_dot_error"]]
    state = np.clip(nominal + rng.uniform(-1, 1, (count, 4)) * reach, -np.array(half), half)
    control = rng.uniform(-1, 1, (count, 1)) * region["u_d"]
    coefficients = np.array(record["metric"]["coefficients"])
    cosine = np.cos(state[:, 1])
    powers = cosine[:, None] ** np.arange(len(coefficients))
    dual = np.einsum("si,ijk->sjk", powers, coefficients)
    values = np.linalg.eigvalsh(dual)
    assert values.min() >= 1.0 - 1e-9
    assert values.max() <= record["chi"] * (1 + 1e-9)
    gain = oracle.input_matrix(state)
    assert np.linalg.norm(gain, axis=(1, 2)).max() <= record["b_bar"]
    order = np.arange(1, len(coefficients))
    slopes = -order * cosine[:, None] ** (order - 1) * (np.sin(state[:, 1]) * state[:, 3])[:, None]
    rate = np.einsum("si,ijk->sjk", slopes, coefficients[1:])
    product = oracle.sdc(state, nominal, control, 40) @ dual
    left = -rate + product + np.swapaxes(product, 1, 2) + 2 * record["alpha"] * dual
    left -= 2 * record["nu"] * gain @ np.swapaxes(gain, 1, 2)
    assert np.linalg.eigvalsh(left).max() < 0.0
    push = record["b_bar"] * record["epsilon_l"] + record["d_bar"]
    least = push / record["alpha"] * math.sqrt(record["chi"])
    # The disturbance of the angle moves the metric: our tube is wider than the paper's formula.
    assert record["tube"]["certified"] > least
    assert record["tube"]["certified"] == pytest.approx(
        push / record["disturbed_rate"] * math.sqrt(record["chi"]), rel=1e-9
    )


def test_a_disturbance_too_large_for_the_metric_leaves_a_tube_of_the_rates(system, cartpole):
    large = 2.1 * cartpole.alpha / cartpole.details["drift"]
    found = cartpole_certificate(
        system, shipped_metric(), CartPoleQuestion(BOX, large, 0.0, 3.15), proofs=[]
    )
    assert found.channels == "rates"
    assert found.tube.certified == pytest.approx(large / found.alpha * math.sqrt(found.chi))


def thin(metric):
    """Return a metric that is positive definite at the angles of its region, and not beyond."""
    coefficients = metric.coefficients.copy()
    # Less a multiple of 1 - cos(theta).
    coefficients[0] -= 1e6 * np.eye(4)
    coefficients[1] += 1e6 * np.eye(4)
    return replace(metric, coefficients=coefficients, region=Region(angle=1e-6))


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda m: replace(m, contraction_rate=3.0), id="larger alpha"),
        pytest.param(lambda m: replace(m, control_weight=1e-9), id="no control"),
        pytest.param(thin, id="not positive"),
    ],
)
def test_the_certificate_of_a_bad_metric_does_not_hold(system, spoil):
    question = CartPoleQuestion(BOX, 0.05, 0.0, 3.15, most_seconds=10.0)
    found = cartpole_certificate(system, spoil(shipped_metric()), question)
    assert not found.holds
    json.dumps(found.as_json(), allow_nan=False)


def test_an_outsider_checks_the_spacecraft_at_random_states(spacecraft):
    record = json.loads(json.dumps(spacecraft.as_json()))
    body, rng = Spacecraft(), np.random.default_rng(0)
    (dual,) = np.array(record["metric"]["coefficients"])
    values = np.linalg.eigvalsh(dual)
    assert values[0] >= 1.0 - 1e-12
    assert values[-1] <= record["chi"]
    region = record["region"]
    names = ("x", "y", "heading", "vx", "vy", "spin")
    low, high = np.array([region[name] for name in names]).T
    state = rng.uniform(low, high, (2000, 6))
    control = rng.choice(region["u_d"], (2000, 8))
    # A is a mean of Jacobians, and the condition is convex in A.
    slope, gain = jacobian(body, state, control)
    product = slope @ dual
    left = product + np.swapaxes(product, 1, 2) + 2 * record["alpha"] * dual
    left -= 2 * record["nu"] * gain @ np.swapaxes(gain, 1, 2)
    assert np.linalg.eigvalsh(left).max() < 0.0
    assert np.linalg.norm(gain, ord=2, axis=(1, 2)).max() <= record["b_bar"] * (1 + 1e-12)
    # The nu is needed: the heading's terms would break a hundredth of it.
    left += 2 * 0.99 * record["nu"] * gain @ np.swapaxes(gain, 1, 2)
    assert np.linalg.eigvalsh(left).max() > 0.0


@pytest.mark.parametrize(
    ("name", "spoil", "text"),
    [
        ("control_weight", lambda found: 0.9 * found, "equation (14)"),
        ("state_tube", lambda found: replace(found, condition=0.99 * found.condition), "Theorem 1"),
        (
            "position_tube",
            lambda found: replace(found, condition=0.99 * found.condition),
            "Theorem 1",
        ),
    ],
)
def test_a_number_of_the_spacecraft_that_is_too_small_is_not_claimed(
    monkeypatch, name, spoil, text
):
    whole = getattr(certificate_spacecraft, name)
    monkeypatch.setattr(certificate_spacecraft, name, lambda *arguments: spoil(whole(*arguments)))
    failed = [line.text for line in spacecraft_of_task().statements if not line.holds]
    assert any(line.startswith(text) for line in failed)


def test_a_metric_of_the_spacecraft_that_is_scaled_too_far_down_is_not_claimed(monkeypatch):
    """I <= W_bar fails by a millionth: seen by fractions, where a printed digit shows nothing."""
    monkeypatch.setattr(certificate_spacecraft, "_ROUNDING", -1e-6)
    failed = [line.text for line in spacecraft_of_task().statements if not line.holds]
    assert any(line.startswith("equation (14)") for line in failed)


def test_a_claim_that_fails_and_a_certificate_without_claims_do_not_hold(spacecraft):
    failed = Statement("something else", "observed", False, 0.0)
    assert not spacecraft.with_evidence([failed]).holds
    assert not replace(spacecraft, statements=()).holds
    more = spacecraft.with_evidence([Statement("true", "observed", True, 1.5)], 0.25)
    assert more.holds
    assert more.tube.observed == 0.25
    assert more.seconds >= 1.5


def test_the_region_names_the_lean_only_where_there_is_one():
    assert "u_d_lean" not in region_of(BOX)
    assert region_of(replace(BOX, lean=1.0))["u_d_lean"] == (0.0, 1.0)
    assert region_of(ProofBox.apart(0.2, 1.0, 1.0, 1.0))["theta_error"] == (-0.4, 0.4)
