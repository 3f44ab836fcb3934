"""Files that a run has left, handed over again: a value, or one line that names the file."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.run.files import plain
from lagros_benchmarks.tasks.cartpole.course import CartPoleTraining
from lagros_benchmarks.tasks.spacecraft.certify import load_axis_metric
from lagros_benchmarks.training.run import Place, train
from lagros_benchmarks.worst_case import attack
from lagros_benchmarks.worst_case.attack import AttackSettings
from lagros_benchmarks.worst_case.replay import (
    Outcome,
    WorstCases,
    load_worst_cases,
    save_worst_cases,
)
from lagros_benchmarks.worst_case.search import SearchSettings
from lagros_benchmarks.worst_case.single import SingleBench
from lagros_policies.learning.shards import claim, make_shards

FUZZ = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 3)
    | st.sampled_from([10**30, 10**400])
    | st.floats()
    | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=8,
)


def value_or_line(read, path: Path):
    """Return what is read, or None where one line refuses it and names the file."""
    try:
        return read(path)
    except ValueError as error:
        text = str(error)
    assert path.name in text
    assert "\n" not in text
    assert len(text) < 1500
    return None


def record() -> dict:
    from dataclasses import asdict

    command = AttackSettings("cartpole", policy="lqr", episodes=1, search=SearchSettings(budget=9))
    outcome = Outcome(5, 0.5, False, {"success": True, "error": None})
    return {
        "format": "lagros-worst-case-1",
        "command": asdict(command),
        "outcomes": [asdict(outcome)],
    }


def write(path: Path, text: object, pushes: object = None) -> Path:
    buffer = io.BytesIO()
    np.savez(
        buffer, pushes=np.zeros((1, 90, 4)) if pushes is None else pushes, record=np.array(text)
    )
    path.write_bytes(buffer.getvalue())
    return path


@pytest.fixture
def grounded(monkeypatch):
    """The command `attack --replay` up to its flights, which do what the file says."""

    class Bench(SingleBench):
        def prepare(self):
            assert isinstance(self.settings, AttackSettings)

        def replay(self, pushes):
            assert pushes.shape == (1, 90, 4)
            return [Outcome(5, 0.5, False, {"success": True, "error": None})]

    monkeypatch.setattr(attack, "bench_of", lambda task: Bench)
    command = cli.typer.main.get_command(cli.app)
    monkeypatch.setattr("typer.testing._get_command", lambda _: command)


def replay(path: Path):
    return CliRunner().invoke(cli.app, ["attack", "cartpole", "--replay", str(path)])


def check_told(result, path: Path) -> None:
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code in (0, 1, 2)
    if result.exit_code == 2:
        assert "--replay" in result.stderr
        assert path.name in result.stderr
        assert result.stderr.count("\n") == 1


def test_a_file_that_says_what_it_should_is_flown(grounded, tmp_path):
    path = write(tmp_path / "worst.npz", json.dumps(record()))
    assert replay(path).exit_code == 0


@pytest.mark.parametrize(
    "change",
    [
        {"command": [1]},
        {"command": None},
        {"command": {}},
        {"outcomes": {}},
        {"outcomes": []},
        {"outcomes": [[]]},
        {"format": None},
    ],
    ids=str,
)
def test_a_record_of_another_shape_is_refused_by_the_field(grounded, tmp_path, change):
    path = write(tmp_path / "worst.npz", json.dumps(record() | change))
    result = replay(path)
    check_told(result, path)
    assert result.exit_code == 2
    assert (
        next(iter(change)).removesuffix("s") in result.stderr or "of the task None" in result.stderr
    )


@pytest.mark.parametrize(
    "pushes",
    [
        np.zeros((1, 90, 3)),
        np.zeros((1, 91, 4)),
        np.zeros((2, 90, 4)),
        np.zeros((1, 90, 6, 6)),
        np.zeros(0),
        np.zeros((1, 0, 4)),
        np.full((1, 90, 4), np.nan),
        np.full((1, 90, 4), np.inf),
        np.full((1, 90, 4), 0.5),
        np.zeros((1, 90, 4), complex),
        np.zeros((1, 90, 4), "M8[s]"),
        np.full((1, 90, 4), "0.1"),
    ],
    ids=range(12),
)
def test_sequences_that_cannot_be_flown_are_refused(grounded, tmp_path, pushes):
    path = write(tmp_path / "worst.npz", json.dumps(record()), pushes)
    result = replay(path)
    check_told(result, path)
    assert result.exit_code == 2
    assert "push" in result.stderr


@pytest.mark.parametrize("text", ["", "[" * 200_000, "null", 5, ["a"], b"{}"], ids=range(6))
def test_a_record_that_is_no_json_is_refused(grounded, tmp_path, text):
    path = write(tmp_path / "worst.npz", text)
    result = replay(path)
    check_told(result, path)
    assert result.exit_code == 2


@FUZZ
@given(data=st.data())
def test_a_replay_with_any_entry_replaced_is_flown_or_refused(grounded, tmp_path, data):
    changed = record()
    place = data.draw(st.sampled_from(["top", "command", "search", "outcome"]))
    target = {
        "top": changed,
        "command": changed["command"],
        "search": changed["command"]["search"],
        "outcome": changed["outcomes"][0],
    }[place]
    name = data.draw(st.sampled_from([*sorted(target), "extra"]))
    value = data.draw(JSON)
    if data.draw(st.booleans()) and name in target:
        del target[name]
    else:
        target[name] = value
    path = write(tmp_path / "worst.npz", json.dumps(changed))
    check_told(replay(path), path)


def test_the_score_of_a_flight_that_raised_is_infinite_and_comes_back(tmp_path):
    pushes = np.zeros((1, 90, 4))
    raised = Outcome(5, np.inf, True, {}, "ValueError: no")
    path = tmp_path / "worst.npz"
    save_worst_cases(WorstCases(record()["command"], pushes, (raised,)), path)
    assert load_worst_cases(path).outcomes == (raised,)


@FUZZ
@given(name=st.sampled_from(["format", "rate", "stiffness", "period", "more"]), value=JSON)
def test_a_metric_of_the_axes_with_any_entry_replaced_is_a_metric_or_a_line(tmp_path, name, value):
    good = {"format": "lagros-axis-metric-1", "rate": 2.0, "stiffness": 5.0, "period": 0.1}
    path = tmp_path / "axis.json"
    path.write_text(json.dumps(good | {name: value}))
    metric = value_or_line(lambda file: load_axis_metric(file, 2.0, 0.1), path)
    assert metric is None or np.isfinite(metric.rate)


@pytest.mark.parametrize("text", ["", "{", "[" * 200_000, "null", '{"a": NaN}', "[1, 2]"])
def test_the_record_of_a_folder_is_read_or_named(tmp_path, text):
    path = tmp_path / "settings.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=str(tmp_path)) as error:
        claim(path, {"a": 1}, "a run")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "null", "[]", "{}", '{"training": 1}'])
def test_a_damaged_record_of_a_training_run_is_named(tmp_path, text):
    place = Place(tmp_path)
    place.record.write_text(text)
    with pytest.raises(ValueError, match=r"record\.json|holds another run") as error:
        train(CartPoleTraining(), place, lambda: pytest.fail("it began"))
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


@pytest.mark.parametrize("value", [["x"], [True], [[1.0]], [{}], [1.0, 2.0], [], 1.0, None])
def test_a_point_of_a_stored_curve_is_a_number(tmp_path, value):
    run, place = CartPoleTraining(segments=1), Place(tmp_path)
    curve = {key: [1.0] for key in ("steps", "seconds", "cpu_seconds")} | {"fallen": value}
    stored = {"training": plain(run.record()), "curve": curve, "final": []}
    place.record.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"record\.json.*'fallen'"):
        train(run, place, lambda: pytest.fail("it began"))


def make_shard(index: int):
    return {"a": np.full(3, float(index)), "b": np.array(index)}


@pytest.mark.parametrize("seed", range(5))
def test_damaged_shards_are_made_again(tmp_path, seed):
    whole = make_shards(tmp_path, 2, make_shard, {"x": 1})
    path = tmp_path / "shard_0001.npz"
    data = path.read_bytes()
    rng = np.random.default_rng(seed)
    path.write_bytes([data[: rng.integers(len(data))], b"", rng.bytes(99), b"[1]", data[1:]][seed])
    again = make_shards(tmp_path, 2, make_shard, {"x": 1})
    for before, after in zip(whole, again, strict=True):
        assert before.keys() == after.keys()
        for name in before:
            np.testing.assert_array_equal(before[name], after[name])
