"""Files of weights and metrics: a value, or one line that names the file, whatever is in it."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lagros_policies.actor import Actor
from lagros_policies.contraction import load_metric
from lagros_policies.export.source import load_source
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.learning.networks import Mlp, read_safetensors
from lagros_policies.tasks.cartpole.neural.metric import load_neural_metric

PRETRAINED = Path(load_source.__code__.co_filename).parents[1] / "pretrained"
SHIPPED = {
    "mlp": (Mlp.load, "cartpole_lagros.safetensors"),
    "deep set": (DeepSet.load, "spacecraft_lagros.safetensors"),
    "actor": (Actor.load, "cartpole_ppo.safetensors"),
    "neural metric": (load_neural_metric, "cartpole_neural_metric.safetensors"),
    "safetensors": (read_safetensors, "cartpole_lagros.safetensors"),
    "metric": (load_metric, "cartpole_metric.json"),
}
FUZZ = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def safetensors(header: object, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def tensor(kind: str, shape: list[int], size: int, begin: int = 0) -> dict[str, object]:
    return {"dtype": kind, "shape": shape, "data_offsets": [begin, begin + size]}


MLP = {"__metadata__": {"format": "lagros-mlp-1", "activation": "tanh"}}
ONE = tensor("F32", [7, 1], 28)
BIAS = tensor("F32", [1], 4, 28)
REFUSED = {
    "empty": b"",
    "short": b"\x01",
    "a header longer than the file": (1 << 40).to_bytes(8, "little") + b"{}",
    "an endless header": (2**64 - 1).to_bytes(8, "little") + b"{}",
    "no JSON": safetensors(b"{"),
    "nested": safetensors(b"[" * 200_000),
    "a list": safetensors(b"[]"),
    "no layers": safetensors(MLP),
    "metadata of numbers": safetensors({"__metadata__": {"format": 1}}),
    "more than there is": safetensors(
        {**MLP, "layer0.weight": tensor("F32", [10**12], 4 * 10**12)}
    ),
    "half a type": safetensors({**MLP, "layer0.weight": tensor("BF16", [7, 1], 14)}, bytes(14)),
    "an eighth": safetensors({**MLP, "layer0.weight": tensor("F8_E4M3", [7, 1], 7)}, bytes(7)),
    "integers": safetensors(
        {**MLP, "layer0.weight": tensor("I32", [7, 1], 28), "layer0.bias": BIAS}, bytes(32)
    ),
    "truths": safetensors({**MLP, "layer0.weight": tensor("BOOL", [4], 4)}, b"\1\0\7\1"),
    "nothing in it": safetensors({**MLP, "layer0.weight": tensor("F32", [10**9, 0], 0)}),
    "not finite": safetensors(
        {**MLP, "layer0.weight": ONE, "layer0.bias": BIAS}, np.full(8, np.nan, "f4").tobytes()
    ),
    "beyond single precision": safetensors(
        {
            **MLP,
            "layer0.weight": tensor("F64", [7, 1], 56),
            "layer0.bias": tensor("F64", [1], 8, 56),
        },
        np.full(8, 1e300).tobytes(),
    ),
    "a pickle": b"\x80\x04cos\nsystem\n(S'touch pwned'\ntR.",
}


def value_or_line(read, path: Path):
    """Return what is read, or None where one line refuses it and names the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return read(path)
    except ValueError as error:
        text = str(error)
    assert path.name in text
    assert "\n" not in text
    assert len(text) < 1500
    return None


@pytest.mark.parametrize("kind", SHIPPED)
@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_such_file_is_refused_in_one_line(tmp_path, monkeypatch, kind, name):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mine.safetensors"
    path.write_bytes(REFUSED[name])
    read = SHIPPED[kind][0]
    if kind == "safetensors" and name in ("not finite", "beyond single precision", "no layers"):
        return  # It says nothing of what the numbers are for.
    assert value_or_line(read, path) is None
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize("kind", SHIPPED)
def test_what_is_no_file_is_refused(tmp_path, kind):
    read = SHIPPED[kind][0]
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name in ("folder", "pipe", "x" * 300):
        assert value_or_line(read, tmp_path / name) is None
    with pytest.raises(FileNotFoundError, match="absent"):
        read(tmp_path / "absent")


