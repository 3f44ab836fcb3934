"""Exported spacecraft policies: C by gcc and ONNX by ONNX Runtime, against NumPy and symmetry."""

import ctypes
import hashlib
import itertools
import subprocess

import numpy as np
import pytest

from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies import make
from lagros_policies.export import check, load_source
from lagros_policies.export.c99 import c_file
from lagros_policies.export.onnx import onnx_file
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.room import PRETRAINED

needs_compiler = pytest.mark.skipif(check.compiler() is None, reason="no C compiler")
needs_onnx = pytest.mark.skipif(not check.has_onnxruntime(), reason="no onnxruntime")

SPACECRAFT_NAMES = ("lagros-spacecraft", "learned-spacecraft")
WORLDS = [("paper", None), ("released", 2), ("open", 1)]
CLOSE = {"rtol": 1e-5, "atol": 2e-6}


def save_network(path, first=(17, 20), second=(5,), last=(33, 3), seed=0):
    rng = np.random.default_rng(seed)

    def layers(widths):
        return [
            (1.5 * rng.standard_normal(pair) / np.sqrt(pair[0]), rng.standard_normal(pair[1]))
            for pair in itertools.pairwise(widths)
        ]

    own = 9 + first[-1] + second[-1]
    DeepSet(layers([7, *first]), layers([8, *second]), layers([own, *last])).save(path)
    return path


def in_flight(source, agents):
    """Observations of a few worlds after some steps of the policy itself."""
    env = SpacecraftVectorEnv(
        agents * 8, agents, source.policy.preset, "uniform", 0.4, autoreset_mode="disabled"
    )
    observation, _ = env.reset(seed=list(range(8)))
    rows = []
    for step in range(120):
        if step % 20 == 0:
            rows.append(observation)
        observation, *_ = env.step(source.policy.predict(observation)[0])
    env.close()
    return np.concatenate(rows)


def turned(source, rows, angle):
    """The same scenes, the whole world turned counter-clockwise; headings count clockwise."""
    spin = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    found = rows.astype(np.float64)
    at = source.policy.layout.slices
    pairs = [slice(0, 2), slice(2, 4)]
    begin = at["neighbours"].start
    pairs += [slice(i, i + 2) for i in range(begin, at["neighbours"].stop, 2)]
    begin = at["obstacles"].start
    pairs += [slice(i, i + 2) for i in range(begin, at["obstacles"].stop, 3)]
    for pair in pairs:
        found[:, pair] = found[:, pair] @ spin.T
    heading = np.arctan2(found[:, 5], found[:, 4]) - angle
    found[:, 4], found[:, 5] = np.cos(heading), np.sin(heading)
    return found.astype(np.float32)


class Called:
    """The two functions of a C file, called from Python."""

    def __init__(self, text, source, folder):
        code, library = folder / "policy.c", folder / "policy.so"
        code.write_text(text)
        flags = [*check.STRICT, "-O2", "-shared", "-fPIC"]
        subprocess.run([check.compiler(), *flags, code, "-o", library, "-lm"], check=True)
        loaded = ctypes.CDLL(str(library))
        self._thrust = loaded[f"{source.name.replace('-', '_')}_thrust"]
        self._thrust.restype = None

    def thrust(self, own, neighbours, obstacles):
        own, neighbours, obstacles = (
            np.ascontiguousarray(part, np.float32) for part in (own, neighbours, obstacles)
        )
        forces = np.empty(8, np.float32)
        pointer = ctypes.c_void_p
        self._thrust(
            pointer(own.ctypes.data),
            pointer(neighbours.ctypes.data),
            len(neighbours),
            pointer(obstacles.ctypes.data),
            len(obstacles),
            pointer(forces.ctypes.data),
        )
        return forces


@pytest.fixture(scope="module")
def called(tmp_path_factory):
    source = load_source("lagros-spacecraft", num_agents=9)
    return source, Called(c_file(source), source, tmp_path_factory.mktemp("c"))


@needs_compiler
@pytest.mark.parametrize(("preset", "agents"), WORLDS)
@pytest.mark.parametrize("name", SPACECRAFT_NAMES)
def test_c_equals_numpy(name, preset, agents):
    source = load_source(name, preset=preset, num_agents=agents)
    rows = source.examples(500)
    wanted = source.answer(rows)
    assert np.min(wanted) == 0.0
    assert np.max(wanted) > 0.05
    with check.CompiledPolicy(c_file(source), source) as compiled:
        np.testing.assert_allclose(compiled.answer(rows), wanted, **CLOSE)


@needs_compiler
def test_c_equals_numpy_in_flight():
    source = load_source("lagros-spacecraft", num_agents=4)
    rows = in_flight(source, 4)
    at = source.policy.layout.slices
    assert np.any(rows[:, at["neighbour_mask"]])
    assert np.any(rows[:, at["obstacle_mask"]])
    with check.CompiledPolicy(c_file(source), source) as compiled:
        np.testing.assert_allclose(compiled.answer(rows), source.answer(rows), **CLOSE)


