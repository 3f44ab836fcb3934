"""Layers that treat discs alike: the same as the network written out, whatever their order."""

import numpy as np
import pytest
import torch

from lagros_policies.learning.layers import Alike, new_layers, outputs_of
from lagros_policies.learning.networks import Mlp, write_safetensors
from lagros_policies.learning.train import TrainingSettings, fit

ALIKE = Alike(3, 4)
WIDTHS = [5 + 3 * 4, 7, 6, 9, 2]


def inputs(count, rng):
    values = rng.normal(size=(count, WIDTHS[0])).astype(np.float32)
    there = rng.random((count, 3)) < 0.7
    discs = values[:, 5:].reshape(count, 3, 4)
    discs[..., -1] = 1.0
    discs *= there[..., None]
    return values


@pytest.mark.parametrize("alike", [None, ALIKE])
def test_written_out_the_network_answers_the_same(alike, tmp_path):
    torch.manual_seed(1)
    layers = new_layers(WIDTHS, alike)
    values = inputs(20, np.random.default_rng(0))
    wanted = outputs_of(layers, torch.from_numpy(values), alike).detach().numpy()
    state = [value.detach().numpy() for layer in layers for value in layer.parameters()]
    network = Mlp([weight.T for weight in state[0::2]], state[1::2], {"a": "b"}, alike)
    np.testing.assert_allclose(network(values), wanted, atol=2e-6)
    assert (network.inputs, network.outputs) == (WIDTHS[0], WIDTHS[-1])
    # The file holds the layers of one disc, and gives the same network.
    file = tmp_path / "network.safetensors"
    network.save(file)
    assert file.stat().st_size < 4 * sum(part.size for part in state) + 2000
    again = Mlp.load(file)
    assert np.array_equal(again(values), network(values))
    again.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == file.read_bytes()


def test_order_of_the_discs_does_not_matter_and_their_presence_does(tmp_path):
    rng = np.random.default_rng(2)
    values = inputs(400, rng)
    labels = values[:, 5::4].sum(axis=1, keepdims=True) * values[:, :1]
    settings = TrainingSettings(hidden=(16, 16, 16), epochs=150, batch=64, learning_rate=1e-2)
    network = fit(values, labels, settings, tmp_path / "checkpoint", alike=ALIKE)
    swapped = values[:, [*range(5), *range(9, 17), *range(5, 9)]]
    np.testing.assert_allclose(network(swapped), network(values), atol=1e-4)
    fewer = values.copy()
    fewer[:, 5:9] = 0.0
    assert np.abs(network(fewer) - network(values)).max() > 0.1
    assert np.mean(np.abs(network(values) - labels)) < 0.5 * np.mean(np.abs(labels))


def test_a_fit_goes_on_from_what_another_has_learned(tmp_path):
    rng = np.random.default_rng(3)
    values = rng.normal(size=(300, 3)).astype(np.float32)
    labels = np.tanh(values[:, :1])
    long = TrainingSettings(hidden=(8,), epochs=60, learning_rate=1e-2)
    fit(values, labels, long, tmp_path / "first")
    # More samples, of another scale, do not move the scales of the first ones.
    more = np.concatenate([values, 5.0 + values]), np.concatenate([labels, labels])
    short = TrainingSettings(hidden=(8,), epochs=1, learning_rate=1e-9)
    last = {"after": tmp_path / "first", "first": 300}
    kept = fit(*more, short, tmp_path / "second", **last)
    assert np.mean(np.abs(kept(values) - labels)) < 0.1
    anew = fit(*more, short, tmp_path / "third", first=300)
    assert np.mean(np.abs(anew(values) - labels)) > 0.2


def test_too_few_layers_for_discs_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"hidden=\(16, 16\) must be 3 layers or more"):
        fit(
            inputs(9, np.random.default_rng(0)),
            np.zeros((9, 1), np.float32),
            TrainingSettings(hidden=(16, 16)),
            tmp_path / "checkpoint",
            alike=ALIKE,
        )


@pytest.mark.parametrize("alike", ["[3]", "[3, 5]", "[0, 4]", "three", "[3, 99999]"])
def test_a_file_that_says_wrongly_what_is_alike_is_damaged(alike, tmp_path):
    layers = new_layers(WIDTHS, ALIKE)
    tensors = {}
    for index, layer in enumerate(layers):
        tensors[f"layer{index}.weight"] = layer.weight.detach().numpy().T.copy()
        tensors[f"layer{index}.bias"] = layer.bias.detach().numpy()
    metadata = {"format": "lagros-mlp-1", "activation": "tanh", "alike": alike}
    write_safetensors(tmp_path / "file", tensors, metadata)
    with pytest.raises(ValueError, match="file is damaged: "):
        Mlp.load(tmp_path / "file")
