"""The layers of a network in training, some of which treat several discs alike.

What a task's features say of each disc goes through two layers with one set of weights, beside what
they say of the body, and the results are added up before the layers that follow. So the network
learns a disc once, whichever it is. Written out with the weights repeated, it is an ordinary
multilayer perceptron, and that is what is flown and exported.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

Array = NDArray[np.floating]

_OWN = 2  # hidden layers of each disc


class Alike(NamedTuple):
    """Inputs of things that are alike: the last ones, the last of each being its presence.

    Attributes:
        things: How many there are.
        size: Inputs of each.
    """

    things: int
    size: int


def new_layers(widths: Sequence[int], alike: Alike | None) -> list[torch.nn.Linear]:
    """Return layers with their initial weights.

    Args:
        widths: Of the inputs, of each hidden layer, of the outputs.
        alike: Which inputs are of things that are alike. Then the first two layers are two pairs:
            of each thing, which sees the rest too, and of the rest alone.

    Raises:
        ValueError: There are too few hidden layers for that.
    """
    import torch

    if alike is None:
        return [torch.nn.Linear(*pair) for pair in itertools.pairwise(widths)]
    check_widths(widths[1:-1], alike)
    rest = widths[0] - alike.things * alike.size
    shapes = [(rest + alike.size, widths[1]), (rest, widths[1])]
    shapes += [(widths[1], widths[2])] * 2
    shapes += [(2 * widths[2], widths[3]), *itertools.pairwise(widths[3:])]
    return [torch.nn.Linear(*shape) for shape in shapes]


def check_widths(hidden: Sequence[int], alike: Alike | None) -> None:
    """Check that there are hidden layers enough for the things that are alike.

    Raises:
        ValueError: There are too few.
    """
    if alike is not None and len(hidden) <= _OWN:
        raise ValueError(
            f"hidden={tuple(hidden)} must be {_OWN + 1} layers or more: the first {_OWN} are for "
            "each disc"
        )


def outputs_of(
    layers: Sequence[torch.nn.Linear], inputs: torch.Tensor, alike: Alike | None
) -> torch.Tensor:
    """Return the outputs (s, outputs) for inputs (s, inputs), with tanh between the layers."""
    return moved_outputs(layers, [inputs], alike)[0]


def moved_outputs(
    layers: Sequence[torch.nn.Linear], inputs: Sequence[torch.Tensor], alike: Alike | None
) -> list[torch.Tensor]:
    """Return outputs and how they move with the inputs.

    Args:
        layers: The layers, with tanh between them.
        inputs: The inputs, shape (s, inputs), and perhaps directions in which they move, likewise.
        alike: Which inputs are of things that are alike.

    Returns:
        The outputs, shape (s, outputs), and their slopes along the directions.
    """
    import torch

    values = list(inputs)
    if alike is not None:
        things, own = [], []
        for one in values:
            rest = one[:, : -alike.things * alike.size]
            each = one[:, -alike.things * alike.size :].reshape(-1, alike.things, alike.size)
            things.append(torch.cat([rest[:, None].expand(-1, alike.things, -1), each], -1))
            own.append(rest)
        for of_things, of_rest in zip(layers[0:4:2], layers[1:4:2], strict=True):
            things, own = _bent(_through(of_things, things)), _bent(_through(of_rest, own))
        values = [torch.cat([many.sum(1), one], 1) for many, one in zip(things, own, strict=True)]
        layers = layers[4:]
    for layer in layers[:-1]:
        values = _bent(_through(layer, values))
    return _through(layers[-1], values)


def _through(layer: torch.nn.Linear, values: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Return what a layer makes of values and of directions, to which no bias is added."""
    return [layer(values[0]), *(one @ layer.weight.T for one in values[1:])]


def _bent(values: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Return tanh of values and what directions become."""
    first = values[0].tanh()
    return [first, *((1.0 - first * first) * one for one in values[1:])]


def written_out(
    weights: Sequence[Array], biases: Sequence[Array], alike: Alike
) -> tuple[list[Array], list[Array]]:
    """Return the layers of the multilayer perceptron that treats things alike.

    Args:
        weights: Of the two pairs of layers and of those that follow, (inputs, outputs) each.
        biases: Likewise, (outputs,) each.
        alike: Which inputs are of things that are alike.

    Raises:
        ValueError: The shapes do not fit each other.
    """
    if len(weights) < 2 * _OWN + 2:
        raise ValueError(f"{len(weights)} layers must be {2 * _OWN + 2} or more to be written out")
    things, size = alike
    rest, wide, last = len(weights[1]), len(biases[0]), len(biases[2])
    first = np.zeros((rest + things * size, (things + 1) * wide))
    second = np.zeros(((things + 1) * wide, (things + 1) * last))
    third = np.concatenate([np.tile(weights[4][:last], (things, 1)), weights[4][last:]])
    for thing in range(things):
        to = slice(thing * wide, (thing + 1) * wide)
        first[:rest, to] = weights[0][:rest]
        first[rest + thing * size : rest + (thing + 1) * size, to] = weights[0][rest:]
        second[to, thing * last : (thing + 1) * last] = weights[2]
    first[:rest, things * wide :] = weights[1]
    second[things * wide :, things * last :] = weights[3]
    pairs = ((biases[0], biases[1]), (biases[2], biases[3]))
    tiled = [np.concatenate([np.tile(each, things), own]) for each, own in pairs]
    return [first, second, third, *weights[5:]], [*tiled, *biases[4:]]
