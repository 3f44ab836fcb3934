"""Deep sets over neighbours and obstacles that run without torch, stored as safetensors.

    y = rho(own, sum_k w_k phi_n(neighbour_k), sum_k w_k phi_o(obstacle_k))

with ReLU between the layers. A sum does not depend on the order of its terms, nor their number on
the weights: the same network serves any number of agents and obstacles.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import shown
from lagros_policies.learning.networks import (
    Layers,
    checked_layers,
    layers_of,
    read_safetensors,
    tensors_of,
    write_safetensors,
)

Float32Array = NDArray[np.float32]

_FORMAT = "lagros-deep-set-1"
# Up to this many entries a matrix of weights adds up faster than a walk over the owners.
_DENSE = 4096
_PARTS = ("neighbour", "obstacle", "agent")


class Elements(NamedTuple):
    """The bodies of one kind that B agents sense, e in all.

    Attributes:
        values: One row for each, shape (e, f).
        owner: Who senses it, ascending, shape (e,).
        weight: From 0 at the rim of what is sensed to 1, shape (e,).
    """

    values: Float32Array
    owner: NDArray[np.intp]
    weight: Float32Array


class SetFeatures(NamedTuple):
    """Inputs of a deep set for B agents.

    Attributes:
        own: What each knows of itself, shape (B, f).
        neighbours: The other agents that it senses.
        obstacles: The obstacles that it senses.
        frame: Unit vectors as complex numbers, shape (B,); a vector of the world is one of the
            network's times this.
    """

    own: Float32Array
    neighbours: Elements
    obstacles: Elements
    frame: NDArray[np.complex128]


class DeepSet:
    """A deep set, evaluated in NumPy float32 for all agents of all worlds in one call.

    Normalisation of inputs and outputs is folded into the first and last layers.

    Args:
        neighbour: phi_n, layers of weights (inputs, outputs) and biases (outputs,), ReLU after
            each.
        obstacle: phi_o, likewise.
        agent: rho, likewise, without ReLU after the last.
        metadata: Strings that describe the network; stored beside the weights.

    Raises:
        ValueError: The shapes do not chain, or a number is not finite.

    Attributes:
        inputs: How many features an agent has of itself, of a neighbour and of an obstacle.
        outputs: How many numbers it answers.
    """

    def __init__(
        self,
        neighbour: Layers,
        obstacle: Layers,
        agent: Layers,
        metadata: dict[str, str] | None = None,
    ) -> None:
        """Copy the layers to float32."""
        self.metadata = dict(metadata or {})
        parts = {"neighbour": neighbour, "obstacle": obstacle, "agent": agent}
        self.layers = {
            name: checked_layers(layers, f" of {name}") for name, layers in parts.items()
        }
        (near, first), (still, second), (whole, self.outputs) = (
            (len(layers[0][0]), len(layers[-1][1])) for layers in self.layers.values()
        )
        own = whole - first - second
        if own < 1:
            raise ValueError(
                f"layer 0 of agent has {whole} inputs, of which {first} and {second} are sums: an "
                "agent knows nothing of itself"
            )
        self.inputs = own, near, still
        self._widths = first, second

    def __call__(self, features: SetFeatures) -> Float32Array:
        """Evaluate the network for B agents.

        Args:
            features: Of the agents.

        Returns:
            The answers, shape (B, outputs).
        """
        count, own = len(features.own), self.inputs[0]
        first, second = self._widths
        inputs = np.zeros((count, own + first + second), np.float32)
        inputs[:, :own] = features.own
        end = own
        for name, width, elements in zip(
            _PARTS, self._widths, (features.neighbours, features.obstacles), strict=False
        ):
            begin, end = end, end + width
            if len(elements.owner):
                values = _through(self.layers[name], elements.values)
                pool(values, elements.owner, elements.weight, inputs[:, begin:end])
        *hidden, (weight, bias) = self.layers["agent"]
        outputs: Float32Array = np.dot(_through(hidden, inputs), weight)
        outputs += bias
        return outputs

    @property
    def weights(self) -> int:
        """How many numbers were learned."""
        return sum(
            weight.size + bias.size for layers in self.layers.values() for weight, bias in layers
        )

    def save(self, path: Path | str) -> None:
        """Write weights and metadata as safetensors, atomically."""
        write_safetensors(path, tensors_of(self.layers), {**self.metadata, "format": _FORMAT})

    @classmethod
    def load(cls, path: Path | str) -> DeepSet:
        """Read a network.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or not such a network.
        """
        tensors, metadata = read_safetensors(path)
        if metadata.get("format") != _FORMAT:
            raise ValueError(
                f"{path} is not a deep set of this package: its metadata say {shown(metadata)}"
            )
        neighbour, obstacle, agent = layers_of(path, tensors, _PARTS)
        try:
            return cls(neighbour, obstacle, agent, metadata)
        except ValueError as error:
            raise ValueError(f"{path} is damaged: {error}") from error


def _through(layers: list[tuple[Float32Array, Float32Array]], values: Float32Array) -> Float32Array:
    """Return the values after some layers, each followed by a ReLU."""
    for weight, bias in layers:
        values = np.dot(values, weight)
        values += bias
        np.maximum(values, 0.0, out=values)
    return values


def pool(
    values: Float32Array, owner: NDArray[np.intp], weight: Float32Array, sums: Float32Array
) -> None:
    """Write the weighted sum of each owner's rows into the rows of `sums`.

    Args:
        values: Shape (e, h).
        owner: Whose each row is, ascending, shape (e,).
        weight: Shape (e,).
        sums: Zeros, shape (B, h).
    """
    if len(sums) == 1:
        np.dot(weight, values, out=sums[0])
        return
    if len(sums) * len(values) <= _DENSE:
        sums[:] = np.dot((owner == np.arange(len(sums))[:, None]) * weight, values)
        return
    values *= weight[:, None]
    # All first rows of an owner together, then all second: few steps, where nobody senses many. The
    # first comes last, as in NumPy's own sums.
    counts = np.bincount(owner, minlength=len(sums))
    first = np.cumsum(counts) - counts
    most = counts.max(initial=0)
    for place in (*range(1, most), 0)[:most]:
        whose = np.flatnonzero(counts > place)
        sums[whose] += values[first[whose] + place]
