"""Exported files: C compiled by gcc and ONNX by ONNX Runtime, against NumPy and float64."""

import hashlib
import itertools
import subprocess

import numpy as np
import pytest

from lagros_envs.registry import find_task
from lagros_envs.tasks.cartpole import task
from lagros_policies.export import check, load_source
from lagros_policies.export.c99 import TANHS, c_file
from lagros_policies.export.c_layers import TANH_ERROR
from lagros_policies.export.onnx import network_model, onnx_file
from lagros_policies.export.single import example_observations
from lagros_policies.learning.features import seen, view_of
from lagros_policies.learning.layers import written_out
from lagros_policies.learning.networks import Mlp
from lagros_policies.room import PRETRAINED

needs_compiler = pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
CARTPOLE_NAMES = ("lagros-cartpole", "learned-cartpole")
needs_onnx = pytest.mark.skipif(not check.has_onnxruntime(), reason="no onnxruntime")


def examples(count, seed=0):
    return example_observations(task.CartPoleSettings(), count, seed)


def by_hand(network, observation):
    """Return u_L in float64, written from the definition of the features and not by our code."""
    forces = []
    for row in observation.astype(float):
        x, goal, start, t = row[:4], row[4:8], row[8:12], row[12]
        mirror = -1.0 if start[1] < 0 else 1.0
        layer = np.append(
            mirror * np.array([x[0] - goal[0], *x[1:], goal[0] - start[0], start[1]]), t
        )
        near, layer = layer[: network.scheduled], layer[network.scheduled :]
        for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
            layer = layer @ weight.astype(float) + bias
            if index < len(network.weights) - 1:
                layer = np.tanh(layer)
        forces.append(mirror * (layer[:1] + layer[1:] @ near))
    return np.array(forces)


def save_network(path, widths, seed=0):
    rng = np.random.default_rng(seed)
    sizes = [7, *widths, 1]
    pairs = list(itertools.pairwise(sizes))
    weights = [2.0 * rng.standard_normal(pair) / np.sqrt(pair[0]) for pair in pairs]
    Mlp(weights, [rng.standard_normal(pair[1]) for pair in pairs]).save(path)
    return path


@pytest.fixture(scope="module")
def observations():
    rows = examples(400)
    # Both sides, an upright start (which is no left start), and a start away from the origin.
    assert 100 < np.sum(rows[:, 9] < 0) < 300
    rows[0, 9] = 0.0
    rows[1, 9] = -0.0
    rows[2:40, 8] = 1.5
    return rows


