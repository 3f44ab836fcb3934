"""The file of a metric: every bit comes back, and what is no metric is refused by name."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import lagros_policies
from lagros_policies.contraction import (
    Metric,
    Verification,
    extreme_eigenvalues,
    load_metric,
    save_metric,
)


@pytest.fixture
def saved(metric, tmp_path):
    """Return a metric with awkward numbers in every field, and its file."""
    checked = replace(
        metric,
        contraction_rate=1.0 / 3.0,
        scaling=np.array([1.0, 1.0 / 3.0, np.pi, 0.1]),
        verification=Verification(samples=10_000, violations=3, worst=-0.1 / 3.0, seed=2**63 + 11),
    )
    path = tmp_path / "deep" / "metric.json"
    save_metric(checked, path)
    return checked, path


def same(one, other):
    return all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name))
        for field in fields(one)
    )


def test_round_trip_keeps_every_bit(saved, metric, tmp_path):
    checked, path = saved
    loaded = load_metric(path)
    assert same(loaded, checked)
    assert loaded.verification == checked.verification
    assert loaded.region == checked.region
    again = tmp_path / "again.json"
    save_metric(loaded, str(again))
    assert again.read_bytes() == path.read_bytes()
    # Without a verification, too.
    save_metric(metric, again)
    assert same(load_metric(again), metric)


def test_saving_replaces_the_whole_file_and_leaves_nothing_beside_it(saved, metric):
    _, path = saved
    save_metric(metric, path)
    assert same(load_metric(path), metric)
    assert [child.name for child in path.parent.iterdir()] == [path.name]


def test_missing_file_is_not_found(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.json"):
        load_metric(tmp_path / "nowhere.json")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_truncated_file_is_refused_by_name(saved, share):
    _, path = saved
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=path.name):
        load_metric(path)


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"\x89PNG\r\n\x1a\n\x00\xff\xfe", id="binary"),
        pytest.param(b"null", id="null"),
        pytest.param(b"[1, 2, 3]", id="list"),
        pytest.param(b"17", id="number"),
        pytest.param(b'{"format": "another-1"}', id="foreign"),
        pytest.param(b"{}", id="empty"),
    ],
)
def test_foreign_file_is_refused_by_name(tmp_path, content):
    path = tmp_path / "metric.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"metric\.json"):
        load_metric(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("format", "lagros-metric-0"),
        ("coefficients", [[1.0, 2.0], [3.0]]),
        ("coefficients", [[[1.0, 2.0], [3.0, 4.0]]]),
        ("coefficients", [[["x"] * 4] * 4]),
        ("coefficients", [[[float("inf")] * 4] * 4]),
        ("coefficients", [[[float("nan")] * 4] * 4]),
        ("alpha", float("nan")),
        ("alpha", -0.5),
        ("alpha", "fast"),
        ("alpha", "0.5"),
        ("alpha", True),
        ("chi", "300"),
        ("nu", True),
        ("coefficients", [[["1.0"] * 4] * 4]),
        ("coefficients", [[[True] * 4] * 4]),
        ("scaling", ["1", "1", "1", "1"]),
        ("scaling", [True, 1.0, 1.0, 1.0]),
        ("region", {"angle": "1.0"}),
        ("region", {"angle": True}),
        ("verification", {"samples": "3", "violations": 0, "worst": -1.0, "seed": 0}),
        ("alpha", None),
        ("chi", float("inf")),
        ("chi", 0.5),
        ("nu", -1.0),
        ("scaling", [1.0, 1.0, 1.0]),
        ("scaling", [1.0, 1.0, 1.0, 0.0]),
        ("region", {"angle": 2.0}),
        ("region", {"width": 1.0}),
        ("region", [1.0, 2.0]),
        ("verification", {"samples": 3}),
        ("verification", 12),
    ],
)
def test_damaged_entry_is_refused_by_name(saved, key, value):
    _, path = saved
    record = json.loads(path.read_text())
    assert key in record
    record[key] = value
    path.write_text(json.dumps(record))
    with pytest.raises(ValueError, match=path.name):
        load_metric(path)


@pytest.mark.parametrize("value", ["0.5", True])
def test_text_in_a_number_s_place_is_named_with_the_remedy(saved, value):
    _, path = saved
    record = json.loads(path.read_text())
    path.write_text(json.dumps({**record, "alpha": value}))
    with pytest.raises(ValueError, match=r"'alpha' is .* must be a number, written without quotes"):
        load_metric(path)


def test_a_network_is_refused_with_what_to_give_in_its_place(tmp_path):
    shipped = Path(lagros_policies.__file__).parent / "pretrained"
    network = (shipped / "cartpole_neural_metric.safetensors").read_bytes()
    files = {"net.safetensors": network, "net.json": network, "text.safetensors": b"{}"}
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match=rf"{name} is no JSON: a network .* save_metric"):
            load_metric(tmp_path / name)


@pytest.mark.parametrize(
    "key", ["format", "coefficients", "alpha", "chi", "nu", "scaling", "region", "verification"]
)
def test_missing_entry_is_refused_by_name(saved, key):
    _, path = saved
    record = json.loads(path.read_text())
    del record[key]
    path.write_text(json.dumps(record))
    with pytest.raises(ValueError, match=rf"{path.name}.*'{key}'"):
        load_metric(path)


EYE = np.eye(4)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        pytest.param({"coefficients": [np.zeros((4, 4))]}, "coefficients", id="zero"),
        pytest.param({"coefficients": [-EYE]}, "coefficients", id="negative"),
        pytest.param({"coefficients": [np.diag([1.0, 1, 1, -1])]}, "coefficients", id="indefinite"),
        pytest.param({"coefficients": [np.ones((4, 4))]}, "coefficients", id="singular"),
        # 1 - 2 (1 - cos(theta)) is below zero from 60 degrees on, which the region reaches.
        pytest.param({"coefficients": [-EYE, 2 * EYE]}, "coefficients", id="later indefinite"),
        # Entries far below an absolute tolerance are asymmetric all the same.
        pytest.param(
            {"coefficients": [1e-9 * (EYE + np.triu(0.1 * np.ones((4, 4)), 1))]},
            "coefficients",
            id="tiny asymmetric",
        ),
        pytest.param({"coefficients": [np.eye(3)]}, "coefficients", id="three states"),
        pytest.param({"coefficients": np.zeros((0, 4, 4))}, "coefficients", id="no degree"),
        pytest.param({"coefficients": np.zeros((1, 0, 0))}, "coefficients", id="no state"),
        pytest.param({"coefficients": [EYE] * 50}, "coefficients", id="degree"),
        pytest.param({"coefficients": [[[10**400] * 4] * 4]}, "coefficients", id="huge"),
        pytest.param({"coefficients": {"a": 1.0}}, "coefficients", id="object"),
        pytest.param({"coefficients": 7}, "coefficients", id="number"),
        pytest.param({"basis": "theta^i"}, "basis", id="another basis"),
        pytest.param({"alpha": 10**400}, "alpha", id="huge alpha"),
        pytest.param({"alpha": [1.0]}, "alpha", id="list"),
        pytest.param({"chi": 0.5}, "condition_bound", id="chi"),
        pytest.param({"nu": 0}, "nu", id="nu"),
        pytest.param({"scaling": [1.0, 1.0, 0.0, 1.0]}, "scaling", id="scaling"),
        pytest.param({"scaling": 1.0}, "scaling", id="scaling of no dimension"),
        pytest.param({"region": {}}, "region", id="empty region"),
        pytest.param({"region": {"angle": 1.0, "wide": 2.0}}, "region", id="unknown bound"),
        pytest.param({"verification": {"samples": 3}}, "verification", id="half a check"),
        pytest.param(
            {"verification": {"samples": 3, "violations": 4, "worst": 0.0, "seed": 0}},
            "violations",
            id="more violations than samples",
        ),
        pytest.param(
            {"verification": {"samples": 2.5, "violations": 0, "worst": 0.0, "seed": 0}},
            "samples",
            id="half a sample",
        ),
    ],
)
def test_what_is_no_metric_is_refused_with_file_and_field(saved, change, field):
    _, path = saved
    record = {**json.loads(path.read_text()), **change}
    record["coefficients"] = np.asarray(record["coefficients"], dtype=object).tolist()
    path.write_text(json.dumps(record))
    with pytest.raises(ValueError, match=rf"{path.name}.*{field}") as caught:
        load_metric(path, 4)
    assert "\n" not in str(caught.value)


def test_a_metric_of_other_states_is_loaded_where_it_is_asked_for(saved):
    _, path = saved
    record = json.loads(path.read_text())
    change = {"coefficients": [np.eye(3).tolist()], "scaling": [1.0] * 3}
    path.write_text(json.dumps({**record, **change}))
    assert load_metric(path).dual(np.zeros((2, 3))).shape == (2, 3, 3)
    with pytest.raises(ValueError, match=r"'coefficients' are of 3 states; the system has 4"):
        load_metric(path, 4)


def test_metric_refuses_arrays_that_do_not_fit(metric):
    with pytest.raises(ValueError, match="symmetric"):
        replace(metric, coefficients=metric.coefficients + np.triu(np.ones((4, 4)), 1))
    with pytest.raises(ValueError, match="shape"):
        replace(metric, coefficients=metric.coefficients[0])
    assert isinstance(metric, Metric)


def test_matrix_is_the_inverse_of_the_dual_and_its_rate_that_of_the_flow(metric, oracle, samples):
    state, control = samples.state, samples.nominal_control
    product = metric.matrix(state) @ metric.dual(state)
    assert product == pytest.approx(np.broadcast_to(np.eye(4), product.shape), abs=1e-8)
    h = 1e-5
    ahead, behind = (oracle.step(state, control, time, 1) for time in (h, -h))
    for value, rate in ((metric.matrix, metric.matrix_rate), (metric.dual, metric.dual_rate)):
        moving = (value(ahead) - value(behind)) / (2 * h)
        size = np.abs(moving).max()
        assert rate(state, oracle.rates(state, control)) == pytest.approx(moving, abs=1e-6 * size)


def test_extreme_eigenvalues_are_those_of_the_worst_angles(metric):
    least, largest = extreme_eigenvalues(metric)
    states = np.random.default_rng(0).uniform(-1.0, 1.0, (3000, 4)) * metric.region.angle
    states[0] = metric.region.angle  # the angle at which W_bar bends most
    values = 1.0 / np.linalg.eigvalsh(metric.dual(states))
    assert least <= values.min() * (1 + 1e-6)
    assert largest >= values.max() * (1 - 1e-6)
    assert least == pytest.approx(values.min(), rel=1e-2)
    assert largest == pytest.approx(values.max(), rel=1e-2)
