"""Exports of any task of one body, and of any features: C by gcc and ONNX by ONNX Runtime."""

import itertools
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from lagros_envs.numbers import functions
from lagros_envs.registry import find_task
from lagros_policies.export import Source, check, load_source
from lagros_policies.export.c99 import c_file
from lagros_policies.export.onnx import onnx_file
from lagros_policies.export.program import Part, Program, Vector
from lagros_policies.learning.features import view_of
from lagros_policies.learning.networks import Mlp

IDENTITY = np.eye(12, dtype=np.float32)


@pytest.fixture(params=["c", "onnx"])
def answer(request):
    """From a source to what its exported file answers."""
    if request.param == "onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
        yield lambda source, rows: check.onnx_answer(onnx_file(source), rows)
        return
    if check.compiler() is None:
        pytest.skip("no C compiler")

    def by_c(source, rows):
        with check.CompiledPolicy(c_file(source), source) as compiled:
            return compiled.answer(rows)

    yield by_c


def network_of(task, folder, seed=0):
    """A network of no use, so that no task needs weights here."""
    rng = np.random.default_rng(seed)
    widths = [len(view_of(task).names), 20, 7, task.system.control_dim]
    pairs = list(itertools.pairwise(widths))
    weights = [rng.standard_normal(pair) / np.sqrt(pair[0]) for pair in pairs]
    Mlp(weights, [rng.standard_normal(pair[1]) for pair in pairs]).save(folder / "own.safetensors")
    return folder / "own.safetensors"


@pytest.mark.parametrize("name", ["pvtol", "car"])
def test_a_task_of_anybody_is_exported_with_its_features(name, answer, tmp_path):
    task = find_task(name)
    source = load_source(f"lagros-{name}", network_of(task, tmp_path))
    assert source.name == f"lagros-{task.name}"
    rows = source.examples(300, seed=2)
    # The action is the control without its centre, over its scale.
    action, _ = source.policy.predict(rows)
    wanted = np.array(task.control_centre) + np.array(task.control_scale) * action
    found = answer(source, rows)
    assert found.shape == (300, task.system.control_dim)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5 * np.max(np.abs(wanted)))