@needs_compiler
def test_c_does_not_care_how_the_world_is_turned():
    source = load_source("lagros-spacecraft")
    rows = source.examples(200)
    with check.CompiledPolicy(c_file(source), source) as compiled:
        forces = compiled.answer(rows)
        for angle in (0.7, np.pi / 2, -2.5):
            again = compiled.answer(turned(source, rows, angle))
            np.testing.assert_allclose(again, forces, rtol=1e-4, atol=1e-5)


@needs_compiler
def test_bodies_may_come_in_any_number_and_order(called):
    source, function = called
    at, layout = source.policy.layout.slices, source.policy.layout
    rng = np.random.default_rng(3)
    rows = source.examples(40)
    for row, wanted in zip(rows, source.answer(rows), strict=True):
        parts = []
        for kind, width in (("neighbour", 4), ("obstacle", 3)):
            slots = row[at[f"{kind}s"]].reshape(getattr(layout, f"{kind}s"), width)
            parts.append(rng.permutation(slots[row[at[f"{kind}_mask"]] > 0.0]))
        np.testing.assert_allclose(function.thrust(row[:9], *parts), wanted, rtol=1e-5, atol=1e-5)


@needs_compiler
def test_a_body_out_of_sight_has_no_influence(called):
    _, function = called
    own = np.array([2.0, 1.0, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 3.0])
    none, empty = np.empty((0, 4)), np.empty((0, 3))
    alone = function.thrust(own, none, empty)
    np.testing.assert_array_equal(function.thrust(own, [[2.001, 0.0, 0.1, 0.2]], empty), alone)
    np.testing.assert_array_equal(function.thrust(own, none, [[0.0, -2.501, 0.5]]), alone)
    assert np.any(function.thrust(own, [[1.5, 0.0, -0.1, 0.2]], empty) != alone)
    assert np.any(function.thrust(own, none, [[1.5, 0.0, 0.5]]) != alone)


@needs_compiler
def test_c_at_the_goal_and_inside_another_body_is_finite(called):
    source, function = called
    own = np.zeros(9)
    own[4] = 1.0
    neighbours, obstacles = np.zeros((1, 4)), np.array([[0.0, 0.0, 0.5]])
    forces = function.thrust(own, neighbours, obstacles)
    row = np.zeros((1, source.program.inputs), np.float32)
    at = source.policy.layout.slices
    row[0, :9] = own
    row[0, at["neighbour_mask"].start] = row[0, at["obstacle_mask"].start] = 1.0
    row[0, at["obstacles"].start + 2] = 0.5
    np.testing.assert_allclose(forces, source.answer(row)[0], **CLOSE)


@needs_compiler
def test_no_nan_is_lost_in_c(called):
    _, function = called
    own = np.array([2.0, 1.0, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 3.0])
    bodies = [own, np.array([[1.0, 0.5, -0.1, 0.1]]), np.array([[-1.0, 0.5, 0.4]])]
    assert np.all(np.isfinite(function.thrust(*bodies)))
    for part, body in enumerate(bodies):
        for place in range(body.size):
            spoiled = [item.copy() for item in bodies]
            spoiled[part].flat[place] = np.nan
            assert np.all(np.isnan(function.thrust(*spoiled))), (part, place)


@pytest.mark.parametrize("kind", ["c", "onnx"])
def test_no_nan_of_the_flat_observation_is_lost(kind):
    source = load_source("lagros-spacecraft", num_agents=3)
    at = source.policy.layout.slices
    rows = source.examples(50, seed=4)
    seen = rows[:, [*range(*at["neighbour_mask"].indices(99)), at["obstacle_mask"].start]]
    row = rows[np.argmax(np.sum(seen, axis=1))]
    assert np.all(row[at["neighbour_mask"]] == 1.0)
    assert 0.0 < np.mean(row[at["obstacle_mask"]]) < 1.0
    spoiled = np.repeat(row[None], len(row), axis=0)
    np.fill_diagonal(spoiled, np.nan)
    if kind == "onnx":
        pytest.importorskip("onnxruntime")
        forces = check.onnx_answer(onnx_file(source), spoiled)
    elif check.compiler() is None:
        pytest.skip("no C compiler")
    else:
        with check.CompiledPolicy(c_file(source), source) as compiled:
            forces = compiled.answer(spoiled)
    # A slot that is empty is not read by C; its mask is.
    read = np.ones(len(row), bool)
    if kind == "c":
        read[at["obstacles"]] = np.repeat(row[at["obstacle_mask"]] > 0.0, 3)
    np.testing.assert_array_equal(np.isnan(forces), np.repeat(read[:, None], 8, axis=1))


@needs_onnx
@pytest.mark.parametrize("part", ["goal", "velocity", "spin", "time"])
@pytest.mark.parametrize("scale", [0.0, 1e-6, 10.0, 1e3, 1e6, 1e12])
def test_onnx_equals_numpy_far_outside_of_what_was_trained(part, scale):
    source = load_source("lagros-spacecraft", num_agents=3)
    rows = source.examples(300, seed=5)
    rows[:, source.policy.layout.slices[part]] *= np.float32(scale)
    found = check.agreement(check.onnx_answer(onnx_file(source), rows), source, rows)
    assert found.relative < 2e-6


