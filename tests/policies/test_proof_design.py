"""The loop of design and proof: what it returns is proved, and an impossible wish is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lagros_policies.contraction import (
    CvStemSettings,
    InfeasibleError,
    Samples,
    contraction_residual,
    load_metric,
)
from lagros_policies.tasks.cartpole import proof_design as module
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.proof_program import ProvedDesignSettings

SETTINGS = ProvedDesignSettings(
    cvstem=CvStemSettings(contraction_rate=0.5, degree=1, margin=0.3),
    box=ProofBox.apart(0.2, 0.3, 0.3, 0.3),
    leaning=ProofBox(0.2, 0.3, 0.3, 0.3, lean=1.0),
)


@pytest.fixture(scope="module")
def outcome(system):
    return module.design_proved(SETTINGS, system)


def test_what_is_designed_is_proved_and_samples_agree(system, outcome):
    metric, proof, second = outcome
    assert all(part.holds for part in (*proof.statements, *second.statements))
    assert second.held.proved
    rng = np.random.default_rng(0)
    half = np.array([1.0, 0.2, 0.3, 0.3])
    state, nominal = np.clip(rng.uniform(-1.5, 1.5, (2, 3000, 4)), -1.0, 1.0) * half
    force = np.clip(rng.uniform(-1.5, 1.5, (3000, 1)), -1.0, 1.0) * 0.3
    assert contraction_residual(system, metric, Samples(state, nominal, force)).max() < 0.0
    scaled = metric.dual(state) * metric.scaling[:, None] * metric.scaling
    values = np.linalg.eigvalsh(scaled)
    assert values.min() >= 1.0
    assert values.max() <= metric.condition_bound


def test_the_file_keeps_every_bit_and_says_what_was_proved(outcome, tmp_path):
    metric, *proofs = outcome
    path = tmp_path / "metric.json"
    module.write_proved(metric, proofs, SETTINGS, path)
    np.testing.assert_array_equal(load_metric(path).coefficients, metric.coefficients)
    record = json.loads(path.read_text())["proved"]
    assert len(record["statements"]) == 5
    assert record["settings"]["leaning"]["lean"] == 1.0


def test_points_that_fail_are_fed_back_until_the_proof_is_made(system, outcome, monkeypatch):
    good = outcome[0]
    seen = []

    def designed(system, pool, held, settings):
        seen.append((len(pool.state), len(held.state)))
        # Without control first: every proof fails, at a point.
        return replace(good, control_weight=1e-9) if len(seen) == 1 else good

    monkeypatch.setattr(module, "design_on_points", designed)
    metric, *_ = module.design_proved(SETTINGS, system)
    assert metric is good
    assert len(seen) == 2
    # The condition over a hold asks for some nu_h and so does not mind: it adds nothing.
    assert seen[1] == (seen[0][0] + 2, seen[0][1])


def test_an_impossible_rate_is_refused_by_name(system):
    fast = replace(SETTINGS, cvstem=replace(SETTINGS.cvstem, contraction_rate=60.0))
    with pytest.raises(InfeasibleError, match=r"alpha=60\.0"):
        module.design_proved(fast, system)


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="rounds"):
        replace(SETTINGS, rounds=0)