@needs_compiler
@pytest.mark.parametrize("tanh", TANHS)
@pytest.mark.parametrize("name", CARTPOLE_NAMES)
def test_c_equals_numpy_and_the_definition(name, tanh, observations):
    source = load_source(name)
    with check.CompiledPolicy(c_file(source, tanh), source) as compiled:
        forces = compiled.answer(observations)
    wanted = source.answer(observations)
    np.testing.assert_allclose(forces, wanted, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        forces, by_hand(source.policy.network, observations), rtol=1e-5, atol=1e-5
    )
    # The force is in newtons: the action of the task times its scale.
    settings = task.CartPoleSettings()
    action, _ = type(source.policy)(settings, allow_other_settings=True).predict(observations)
    np.testing.assert_allclose(forces, settings.force_scale * action, rtol=1e-5, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize("widths", [(), (3,), (32, 17), (13, 40, 24), (1, 20)])
def test_c_of_any_network(tmp_path, widths, observations):
    source = load_source("lagros-cartpole", save_network(tmp_path / "own.safetensors", widths))
    wanted = by_hand(source.policy.network, observations)
    for tanh in TANHS:
        with check.CompiledPolicy(c_file(source, tanh), source) as compiled:
            forces = compiled.answer(observations)
        np.testing.assert_allclose(forces, wanted, rtol=1e-5, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize("hidden", [(5, 3, 4), (32, 17, 20, 9), (20, 16, 33)])
def test_c_of_a_network_that_treats_discs_alike(tmp_path, hidden):
    """Its layers are kept once there, and written out here."""
    car, rng = find_task("car"), np.random.default_rng(1)
    view = view_of(car)
    rest, (wide, last, *others) = len(view.names) - view.alike.things * view.alike.size, hidden
    shapes = [(rest + view.alike.size, wide), (rest, wide), (wide, last), (wide, last)]
    shapes += itertools.pairwise([2 * last, *others, 2])
    weights = [rng.standard_normal(shape) / np.sqrt(shape[0]) for shape in shapes]
    biases = [rng.standard_normal(shape[1]) for shape in shapes]
    file = tmp_path / "discs.safetensors"
    Mlp(weights, biases, alike=view.alike).save(file)
    source = load_source("lagros-car", file)
    rows = example_observations(car, 300)
    wanted = seen(view, rows)[0].astype(float)
    for weight, bias in zip(*written_out(weights, biases, view.alike), strict=True):
        wanted = np.tanh(wanted) if wanted.shape[1] != len(view.names) else wanted
        wanted = wanted @ weight + bias
    for tanh in TANHS:
        with check.CompiledPolicy(c_file(source, tanh), source) as compiled:
            np.testing.assert_allclose(compiled.answer(rows), wanted, rtol=1e-5, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize("tanh", TANHS)
def test_the_self_test_passes_and_can_fail(tmp_path, tanh):
    source = load_source("learned-cartpole")
    text = c_file(source, tanh)
    spoiled = text.replace("input[6] = time;", "input[6] = time + 0.01f;")
    assert spoiled != text
    for case, status in ((text, 0), (spoiled, 1)):
        code, program = tmp_path / "policy.c", tmp_path / "policy"
        code.write_text(case)
        flags = [*check.STRICT, "-Wmissing-prototypes", "-Wconversion", "-DLAGROS_SELF_TEST"]
        command = [check.compiler(), *flags, str(code), "-o", str(program), "-lm"]
        subprocess.run(command, check=True)
        done = subprocess.run([program], capture_output=True, text=True, check=False)
        assert done.returncode == status
        assert ("8 of 8 cases agree" in done.stdout) == (status == 0)


@needs_compiler
def test_the_rational_tanh_keeps_its_stated_error(tmp_path):
    # 0 -> tanh(v x) with one hidden unit: time is the feature that is not mirrored.
    weight = np.zeros((7, 1))
    weight[6] = 1.0
    Mlp([weight, np.ones((1, 1))], [np.zeros(1), np.zeros(1)]).save(tmp_path / "tanh.safetensors")
    source = load_source("lagros-cartpole", tmp_path / "tanh.safetensors")
    times = np.concatenate([np.linspace(1e-6, 12.0, 200_001), 2.0 ** np.linspace(-60, 60, 50_001)])
    rows = np.zeros((2 * len(times), 13), np.float32)
    rows[:, 12] = np.concatenate([times, -times])
    with check.CompiledPolicy(c_file(source, "rational"), source) as compiled:
        values = compiled.answer(rows)[:, 0]
        rows[:1, 12] = np.nan
        assert np.isnan(compiled.answer(rows[:1])).all()
    wanted = np.tanh(np.concatenate([times, -times]).astype(np.float32).astype(float))
    assert np.max(np.abs(values / wanted - 1.0)) <= TANH_ERROR


@needs_onnx
@pytest.mark.parametrize("name", CARTPOLE_NAMES)
def test_onnx_equals_numpy(name, observations):
    source = load_source(name)
    model = onnx_file(source)
    forces = check.onnx_answer(model, observations)
    found = check.agreement(forces, source, observations)
    assert found.largest > 10.0
    assert found.relative < 1e-6
    # A batch of one is the same model.
    assert check.onnx_answer(model, observations[:1])[0] == pytest.approx(forces[0], rel=1e-5)


# What u_L reads of an observation: the rest of the goal and of the start are not used.
READ = (0, 1, 2, 3, 4, 8, 9, 12)


def spoiled(value):
    """One observation for each of its numbers, which has this value there."""
    rows = np.repeat(examples(1, seed=3), 13, axis=0)
    np.fill_diagonal(rows, value)
    return rows


@pytest.fixture(params=["c", "onnx"])
def exported(request):
    """The shipped policy and its export as a function."""
    source = load_source("lagros-cartpole")
    if request.param == "onnx":
        pytest.importorskip("onnxruntime")
        yield source, lambda rows: check.onnx_answer(onnx_file(source), rows)
        return
    if check.compiler() is None:
        pytest.skip("no C compiler")
    with check.CompiledPolicy(c_file(source), source) as compiled:
        yield source, compiled.answer


def test_nan_where_it_is_read_and_nowhere_else(exported):
    _, force = exported
    assert tuple(np.flatnonzero(np.isnan(force(spoiled(np.nan))))) == READ


@pytest.mark.parametrize("value", [np.inf, -np.inf, 3e38, -3e38, 1e-45])
def test_infinite_and_extreme_numbers_as_in_numpy(exported, value):
    source, force = exported
    rows = spoiled(value)
    with np.errstate(all="ignore"):
        wanted = source.answer(rows)
    # Two infinities of opposite sign, of the goal in two features, may meet in the first layer.
    assert set(np.flatnonzero(np.isnan(wanted))) <= {4}
    np.testing.assert_allclose(force(rows), wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("scale", [3.0, 10.0, 100.0, 1e3, 1e4, 1e10, 1e30])
def test_far_outside_of_what_was_trained_no_worse_than_numpy(exported, scale):
    source, force = exported
    rows = (examples(500, seed=7) * np.float32(scale)).astype(np.float32)
    exact, wanted = by_hand(source.policy.network, rows), source.answer(rows)
    largest = np.max(np.abs(exact))
    # Pre-activations of this size have no more digits than float32 leaves them, nor do features,
    # which NumPy forms in double precision: what the last digit of an observation decides.
    rounding = np.max(np.abs(wanted - exact)) / largest
    moved = by_hand(source.policy.network, np.nextafter(rows, np.float32(np.inf)))
    digit = np.max(np.abs(moved - exact)) / largest
    assert np.max(np.abs(force(rows) - exact)) / largest <= 1e-6 + 3.0 * max(rounding, digit)
    assert rounding < 1e-4


def test_near_the_force_itself_where_it_exceeds_a_newton(exported):
    source, force = exported
    rows = examples(5000)
    wanted = source.answer(rows)
    large = np.abs(wanted) > 1.0
    assert np.mean(large) > 0.8
    # Offset and gain times state, of a hundred newtons each, may leave one.
    exact = by_hand(source.policy.network, rows)
    np.testing.assert_allclose(force(rows)[large], wanted[large], rtol=4e-5)
    np.testing.assert_allclose(wanted[large], exact[large], rtol=4e-5)


@needs_onnx
def test_onnx_ports_and_provenance():
    import onnxruntime

    source = load_source("lagros-cartpole")
    session = onnxruntime.InferenceSession(onnx_file(source), providers=["CPUExecutionProvider"])
    (port,), (answer,) = session.get_inputs(), session.get_outputs()
    assert (port.name, port.shape, port.type) == ("observation", ["batch", 13], "tensor(float)")
    assert (answer.name, answer.shape) == ("force", ["batch", 1])
    properties = session.get_modelmeta().custom_metadata_map
    assert properties["weights_sha256"] == source.digest
    assert properties["unit"] == "N"


@needs_onnx
@pytest.mark.parametrize("scheduled", [0, 2])
def test_onnx_of_a_bare_network(scheduled):
    import onnxruntime

    rng = np.random.default_rng(0)
    pairs = (7 - scheduled, 20), (20, 1 + scheduled)
    layers = [(rng.standard_normal(pair), rng.standard_normal(pair[1])) for pair in pairs]
    network = Mlp(*zip(*layers, strict=True), scheduled=scheduled)
    session = onnxruntime.InferenceSession(
        network_model(network), providers=["CPUExecutionProvider"]
    )
    features = np.linspace(-1.0, 1.0, 7, dtype=np.float32)
    (value,) = session.run(["y"], {"x": features[None]})
    np.testing.assert_allclose(value[0], network(features), rtol=1e-5, atol=1e-6)


def test_the_provenance_is_that_of_the_file():
    source = load_source("lagros-cartpole")
    data = (PRETRAINED / "cartpole_lagros.safetensors").read_bytes()
    assert source.digest == hashlib.sha256(data).hexdigest()
    text = c_file(source)
    assert source.digest in text
    assert "malloc" not in text
    assert text == c_file(source)


def test_mistakes_are_explained(tmp_path):
    with pytest.raises(ValueError, match="choose one of lagros-cartpole, learned-cartpole, "):
        load_source("lqr")
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load_source("lagros-cartpole", tmp_path / "none.safetensors")
    Mlp([np.ones((5, 1))], [np.ones(1)]).save(tmp_path / "five.safetensors")
    with pytest.raises(ValueError, match="network has 7 and 1"):
        load_source("lagros-cartpole", tmp_path / "five.safetensors")
    with pytest.raises(ValueError, match="tanh='fast' must be one of rational, libm"):
        c_file(load_source("lagros-cartpole"), "fast")


@needs_compiler
def test_a_file_that_does_not_compile_is_refused():
    source = load_source("lagros-cartpole")
    with pytest.raises(RuntimeError, match="refuses the exported file"):
        check.CompiledPolicy(c_file(source) + "int unused(", source)


def test_an_agreement_with_nan_is_none():
    source = load_source("lagros-cartpole")
    rows = examples(3)
    forces = source.answer(rows).copy()
    forces[1] = np.nan
    assert not check.agreement(forces, source, rows).relative <= 1.0