def test_a_scheduled_gain_is_exported(answer, tmp_path):
    rng = np.random.default_rng(3)
    layers = [
        (rng.standard_normal(pair), rng.standard_normal(pair[1])) for pair in ((3, 20), (20, 5))
    ]
    network = Mlp(*zip(*layers, strict=True), scheduled=4)
    network.save(tmp_path / "own.safetensors")
    source = load_source("lagros-cartpole", tmp_path / "own.safetensors")
    rows = source.examples(300, seed=2)
    side = np.where(rows[:, 9] < 0.0, -1.0, 1.0)[:, None]
    state, goal, start = rows[:, :4], rows[:, 4:8], rows[:, 8:12]
    scheduling = np.column_stack([side * (goal - start)[:, :1], side * start[:, 1:2], rows[:, 12]])
    numbers = np.tanh(scheduling @ layers[0][0] + layers[0][1]) @ layers[1][0] + layers[1][1]
    near = side * (state - [[1.0, 0.0, 0.0, 0.0]] * goal)
    wanted = side * (numbers[:, :1] + (numbers[:, 1:] * near).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(answer(source, rows), wanted, rtol=2e-5, atol=1e-4)


def test_nan_is_not_hidden_by_a_choice(answer, tmp_path):
    """What is seen of a disc is chosen by its radius: NaN would say that there is none."""
    task = find_task("pvtol")
    source = load_source("lagros-pvtol", network_of(task, tmp_path))
    row = source.examples(1)[0]
    rows = np.repeat(row[None], len(row), axis=0)
    np.fill_diagonal(rows, np.nan)
    unread = np.zeros(len(row), bool)
    for part in (task.layout.initial_state, task.layout.goal):
        unread[part] = ~np.isnan(viewed(task, row, part))
    hidden = ~np.isnan(answer(source, rows)).all(axis=1)
    np.testing.assert_array_equal(hidden, unread)
    assert np.isfinite(answer(source, row[None])).all()


def viewed(task, row, part):
    """NaN for each number of a part of the observation that the features hold."""
    found = []
    for place in range(*part.indices(len(row))):
        spoiled = row.copy().tolist()
        spoiled[place] = np.nan
        found.append(np.sum(view_of(task)(spoiled, functions).features))
    return np.array(found)


def look(given):
    """Every operation that features may use."""
    a, b, c = given
    turned = Vector(a, b) * Vector(c, 0.5).conj() / 2.0
    inside = (a > -1.0) & (b < 0.5)
    features = [
        functions.sin(a) + functions.cos(b) * functions.tan(0.3 * c),
        functions.exp(-abs(a)) / functions.sqrt(2.0 + b * b),
        a**3 - c**-2,
        functions.minimum(a, b),
        functions.maximum(b - c, 0.25),
        functions.where(inside | (c >= 2.0), a, b) + functions.where(inside, 1.0, c),
        turned.real,
        (-turned + 1.0).imag,
        abs(turned),
        1.5,
        c,
        2.0 - a,
    ]
    return features, [a * b]


def of_features(parts):
    """A source whose answer is its features."""
    program = Program(
        parts,
        look,
        [(IDENTITY, np.zeros(12, np.float32))],
        lambda outputs, context: [*outputs[1:], outputs[0] * context[0]],
        Part("control", 12, "u"),
    )

    def by_numpy(rows):
        features, (product,) = look(rows.astype(np.float64).T)
        first, *others = np.broadcast_arrays(*features)
        return np.stack([*others, first * product], axis=1).astype(np.float32)

    def examples(count, seed=0):
        rows = np.random.default_rng(seed).uniform(-2.0, 2.0, (count, 3)).astype(np.float32)
        rows[:, 2] = 0.5 + np.abs(rows[:, 2])
        return rows

    return Source(program, by_numpy, examples, "own-features", "none", "0", None)


@pytest.mark.parametrize(
    "parts",
    [(Part("x", 3, "all"),), (Part("a", 0, "first"), Part("others", 2, "the others"))],
)
def test_every_operation_means_the_same_in_every_language(parts, answer):
    source = of_features(parts)
    rows = source.examples(400, seed=1)
    np.testing.assert_allclose(answer(source, rows), source.answer(rows), rtol=2e-5, atol=2e-5)


def test_features_may_be_constant_or_the_same(answer):
    source = of_features((Part("x", 3, "all"),))
    program = Program(
        source.program.parts,
        lambda given: ([given[1]] * 11 + [2.0], []),
        source.program.layers,
        lambda outputs, _: [outputs[11]] * 6 + [outputs[0]] * 5 + [0.5],
        source.program.control,
    )
    rows = source.examples(3)
    found = answer(replace(source, program=program, name="own"), rows)
    y = rows[:, 1:2]
    two, half = np.full((3, 6), 2.0), np.full((3, 1), 0.5)
    np.testing.assert_array_equal(found, np.hstack([two, *[y] * 5, half]))


@pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", ["pvtol", "own"])
def test_the_file_compiles_without_a_warning_and_tests_itself(name, tmp_path):
    source = of_features((Part("x", 3, "all"),))
    if name == "pvtol":
        source = load_source("lagros-pvtol", network_of(find_task(name), tmp_path))
    code, program = tmp_path / "policy.c", tmp_path / "policy"
    code.write_text(c_file(source))
    flags = [*check.STRICT, "-Wmissing-prototypes", "-Wconversion", "-DLAGROS_SELF_TEST"]
    subprocess.run([check.compiler(), *flags, code, "-o", program, "-lm"], check=True)
    assert "8 of 8 cases agree" in subprocess.run([program], capture_output=True, text=True).stdout


def test_features_that_branch_are_refused():
    source = of_features((Part("x", 3, "all"),))

    def branching(given):
        return ([1.0] * 12 if given[0] > 0.0 else [0.0] * 12), []

    program = Program(
        source.program.parts, branching, source.program.layers, lambda u, _: u, Part("u", 12, "")
    )
    with pytest.raises(TypeError, match="must not branch"):
        c_file(replace(source, program=program, name="own"))