@needs_compiler
@pytest.mark.parametrize(
    "widths",
    [{}, {"first": (3,), "second": (16, 50), "last": (3,)}, {"first": (40,), "last": (9, 40, 3)}],
)
def test_c_of_any_network(tmp_path, widths):
    path = save_network(tmp_path / "own.safetensors", **widths)
    source = load_source("lagros-spacecraft", path, num_agents=3)
    with check.CompiledPolicy(c_file(source), source) as compiled:
        rows = source.examples(200)
        assert check.agreement(compiled.answer(rows), source, rows).relative < 2e-6
    if check.has_onnxruntime():
        assert check.check_onnx(onnx_file(source), source, 200).relative < 2e-6


@pytest.mark.parametrize(
    ("preset", "agents"), [("swarm", 6), ("swarm", 32), ("swarm-45", 32), ("gcbf", 8)]
)
def test_what_is_exported_is_what_flies_in_such_a_world(preset, agents):
    source = load_source("lagros-spacecraft", preset=preset, num_agents=agents)
    env = SpacecraftVectorEnv(agents, agents, preset)
    flown = make("lagros", env)
    rows, _ = env.reset(seed=[0])
    np.testing.assert_array_equal(source.answer(rows), flown.thrust(rows).astype(np.float32))
    assert source.policy.settings == flown.settings
    wanted = "spacecraft_lagros.safetensors", "spacecraft_crowds.safetensors"
    assert source.file == wanted[flown.receding is not None]
    assert source.digest == hashlib.sha256((PRETRAINED / source.file).read_bytes()).hexdigest()


@needs_compiler
def test_the_self_test_passes_and_can_fail(tmp_path):
    source = load_source("lagros-spacecraft")
    text = c_file(source)
    spoiled = text.replace("input[7] = own[6];", "input[7] = own[6] + 0.01f;")
    assert spoiled != text
    for case, status in ((text, 0), (spoiled, 1)):
        code, program = tmp_path / "policy.c", tmp_path / "policy"
        code.write_text(case)
        flags = [*check.STRICT, "-Wmissing-prototypes", "-Wconversion", "-DLAGROS_SELF_TEST"]
        subprocess.run([check.compiler(), *flags, code, "-o", program, "-lm"], check=True)
        done = subprocess.run([program], capture_output=True, text=True, check=False)
        assert done.returncode == status
        assert ("8 of 8 cases agree" in done.stdout) == (status == 0)


@needs_onnx
@pytest.mark.parametrize(("preset", "agents"), WORLDS)
@pytest.mark.parametrize("name", SPACECRAFT_NAMES)
def test_onnx_equals_numpy(name, preset, agents):
    source = load_source(name, preset=preset, num_agents=agents)
    rows = source.examples(500)
    model = onnx_file(source)
    forces = check.onnx_answer(model, rows)
    assert check.agreement(forces, source, rows).relative < 1e-6
    np.testing.assert_allclose(check.onnx_answer(model, rows[:1])[0], forces[0], **CLOSE)


@needs_onnx
def test_onnx_equals_numpy_in_flight_and_ignores_what_is_not_sensed():
    source = load_source("lagros-spacecraft", num_agents=4)
    rows = in_flight(source, 4)
    model = onnx_file(source)
    forces = check.onnx_answer(model, rows)
    np.testing.assert_allclose(forces, source.answer(rows), **CLOSE)
    at, layout = source.policy.layout.slices, source.policy.layout
    spoiled = rows.copy()
    for kind, width in (("neighbour", 4), ("obstacle", 3)):
        absent = np.repeat(rows[:, at[f"{kind}_mask"]] == 0.0, width, axis=1)
        assert absent.shape[1] == width * getattr(layout, f"{kind}s")
        spoiled[:, at[f"{kind}s"]][absent] = 0.9
    np.testing.assert_allclose(check.onnx_answer(model, spoiled), forces, **CLOSE)
    if check.compiler() is not None:
        with check.CompiledPolicy(c_file(source), source) as compiled:
            np.testing.assert_allclose(compiled.answer(spoiled), forces, **CLOSE)


@needs_onnx
def test_onnx_ports_and_provenance():
    import onnxruntime

    source = load_source("lagros-spacecraft", num_agents=3)
    session = onnxruntime.InferenceSession(onnx_file(source), providers=["CPUExecutionProvider"])
    (port,), (answer,) = session.get_inputs(), session.get_outputs()
    assert (port.name, port.shape, port.type) == ("observation", ["batch", 43], "tensor(float)")
    assert (answer.name, answer.shape) == ("thrust", ["batch", 8])
    properties = session.get_modelmeta().custom_metadata_map
    assert properties["weights_sha256"] == source.digest
    assert properties["neighbour_slots"] == "2"
    assert properties["agent_radius"] == "0.25"


def test_the_c_file_is_the_same_again_and_has_the_presets_radii():
    source = load_source("lagros-spacecraft", preset="released")
    text = c_file(source)
    assert text == c_file(source)
    assert source.digest in text
    assert "malloc" not in text
    assert "0.5 m against others, 0 m against obstacles" in " ".join(text.split())
