"""`lagros export`: what it writes, what it says, what it refuses to write."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_policies.export import check, load_source
from lagros_policies.export.cost import footprint
from lagros_policies.learning.networks import Mlp


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(cli.app, ("export", *arguments))


@pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
def test_c_is_written_under_the_name_of_the_policy(invoke, tmp_path):
    result = invoke("learned-cartpole")
    assert result.exit_code == 0, result.output
    assert "wrote learned_cartpole.c" in result.stdout
    assert "differs from NumPy, over 1000 observations, by at most" in result.stdout
    source = load_source("learned-cartpole")
    assert source.digest in result.stdout
    text = (tmp_path / "learned_cartpole.c").read_text()
    assert "rational_tanh" in text
    rows = source.examples(50)
    with check.CompiledPolicy(text, source) as compiled:
        np.testing.assert_allclose(compiled.answer(rows), source.answer(rows), rtol=1e-5, atol=1e-5)


@pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
@pytest.mark.skipif(shutil.which("size") is None, reason="no binutils")
@pytest.mark.parametrize("policy", ["lagros-cartpole", "lagros-spacecraft"])
def test_time_and_bytes_of_c_are_told(invoke, tmp_path, policy):
    told = invoke(policy).stdout
    ours, numpys = map(int, re.search(r"one call (\d+) ns, NumPy predict (\d+) ns", told).groups())
    assert 0 < ours < 1e6
    assert 0 < numpys < 1e9
    code, ram, stack = map(
        int, re.search(r"weights (\d+) B, RAM (\d+) B, stack at most (\d+) B", told).groups()
    )
    network = load_source(policy).policy.network
    parts = (
        [network.weights, network.biases]
        if policy == "lagros-cartpole"
        else [array for layers in network.layers.values() for array in zip(*layers, strict=True)]
    )
    weights = sum(array.nbytes for arrays in parts for array in arrays)
    assert weights < code < weights + 10_000
    assert ram == 0
    assert 400 < stack < 20_000


@pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
@pytest.mark.skipif(shutil.which("size") is None, reason="no binutils")
def test_bytes_are_those_of_the_file():
    kept = "static const float weights[100] = {1.0f};\nstatic float last[25];\n"
    text = kept + "float f(int i);\nfloat f(int i) { return last[i] += weights[i]; }\n"
    found = footprint(text)
    assert found.ram == 100
    assert 400 <= found.code < 600
    with pytest.raises(RuntimeError, match="do not tell the bytes"):
        footprint("float f(")


@pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
def test_where_nobody_counts_bytes_the_rest_is_told(invoke, monkeypatch):
    found = shutil.which
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "size" else found(name))
    result = invoke("lagros-cartpole")
    assert result.exit_code == 0, result.output
    assert "ns, NumPy predict" in result.stdout
    assert "RAM" not in result.stdout


@pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
def test_tanh_of_libm_on_request(invoke, tmp_path):
    result = invoke("lagros-cartpole", "--tanh", "libm", "--out", "own.c")
    assert result.exit_code == 0, result.output
    assert "tanhf(" in (tmp_path / "own.c").read_text()


@pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
def test_c_of_the_spacecraft_has_the_radii_of_the_preset(invoke, tmp_path):
    result = invoke("lagros-spacecraft", "--preset", "released", "--agents", "3")
    assert result.exit_code == 0, result.output
    assert "differs from NumPy, over 1000 observations, by at most" in result.stdout
    source = load_source("lagros-spacecraft", preset="released", num_agents=3)
    text = (tmp_path / "lagros_spacecraft.c").read_text()
    rows = source.examples(50, seed=2)
    with check.CompiledPolicy(text, source) as compiled:
        np.testing.assert_allclose(compiled.answer(rows), source.answer(rows), rtol=1e-5, atol=2e-6)
        paper = load_source("lagros-spacecraft", num_agents=3)
        assert check.agreement(compiled.answer(rows), paper, rows).relative > 1e-3


@pytest.mark.skipif(not check.has_onnxruntime(), reason="no onnxruntime")
def test_onnx_of_the_spacecraft_takes_the_observation_of_so_many_agents(invoke, tmp_path):
    result = invoke("learned-spacecraft", "--format", "onnx", "--agents", "3")
    assert result.exit_code == 0, result.output
    source = load_source("learned-spacecraft", num_agents=3)
    rows = source.examples(50, seed=2)
    forces = check.onnx_answer((tmp_path / "learned_spacecraft.onnx").read_bytes(), rows)
    assert check.agreement(forces, source, rows).relative < 1e-6
    assert re.search(r"one call \d+ ns, NumPy predict \d+ ns \(here, ONNX", result.stdout)


@pytest.mark.skipif(not check.has_onnxruntime(), reason="no onnxruntime")
def test_onnx_of_own_weights_is_written_where_asked(invoke, tmp_path):
    rng = np.random.default_rng(0)
    Mlp(
        [rng.standard_normal((7, 9)), rng.standard_normal((9, 1))],
        [rng.standard_normal(9), rng.standard_normal(1)],
    ).save(tmp_path / "own.safetensors")
    result = invoke(
        "lagros-cartpole", "--format", "onnx", "--weights", "own.safetensors", "--out", "a/b.onnx"
    )
    assert result.exit_code == 0, result.output
    source = load_source("lagros-cartpole", tmp_path / "own.safetensors")
    rows = source.examples(50)
    forces = check.onnx_answer((tmp_path / "a" / "b.onnx").read_bytes(), rows)
    np.testing.assert_allclose(forces, source.answer(rows), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", ["c", "onnx"])
@pytest.mark.parametrize("task", ["cartpole", "spacecraft"])
def test_what_cannot_be_compared_is_written_and_said(invoke, tmp_path, monkeypatch, task, kind):
    monkeypatch.setattr(check, "compiler", lambda: None)
    monkeypatch.setattr(check, "has_onnxruntime", lambda: False)
    result = invoke(f"lagros-{task}", "--format", kind)
    assert result.exit_code == 0, result.output
    assert "not compared with NumPy: " in result.stdout
    assert (tmp_path / f"lagros_{task}.{kind}").is_file()


@pytest.mark.parametrize("difference", [1.0, float("nan")])
def test_a_file_that_disagrees_is_not_written(invoke, tmp_path, monkeypatch, difference):
    monkeypatch.setattr(check, "compiler", lambda: "gcc")
    monkeypatch.setattr(check, "check_c", lambda *_: check.Agreement(difference, 30.0))
    monkeypatch.setattr("lagros_policies.export.cost.c_time", lambda *_: (1e-6, 1e-6))
    result = invoke("lagros-cartpole")
    assert result.exit_code == 1
    assert "not written" in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lqr",), "choose one of lagros-cartpole, learned-cartpole"),
        (("lagros-cartpole", "--format", "h"), "--format: 'h' must be one of c, onnx"),
        (("lagros-cartpole", "--tanh", "fast"), "--tanh: 'fast' must be one of rational, libm"),
        (("lagros-cartpole", "--format", "onnx", "--tanh", "rational"), "leave it out for onnx"),
        (("lagros-cartpole", "--weights", "none.safetensors"), "there is no file none.safetensors"),
        (
            ("lagros-cartpole", "--agents", "3"),
            "cartpole is one body: --preset",
        ),
        (("lagros-spacecraft", "--tanh", "libm"), "the network of lagros-spacecraft has no tanh"),
        (("lagros-spacecraft", "--preset", "moon"), "preset='moon' is not known"),
        (("lagros-spacecraft", "--agents", "0"), "num_agents=0 must be a whole number"),
        (
            ("lagros-spacecraft", "--weights", "none.safetensors"),
            "there is no file none.safetensors",
        ),
    ],
)
def test_a_mistake_is_explained_with_status_2_and_no_traceback(invoke, arguments, message):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.output
