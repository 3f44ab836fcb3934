"""`lagros certify`: the record, the words, and the exit status."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.cells import cell_len
from typer.testing import CliRunner

from lagros_benchmarks.commands import certify, cli
from lagros_benchmarks.tasks.cartpole import certify as certify_box
from lagros_benchmarks.tasks.spacecraft.certify import AXIS_FORMAT
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import save_metric
from lagros_policies.contraction.certificate import Certificate, TubeSizes
from lagros_policies.contraction.metric_files import metric_record
from lagros_policies.contraction.statement import Statement
from lagros_policies.expert import metric_of
from lagros_policies.tasks.cartpole.box import ProofBox


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(cli.app, ("certify", *arguments))


@pytest.fixture
def quick(monkeypatch):
    """Claim the small box only."""
    box = ProofBox(0.06, 0.3, 0.3, 0.3, angle_error=0.03, angular_rate_error=0.1)
    monkeypatch.setattr(certify_box, "SMALL_BOX", box)
    monkeypatch.setattr(certify_box, "metric_to_prove", lambda path: (path, False))


def test_the_spacecraft_is_certified_without_flights(invoke, tmp_path):
    result = invoke("spacecraft", "--episodes", "0", "--json", "out/sc.json")
    assert result.exit_code == 0, result.output
    assert "Every claim holds (7 proved); what flies" in " ".join(result.stdout.split())
    said, *others = result.stdout.splitlines()
    assert said.startswith("Every claim holds (7 proved); what flies")
    assert max(map(cell_len, others)) <= 80
    record = json.loads((tmp_path / "out" / "sc.json").read_text())
    assert record["holds"]
    assert record["guarantee"] is None
    assert (record["tube"]["observed"], record["tube"]["certified"]) == (None, None)
    assert {line["kind"] for line in record["statements"]} == {"proved"}
    assert record["epsilon_l"] == 0.0
    # An outsider has the law that flies, and the metric that it contracts, from the record alone.
    for kept in record["gain"].values():
        weight, gain, h = np.array(kept["W"]), np.array(kept["K"]), kept["hold"]
        step = np.array([[1.0, h], [0.0, 1.0]]) + np.outer([0.5 * h * h, h], gain)
        left = np.exp(-2.0 * kept["alpha"] * h) * weight - step @ weight @ step.T
        assert np.linalg.eigvalsh(left).min() > -1e-12


def test_the_worlds_of_the_spacecraft_are_guaranteed_and_never_contradicted(invoke, tmp_path):
    arguments = ("--policy", "centralized", "--bound", "0.2", "--episodes", "2")
    result = invoke("spacecraft", *arguments, "--json", "sc.json")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("guaranteed for 2 of 2 worlds at d̄ = 0.2: collision-free and")
    found = json.loads((tmp_path / "sc.json").read_text())["guarantee"]
    assert (found["collision_free"], found["arriving"], found["without_plan"]) == (2, 2, 0)
    assert found["search"]["contradicted"] == 0
    assert 0.95 < found["search"]["share_of_bound"] <= 1.0
    assert 0.15 < found["arrival_bound"] < 0.2


def test_of_the_learned_policy_of_the_spacecraft_nothing_is_proved(invoke, tmp_path):
    result = invoke("spacecraft", "--policy", "lagros", "--episodes", "2", "--json", "sc.json")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("nothing is guaranteed of lagros")
    record = json.loads((tmp_path / "sc.json").read_text())
    assert record["guarantee"] is None
    assert record["tube"]["certified"] is None
    # What is proved is of the metric of its labels: no line with a bound of its error.
    assert not any("Theorem 1" in line["text"] for line in record["statements"])
    assert [line["kind"] for line in record["statements"][-2:]] == ["observed", "calibrated"]


@pytest.mark.usefixtures("quick")
def test_the_cartpole_is_certified_and_a_planted_bad_metric_is_not(invoke, tmp_path):
    save_metric(metric_of(CartPoleSettings()), "good.json")
    result = invoke("cartpole", "--metric", "good.json", "--episodes", "0", "--json", "cp.json")
    assert result.exit_code == 0, result.output
    assert "proved" in result.stdout
    metric = metric_of(CartPoleSettings())
    for name, bad in (
        ("fast", replace(metric, contraction_rate=2.0)),
        ("weak", replace(metric, control_weight=1e-9)),
    ):
        save_metric(bad, f"{name}.json")
        result = invoke(
            *("cartpole", "--metric", f"{name}.json", "--episodes", "0", "--seconds", "5"),
            *("--json", f"{name}-certificate.json"),
        )
        assert result.exit_code == 1, result.output
        said = (
            r"NOT every claim holds: \d+ of \d+ do not|Not every claim is shown: \d+ of \d+ are not"
        )
        assert re.match(said, result.stdout.splitlines()[0])
        # What does not hold is seen before what does.
        words = r"^ (?:proved|observed|calibrated) +(yes|NO|not shown) "
        kept = [word == "yes" for word in re.findall(words, result.stdout, re.M)]
        assert kept == sorted(kept)
        assert not all(kept)
        assert not json.loads((tmp_path / f"{name}-certificate.json").read_text())["holds"]


def certificate(*kinds, certified=7.0, observed=None):
    statements = tuple(Statement("claimed", kind, True, 0.0) for kind in kinds)
    return Certificate(
        *("cartpole", "lagros", {"p": (-1.0, 1.0)}, 0.5, 4.0, 3.0, 1.0, 0.1, 0.75, "rates"),
        *("1", np.zeros((1, 4, 4)), TubeSizes(3.15, certified, observed), statements),
    )


def test_the_verdict_is_one_sentence_with_what_is_proved_and_what_was_seen():
    words = certify.verdict(certificate("proved", "proved", "observed", observed=2.0))
    assert words == (
        "Every claim holds (2 proved, 1 observed); Theorem 1 bounds the error for a control at "
        "will, in the region, with the rates disturbed, not the positions, by 7; the largest error "
        "flown is 2."
    )
    words = certify.verdict(certificate("calibrated", certified=None))
    assert words == ("Every claim holds (1 calibrated); no tube is certified; nothing was flown.")
    other = certificate("proved", certified=0.31, observed=0.1)
    other = replace(
        other, verdict_radius=0.31, reach="u* is proved to stay on its plan to", unit="m"
    )
    words = certify.verdict(other)
    assert words.endswith("stay on its plan to 0.31 m; the largest error flown is 0.1 m.")
    failing = certificate("proved", "observed")
    undecided = replace(
        failing, statements=(*failing.statements, Statement("late", "proved", False, 0))
    )
    assert certify.verdict(undecided) == "Not every claim is shown: 1 of 3 are not, and come first."
    for line in (Statement("no", "proved", False, 0, True), Statement("no", "observed", False, 0)):
        refuted = replace(undecided, statements=(*undecided.statements, line))
        assert certify.verdict(refuted) == "NOT every claim holds: 2 of 4 do not, and come first."
    assert certify.verdict(certificate()).startswith("NOT every claim holds: 0 of 0")


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


def spoiled_metric(**changes):
    return {**metric_record(metric_of(CartPoleSettings())), **changes}


_EYE = np.eye(4).tolist()


@pytest.mark.parametrize(
    ("task", "record", "message"),
    [
        pytest.param(
            "cartpole",
            {"coefficients": [[[1.0, 0.0], [0.0, 1.0]]], "scaling": [1.0, 1.0]},
            "of 2 states",
            id="two states",
        ),
        pytest.param("cartpole", {"coefficients": [_EYE] * 2000}, "degree", id="large degree"),
        pytest.param("cartpole", {"alpha": 10**400}, "is not a metric", id="enormous"),
        pytest.param("cartpole", {"alpha": float("nan")}, "is not a metric", id="no number"),
        pytest.param("cartpole", {"nu": -1.0}, "nu=-1.0 must be", id="negative"),
        pytest.param(
            "cartpole",
            {"coefficients": [(np.eye(4) + 1e-9 * np.eye(4, k=1)).tolist()]},
            "symmetric",
            id="almost symmetric",
        ),
        pytest.param(
            "cartpole",
            {"alpha": "0.5"},
            "'alpha' is '0.5' and must be",
            id="text",
        ),
        pytest.param("cartpole", {"alpha": True}, "'alpha' is True and must be", id="true"),
        pytest.param("spacecraft", {"rate": "1.0"}, "'rate' is '1.0' and must be", id="axis, text"),
        pytest.param("spacecraft", {"rate": True}, "'rate' is True and must be", id="axis, true"),
        pytest.param("spacecraft", {"rate": 10**400}, "rate", id="axis, enormous"),
        pytest.param("spacecraft", {"stiffness": 1e308}, "stiffness", id="axis, overflow"),
        pytest.param("spacecraft", {"period": float("nan")}, "period", id="axis, nan"),
    ],
)
def test_hostile_numbers_give_status_one_and_say_what_is_wrong(
    invoke, tmp_path, task, record, message
):
    axis = {"format": AXIS_FORMAT, "rate": 1.0, "stiffness": 3.0, "period": 0.1}
    whole = spoiled_metric(**record) if task == "cartpole" else {**axis, **record}
    (tmp_path / "bad.json").write_text(json.dumps(whole))
    result = invoke(task, "--metric", "bad.json", "--episodes", "0")
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert message in " ".join(result.output.split())
    assert "bad.json" in result.output


@pytest.mark.parametrize("task", ["cartpole", "spacecraft"])
def test_a_network_is_not_proved_and_the_message_says_what_is(invoke, tmp_path, task):
    from pathlib import Path

    import lagros_policies

    shipped = Path(lagros_policies.__file__).parent / "pretrained"
    network = (shipped / "cartpole_neural_metric.safetensors").read_bytes()
    (tmp_path / "net.safetensors").write_bytes(network)
    result = invoke(task, "--metric", "net.safetensors", "--episodes", "0")
    words = " ".join(result.output.split())
    assert result.exit_code == 1
    assert "net.safetensors is no JSON" in words
    assert "codec" not in words
    assert ("only a polynomial" if task == "cartpole" else "stiffness and period") in words


def test_nested_brackets_without_end_are_no_metric(invoke, tmp_path):
    (tmp_path / "bad.json").write_text("[" * 100_000)
    result = invoke("cartpole", "--metric", "bad.json")
    assert result.exit_code == 1
    assert "bad.json" in result.output


def test_the_largest_multiple_of_a_box_is_found(monkeypatch):
    """With a proof that succeeds up to a size: to a hundredth, from above and from below."""

    class Proof:
        def __init__(self, size, limit):
            self.held = self.contraction = self
            self.proved, self.bounds = size <= limit, 1.0
            text = f"of {size:g}"
            line = Statement(text, "proved", self.proved, 0.0)
            chi = Statement("the chi of the file", "proved", False, 0.0)
            self.statements = [line, chi, replace(line, text=f"{text}, held")]

    for limit, box_is, last in ((1.234, "1.23", "1.24"), (0.5, "0.5", "0.51"), (9.0, "1.5", "")):
        monkeypatch.setattr(
            certify_box,
            "prove_multiple",
            lambda metric, factor, seconds, limit=limit: (
                factor,
                Proof(factor, limit),
                Proof(factor, limit),
            ),
        )
        box, lines = certify_box.largest_proofs(metric_of(CartPoleSettings()), 1.0)
        assert f"{box:g}" == box_is
        assert all(line.holds for line in lines)
        assert f"is {box_is} times" in lines[-1].text
        assert (f"; {last} times was not proved" in lines[-1].text) == bool(last)
    monkeypatch.setattr(
        certify_box, "prove_multiple", lambda *_: (1.0, Proof(1.0, 0.0), Proof(1.0, 0.0))
    )
    box, lines = certify_box.largest_proofs(metric_of(CartPoleSettings()), 1.0)
    assert box == 1.0
    assert not any(line.holds for line in lines)


def test_a_multiple_of_the_box_is_proved_as_it_is(system_of_task):
    from lagros_policies.proof.condition import prove_contraction

    metric = certify_box.load_cartpole_metric(certify_box.metric_to_prove(None)[0])
    box, first, second = certify_box.prove_multiple(metric, 0.1, 20.0)
    assert box == ProofBox.apart(0.9, 1.5, 1.5, 1.0).scaled(0.1)
    assert second.statements[-1].holds
    assert second.contraction.box.lean == 1.0
    assert first.contraction.proved == prove_contraction(system_of_task, metric, box).proved


def test_a_file_that_is_missing_gives_status_one(invoke):
    assert invoke("cartpole", "--metric", "nowhere.json").exit_code == 1


def test_a_metric_of_the_axes_can_be_read_and_a_bad_one_is_refused(invoke, tmp_path):
    good = {"format": AXIS_FORMAT, "rate": 1.0, "stiffness": 3.0, "period": 0.1}
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
        ("metronome",),
        ("cartpole", "--policy", "nobody"),
        ("cartpole", "--episodes", "0", "--policy", "tube-mpc"),
        ("cartpole", "--largest", "--episodes", "3"),
        ("spacecraft", "--policy", "learned"),
        ("cartpole", "--bound", "-1"),
        ("cartpole", "--episodes", "-3"),
        ("cartpole", "--seconds", "0"),
        ("spacecraft", "--largest"),
    ],
)
def test_wrong_usage_gives_status_two(invoke, arguments):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert "lagros:" in result.output


@pytest.fixture
def system_of_task():
    return CartPoleSettings().system


def test_flights_that_serve_several_bounds_are_timed_once(monkeypatch):
    from lagros_benchmarks.evidence import calibration

    values = {one.name: np.arange(40.0) for one in calibration.scores_of(CartPoleSettings())}
    scores = calibration.EpisodeScores(values, 0, 6.0)
    monkeypatch.setattr(calibration, "single_scores", lambda *_, **__: scores)
    lines = calibration.single_statements(CartPoleSettings(), 0.95, 40)
    assert len(lines) == 3
    assert sum(line.seconds for line in lines) == pytest.approx(6.0)


def test_the_spacecraft_s_region_is_printed_as_all_states(invoke):
    words = " ".join(invoke("spacecraft", "--episodes", "0").stdout.split())
    assert "region all states; to draw from: x -1000..1000" in words
    assert "1 coefficient of 1" in words


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
