"""Networks in NumPy against torch, their files, and what they see of an observation."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import save

from lagros_envs.tasks.cartpole import task
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learning.features import seen
from lagros_policies.learning.networks import Mlp, read_safetensors, write_safetensors
from lagros_policies.tasks.cartpole.features import CartPoleView


def cartpole_view(observation):
    features, side = seen(CartPoleView(), observation)
    return features, side[..., 0]


def random_network(widths, seed=0):
    rng = np.random.default_rng(seed)
    weights = [
        rng.standard_normal(shape) / np.sqrt(shape[0]) for shape in itertools.pairwise(widths)
    ]
    return Mlp(weights, [rng.standard_normal(width) for width in widths[1:]])


def in_torch(network):
    layers = []
    for weight, bias in zip(network.weights, network.biases, strict=True):
        layer = torch.nn.Linear(*weight.shape)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(weight.T))
            layer.bias.copy_(torch.from_numpy(bias))
        layers += [layer, torch.nn.Tanh()]
    return torch.nn.Sequential(*layers[:-1])


@pytest.mark.parametrize("widths", [(7, 100, 100, 100, 1), (3, 5, 2), (4, 1)])
def test_network_agrees_with_torch(widths):
    network = random_network(widths)
    features = np.random.default_rng(1).standard_normal((64, widths[0])).astype(np.float32)
    with torch.no_grad():
        expected = in_torch(network)(torch.from_numpy(features)).numpy()
    batch = network(features)
    assert batch.dtype == np.float32
    assert batch == pytest.approx(expected, abs=1e-5)
    rows = np.stack([network(row).copy() for row in features])
    assert rows.dtype == np.float32
    assert rows == pytest.approx(expected, abs=1e-5)
    assert (network.inputs, network.outputs) == (widths[0], widths[-1])


def scheduled_network(seed=0, state=3, others=2, controls=2):
    widths = (others, 9, controls * (1 + state))
    plain = random_network(widths, seed)
    return Mlp(plain.weights, plain.biases, scheduled=state), plain


def test_a_scheduled_gain_is_affine_in_the_first_inputs():
    network, plain = scheduled_network()
    rows = np.random.default_rng(1).standard_normal((50, 5)).astype(np.float32)
    assert (network.inputs, network.outputs) == (5, 2)
    offset, gain = network.law(rows[:, 3:])
    layers = plain(rows[:, 3:])
    for index, row in enumerate(rows):
        wanted = [
            layers[index, which]
            + sum(layers[index, 2 + 3 * which + column] * row[column] for column in range(3))
            for which in range(2)
        ]
        assert network(row) == pytest.approx(wanted, abs=1e-5)
        assert network(row).dtype == np.float32
        c, k = network.law(row[3:])
        assert c + k @ row[:3] == pytest.approx(wanted, abs=1e-5)
    assert network(rows) == pytest.approx(offset + np.einsum("smk,sk->sm", gain, rows[:, :3]))


def test_a_file_says_that_a_gain_is_scheduled(tmp_path):
    network, plain = scheduled_network()
    path, other = tmp_path / "network", tmp_path / "plain"
    network.save(path)
    plain.save(other)
    row = np.ones(5, np.float32)
    assert np.array_equal(Mlp.load(path)(row), network(row))
    assert Mlp.load(path).scheduled == 3
    assert Mlp.load(other).scheduled == 0
    Mlp.load(path).save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == path.read_bytes()
    tensors, metadata = read_safetensors(path)
    for said in ("-1", "1.5", "four"):
        write_safetensors(path, tensors, {**metadata, "scheduled": said})
        with pytest.raises(ValueError, match="scheduled"):
            Mlp.load(path)
    write_safetensors(path, tensors, {**metadata, "scheduled": "4"})
    with pytest.raises(ValueError, match="4 gains"):
        Mlp.load(path)


def test_network_keeps_its_own_copy_of_the_layers():
    # float32 and contiguous already, so that nothing else forces a copy.
    weight, bias = np.ones((2, 1), np.float32), np.zeros(1, np.float32)
    network = Mlp([weight], [bias])
    weight[:], bias[:] = 7.0, 7.0
    assert network(np.ones(2, np.float32)) == pytest.approx([2.0])


@pytest.mark.parametrize(
    ("weights", "biases", "message"),
    [
        ([], [], "0 weight"),
        ([np.ones((2, 3))], [], "biases"),
        ([np.ones((2, 3))], [np.ones(2)], "layer 0"),
        ([np.ones(3)], [np.ones(3)], "layer 0"),
        ([np.ones((2, 3)), np.ones((4, 1))], [np.ones(3), np.ones(1)], "layer 1"),
        ([np.full((2, 3), np.nan)], [np.ones(3)], "finite"),
        ([np.ones((2, 3))], [np.full(3, np.inf)], "finite"),
    ],
)
def test_layers_that_do_not_fit_are_refused(weights, biases, message):
    with pytest.raises(ValueError, match=message):
        Mlp(weights, biases)


def test_file_keeps_every_bit_and_the_metadata(tmp_path):
    network = random_network((7, 9, 1))
    network.metadata["epsilon"] = "0.25"
    path = tmp_path / "deep" / "network.safetensors"
    network.save(path)
    loaded = Mlp.load(str(path))
    for mine, theirs in zip(
        network.weights + network.biases, loaded.weights + loaded.biases, strict=True
    ):
        assert np.array_equal(mine, theirs)
    assert loaded.metadata["epsilon"] == "0.25"
    again = tmp_path / "again.safetensors"
    loaded.save(again)
    assert read_safetensors(again)[0].keys() == read_safetensors(path)[0].keys()
    assert [child.name for child in path.parent.iterdir()] == [path.name]


def test_same_network_has_the_same_file(tmp_path):
    for name in "ab":
        random_network((7, 9, 1)).save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_missing_file_is_not_found(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        Mlp.load(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="folder"):
        Mlp.load(tmp_path.parent / "folder")


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "network.safetensors"
    random_network((7, 9, 1)).save(file)
    return file


def refused(path):
    """Check that a file is refused by name, alone and as the weights of a policy."""
    with pytest.raises(ValueError, match=path.name):
        Mlp.load(path)
    with pytest.raises(ValueError, match=path.name):
        LagrosPolicy(weights=path)


@pytest.mark.parametrize("keep", [0, 5, 8, 100, 0.5, 0.9, -1])
def test_truncated_file_is_refused_by_name(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    refused(path)


@pytest.mark.parametrize("place", [0, 4, 30, -1, -50, -200])
def test_file_with_one_damaged_byte_is_refused_by_name(path, place):
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)
    refused(path)


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"PK\x03\x04" + b"\x00" * 400, id="zip"),
        pytest.param(b"\x80\x04\x95" + b"\xff" * 400, id="pickle"),
        pytest.param(b"{}", id="json"),
        pytest.param(save({"a": np.ones(3, np.float32)}), id="foreign safetensors"),
        pytest.param(save({}, {"format": "lagros-mlp-1", "activation": "tanh"}), id="no layers"),
        pytest.param(
            save({"layer0.weight": np.ones((7, 1), np.float32)}, {"format": "lagros-ppo-actor-1"}),
            id="another format",
        ),
    ],
)
def test_foreign_file_is_refused_by_name(path, content):
    path.write_bytes(content)
    refused(path)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param({"layer1.bias": None, "extra": np.ones(1, np.float32)}, id="bias lacks"),
        pytest.param({"layer0.weight": None, "extra": np.ones(1, np.float32)}, id="weight lacks"),
        pytest.param({"layer1.weight": np.ones((8, 1), np.float32)}, id="width"),
        pytest.param({"layer1.bias": np.full(1, np.nan, np.float32)}, id="nan"),
        pytest.param({"layer2.weight": np.ones((1, 1), np.float32)}, id="half a layer"),
    ],
)
def test_tensors_that_are_no_network_are_refused_by_name(path, change):
    tensors, _ = read_safetensors(path)
    tensors = {name: value for name, value in {**tensors, **change}.items() if value is not None}
    write_safetensors(path, tensors, {"format": "lagros-mlp-1", "activation": "tanh"})
    refused(path)


def test_network_of_another_shape_is_no_policy(path):
    for widths in ((8, 4, 1), (7, 4, 2)):
        random_network(widths).save(path)
        Mlp.load(path)
        with pytest.raises(ValueError, match=rf"{path.name}.*{widths[0]} inputs"):
            LagrosPolicy(weights=path)


numbers = st.floats(-8.0, 8.0, width=32)
observations = st.tuples(*[numbers] * 12, st.floats(0.0, 9.0, width=32)).map(
    lambda values: np.array(values, np.float32)
)
POSITIONS = [0, task.GOAL.start, task.INITIAL_STATE.start]
MIRRORED = np.array([-1.0] * 12 + [1.0], np.float32)


@given(observations)
def test_features_name_what_they_hold(observation):
    features, side = cartpole_view(observation)
    assert features.shape == (len(CartPoleView.names),) == (7,)
    p, angle, speed, turn = observation[:4]
    expected = np.array(
        [
            p - observation[4],
            angle,
            speed,
            turn,
            observation[4] - observation[8],
            observation[9],
        ]
    )
    assert side in (-1.0, 1.0)
    assert side * observation[9] >= 0.0
    assert features[:6] == pytest.approx(side * expected, abs=1e-5)
    assert features[5] >= 0.0
    assert features[6] == observation[12]


@given(observations)
def test_mirrored_observation_has_the_same_features_and_the_other_side(observation):
    # An episode that starts upright has no side: both mirror images are taken for the right.
    if observation[9] == 0.0:
        observation[9] = 0.1
    features, side = cartpole_view(observation)
    mirrored, other = cartpole_view(MIRRORED * observation)
    assert np.array_equal(features, mirrored)
    assert other == -side


@given(observations, st.integers(-8, 8))
def test_features_do_not_depend_on_where_the_track_begins(observation, shift):
    moved = observation.copy()
    moved[POSITIONS] += np.float32(shift)
    assert cartpole_view(moved)[0] == pytest.approx(cartpole_view(observation)[0], abs=1e-5)


def test_features_of_a_batch_are_those_of_its_rows_and_leave_the_observation_alone():
    batch = np.random.default_rng(2).standard_normal((5, 6, 13)).astype(np.float32)
    before = batch.copy()
    features, side = cartpole_view(batch)
    assert np.array_equal(batch, before)
    assert (features.shape, side.shape) == ((5, 6, 7), (5, 6))
    for index in np.ndindex(5, 6):
        one, its_side = cartpole_view(batch[index])
        assert np.array_equal(one, features[index])
        assert its_side == side[index]
