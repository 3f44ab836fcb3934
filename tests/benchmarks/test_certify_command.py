"""`lagros certify`: the record, the words, and the exit status."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.cells import cell_len
from typer.testing import CliRunner

from lagros_benchmarks import certify, certify_evidence, cli
from lagros_policies.contraction import load_metric, save_metric
from lagros_policies.contraction.certificate import Certificate, TubeSizes
from lagros_policies.contraction.proof.box import ProofBox
from lagros_policies.contraction.statement import Statement


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(cli.app, ("certify", *arguments))


@pytest.fixture
def quick(monkeypatch):
    """Claim the small box only, and none of the tubes that take seconds to design."""
    box = ProofBox(0.06, 0.3, 0.3, 0.3, angle_error=0.03, angular_rate_error=0.1)
    monkeypatch.setattr(certify_evidence, "SMALL_BOX", box)
    monkeypatch.setattr(certify_evidence, "metric_to_prove", lambda path: (path, False))
    monkeypatch.setattr(certify_evidence, "cartpole_tubes", lambda system, bound: [])
    monkeypatch.setattr(certify_evidence, "cartpole_held_tubes", lambda system, bound: [])


def test_the_spacecraft_is_certified_without_flights(invoke, tmp_path):
    result = invoke("spacecraft", "--episodes", "0", "--json", "out/sc.json")
    assert result.exit_code == 0, result.output
    assert "every claim holds" in result.stdout
    assert max(cell_len(line) for line in result.stdout.splitlines()) <= 80
    record = json.loads((tmp_path / "out" / "sc.json").read_text())
    assert record["holds"]
    assert record["tube"]["observed"] is None
    assert {line["kind"] for line in record["statements"]} == {"proved", "observed"}


def test_u_star_itself_has_no_learning_error(invoke, tmp_path):
    result = invoke("spacecraft", "--policy", "centralized", "--episodes", "0", "--json", "sc.json")
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "sc.json").read_text())["epsilon_l"] == 0.0


@pytest.mark.usefixtures("quick")
def test_the_cartpole_is_certified_and_a_planted_bad_metric_is_not(invoke, tmp_path):
    save_metric(load_metric(), "good.json")
    result = invoke("cartpole", "--metric", "good.json", "--episodes", "0", "--json", "cp.json")
    assert result.exit_code == 0, result.output
    assert "proved" in result.stdout
    metric = load_metric()
    for name, bad in (
        ("fast", replace(metric, contraction_rate=2.0)),
        ("negative", replace(metric, coefficients=-metric.coefficients)),
    ):
        save_metric(bad, f"{name}.json")
        result = invoke(
            *("cartpole", "--metric", f"{name}.json", "--episodes", "0", "--seconds", "5"),
            *("--json", f"{name}-certificate.json"),
        )
        assert result.exit_code == 1, result.output
        assert "NOT every claim holds" in result.stdout
        assert not json.loads((tmp_path / f"{name}-certificate.json").read_text())["holds"]


@pytest.mark.parametrize("task", ["cartpole", "spacecraft"])
@pytest.mark.parametrize("content", ["", "{}", '{"format": "something"}', "[1, 2]"])
def test_a_file_that_is_no_metric_gives_status_one_and_no_traceback(
    invoke, tmp_path, task, content
):
    (tmp_path / "bad.json").write_text(content)
    result = invoke(task, "--metric", "bad.json", "--episodes", "0")
    assert result.exit_code == 1
    assert "bad.json" in result.output
    assert "Traceback" not in result.output


def test_a_file_that_is_missing_gives_status_one(invoke):
    assert invoke("cartpole", "--metric", "nowhere.json").exit_code == 1


def test_a_metric_of_the_axes_can_be_read_and_a_bad_one_is_refused(invoke, tmp_path):
    good = {"format": certify_evidence.AXIS_FORMAT, "rate": 1.0, "stiffness": 3.0, "period": 0.1}
    (tmp_path / "axis.json").write_text(json.dumps(good))
    result = invoke("spacecraft", "--metric", "axis.json", "--episodes", "0", "--json", "sc.json")
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "sc.json").read_text())["alpha"] == pytest.approx(1.0)
    (tmp_path / "axis.json").write_text(json.dumps({**good, "stiffness": 0.5}))
    assert invoke("spacecraft", "--metric", "axis.json", "--episodes", "0").exit_code == 1
    # At will: without a hold there is no finite nu.
    (tmp_path / "axis.json").write_text(json.dumps({**good, "period": 0.0}))
    assert invoke("spacecraft", "--metric", "axis.json", "--episodes", "0").exit_code == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ("pendulum",),
        ("cartpole", "--policy", "ppo"),
        ("cartpole", "--bound", "-1"),
        ("cartpole", "--episodes", "-3"),
        ("cartpole", "--seconds", "0"),
    ],
)
def test_wrong_usage_gives_status_two(invoke, arguments):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert "lagros:" in result.output


@pytest.mark.usefixtures("quick")
def test_flights_add_what_was_observed(system_of_task):
    flights = certify_evidence.fly_cartpole("lagros", 0.3, 4)
    assert flights.states.shape == (12, 91, 4)
    error, line = certify_evidence.met_error(
        flights, system_of_task, load_metric(), ProofBox(0.5, 9.0, 3.0, 9.0, 0.3, 2.0)
    )
    assert 0.0 <= error < np.inf
    assert line.kind == "observed"
    certificate = Certificate(
        *("cartpole", "lagros", {}, 0.5, 100.0, 1.0, 1.5, error, 0.3, "all", "1"),
        np.eye(4)[None],
        TubeSizes(3.15, 50.0),
        (),
        {"disturbed_rate": 0.4},
    )
    line, largest = certify_evidence.tube_line(certificate, flights, "lagros", 0.3)
    assert line.holds
    assert 0.0 < largest < 50.0
    small = replace(certificate, tube=TubeSizes(3.15, 0.01 * largest))
    assert not certify_evidence.tube_line(small, flights, "lagros", 0.3)[0].holds


@pytest.fixture
def system_of_task():
    from lagros_envs.cartpole_task import CartPoleSettings

    return CartPoleSettings().system


def test_markup_in_a_claim_is_printed_as_it_is(capsys):
    line = Statement("within [1, 2] of [bold]", "observed", True, 0.0)
    certificate = Certificate(
        *("cartpole", "lagros", {"theta": (-1.0, 1.0)}, 0.5, 100.0, 1.0, 1.5, 0.0, 0.3, "all", "1"),
        np.eye(4)[None],
        TubeSizes(3.15, None),
        (line,),
    )
    certify.print_certificate(certificate)
    assert "[1, 2] of [bold]" in capsys.readouterr().out