@pytest.mark.parametrize("kind", SHIPPED)
def test_every_other_kind_of_file_is_refused(tmp_path, kind):
    read = SHIPPED[kind][0]
    own = SHIPPED[kind][1]
    for _, name in SHIPPED.values():
        if name == own or kind == "safetensors":
            continue
        if kind == "mlp" and name == "cartpole_neural_metric.safetensors":
            continue  # It is one.
        path = tmp_path / name
        path.write_bytes((PRETRAINED / name).read_bytes())
        assert value_or_line(read, path) is None


@pytest.mark.parametrize("kind", SHIPPED)
def test_a_damaged_file_is_a_value_or_a_line(tmp_path, kind):
    read, name = SHIPPED[kind]
    whole = (PRETRAINED / name).read_bytes()
    rng = np.random.default_rng(0)
    path = tmp_path / name
    header = 8 + int.from_bytes(whole[:8], "little") if name.endswith("s") else len(whole)
    places = [*rng.integers(0, min(header, len(whole)), 25), *rng.integers(0, len(whole), 10)]
    for place in places:
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        for data in (bytes(flipped), whole[:place], whole[:place] + whole[place + 1 :]):
            path.write_bytes(data)
            value_or_line(read, path)


@pytest.mark.parametrize("kind", SHIPPED)
@FUZZ
@given(data=st.binary(max_size=300))
def test_random_bytes_are_refused(tmp_path, kind, data):
    path = tmp_path / "random.bin"
    path.write_bytes(data)
    assert value_or_line(SHIPPED[kind][0], path) is None
    path.write_bytes(len(data).to_bytes(8, "little") + data)
    assert value_or_line(SHIPPED[kind][0], path) is None


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.floats() | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4)
    ),
    max_leaves=12,
)
METRIC = json.loads((PRETRAINED / "cartpole_metric.json").read_text())


@FUZZ
@given(name=st.sampled_from(sorted(METRIC)), value=JSON)
def test_a_metric_with_any_entry_replaced_is_a_metric_or_a_line(tmp_path, name, value):
    path = tmp_path / "metric.json"
    path.write_text(json.dumps({**METRIC, name: value}))
    metric = value_or_line(load_metric, path)
    assert metric is None or np.all(np.isfinite(metric.coefficients))


ACTOR = (PRETRAINED / "cartpole_ppo.safetensors").read_bytes()


@FUZZ
@given(
    name=st.sampled_from(["feature_clip", "action_clip", "force_scale", "squash", "format"]),
    value=st.one_of(
        st.sampled_from(["nan", "inf", "-1", "1e400", "0", "", "True", "0x1", "1_0"]),
        st.text(max_size=5),
    ),
)
def test_an_actor_with_any_number_replaced_is_an_actor_or_a_line(tmp_path, name, value):
    end = 8 + int.from_bytes(ACTOR[:8], "little")
    header = json.loads(ACTOR[8:end])
    header["__metadata__"][name] = value
    header["__metadata__"].pop("sha256", None)
    path = tmp_path / "actor.safetensors"
    path.write_bytes(safetensors(header, ACTOR[end:]))
    actor = value_or_line(Actor.load, path)
    if actor is not None:
        assert all(np.isfinite([actor.feature_clip, actor.action_clip, actor.force_scale]))


@pytest.mark.parametrize("name", ["lagros-cartpole", "lagros-spacecraft"])
def test_an_export_of_a_file_that_is_none_is_refused(tmp_path, name):
    path = tmp_path / "mine.safetensors"
    for data in REFUSED.values():
        path.write_bytes(data)
        assert value_or_line(lambda file: load_source(name, file), path) is None
