"""Multilayer perceptrons that run without torch, stored as safetensors."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import shown
from lagros_envs.files import write_atomic
from lagros_envs.reading import check_file
from lagros_policies.learning.layers import Alike, written_out

Float32Array = NDArray[np.float32]
Tensors = dict[str, Float32Array]
# Weights (inputs, outputs) and biases (outputs,) of each layer.
Layers = Sequence[tuple[NDArray[np.floating], NDArray[np.floating]]]

_FORMAT = "lagros-mlp-1"
_CHECKSUM = "sha256"
_ALIKE = "alike"  # inputs of things that are alike: how many, and inputs of each
_SCHEDULED = "scheduled"  # how many inputs the outputs are affine in
_LAYER = "layer"


class Mlp:
    """A fully connected network with tanh between its layers, evaluated in NumPy float32.

    Normalisation of inputs and outputs is folded into the first and last layer, so that one call
    is the layers and nothing else.

    Its outputs y may be affine in the first inputs s: the layers then see the others, z, alone, and
    give an offset c(z) and a gain K(z), y = c(z) + K(z) s. That is a law with a scheduled gain, of
    the form of u_d + K (x - x_d) itself.

    Args:
        weights: One matrix (inputs, outputs) per layer.
        biases: One vector (outputs,) per layer.
        metadata: Strings that describe the network; stored beside the weights.
        alike: Which inputs are of things that are alike; then the layers are those that
            `written_out` takes, and the file holds these.
        scheduled: How many inputs s the outputs are affine in, k; the last layer has m (1 + k)
            outputs, first c, then the rows of K.

    Raises:
        ValueError: The shapes do not chain, or a number is not finite.

    Attributes:
        weights: Of the layers, in float32, written out where inputs are alike.
        biases: Likewise.
        stored: Weights and biases as the file holds them.
    """

    def __init__(
        self,
        weights: Sequence[NDArray[np.floating]],
        biases: Sequence[NDArray[np.floating]],
        metadata: dict[str, str] | None = None,
        alike: Alike | None = None,
        scheduled: int = 0,
    ) -> None:
        """Copy the layers to float32."""
        if not weights or len(weights) != len(biases):
            raise ValueError(f"{len(weights)} weight matrices need as many biases")
        self.alike = alike
        self.stored = [
            (_float32(one), _float32(other)) for one, other in zip(weights, biases, strict=True)
        ]
        if alike is not None:
            weights, biases = written_out(weights, biases, alike)
        layers = checked_layers(list(zip(weights, biases, strict=True)))
        self.weights, self.biases = [one for one, _ in layers], [other for _, other in layers]
        if self.biases[-1].size % (1 + scheduled):
            raise ValueError(
                f"{self.biases[-1].size} outputs are no offsets with {scheduled} gains each"
            )
        self.scheduled = scheduled
        self.metadata = dict(metadata or {})
        self._hidden = layers[:-1]
        # Buffers of the hidden layers that no evaluation is using: several threads may evaluate.
        self._free = [self._new_buffers()]

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return int(self.weights[0].shape[0]) + self.scheduled

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return int(self.weights[-1].shape[1]) // (1 + self.scheduled)

    def __call__(self, features: Float32Array) -> Float32Array:
        """Evaluate the network.

        Args:
            features: Shape (inputs,) or (batch, inputs), float32.

        Returns:
            Shape (outputs,) or (batch, outputs).
        """
        if self.scheduled:
            offset, gain = self.law(features[..., self.scheduled :])
            product = gain @ features[..., : self.scheduled, None]
            product[..., 0] += offset
            answer: Float32Array = product[..., 0]
            return answer
        return self._through(features)

    def law(self, scheduling: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return the offset c(z), shape (..., m), and the gain K(z), shape (..., m, k).

        Args:
            scheduling: The other inputs z, shape (..., inputs - k).
        """
        layer = self._through(scheduling)
        m, shape = self.outputs, layer.shape[:-1]
        return layer[..., :m], layer[..., m:].reshape(*shape, m, self.scheduled)

    def _through(self, features: Float32Array) -> Float32Array:
        """Return what the layers give."""
        if features.ndim == 1:
            return self._single(features)
        layer: Float32Array = features
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            layer = layer @ weight
            layer += bias
            np.tanh(layer, out=layer)
        return layer @ self.weights[-1] + self.biases[-1]

    def _single(self, features: Float32Array) -> Float32Array:
        try:
            buffers = self._free.pop()
        except IndexError:
            buffers = self._new_buffers()
        layer = features
        for (weight, bias), buffer in zip(self._hidden, buffers, strict=True):
            np.dot(layer, weight, out=buffer)
            np.add(buffer, bias, out=buffer)
            np.tanh(buffer, out=buffer)
            layer = buffer
        last: Float32Array = np.dot(layer, self.weights[-1])
        last += self.biases[-1]
        self._free.append(buffers)
        return last

    def _new_buffers(self) -> list[Float32Array]:
        return [np.empty(bias.shape, np.float32) for _, bias in self._hidden]

    def save(self, path: Path | str) -> None:
        """Write weights and metadata as safetensors, atomically."""
        layers = list(zip(self.weights, self.biases, strict=True))
        metadata = {**self.metadata, "format": _FORMAT, "activation": "tanh"}
        if self.alike is not None:
            layers = self.stored
            metadata[_ALIKE] = json.dumps(self.alike)
        if self.scheduled:
            metadata[_SCHEDULED] = str(self.scheduled)
        write_safetensors(path, tensors_of({_LAYER: layers}), metadata)

    @classmethod
    def load(cls, path: Path | str) -> Mlp:
        """Read a network.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or not such a network.
        """
        tensors, metadata = read_safetensors(path)
        if metadata.get("format") != _FORMAT or metadata.get("activation") != "tanh":
            raise ValueError(
                f"{path} is not a network of this package: its metadata say {shown(metadata)}"
            )
        (layers,) = layers_of(path, tensors, (_LAYER,))
        try:
            weights, biases = [weight for weight, _ in layers], [bias for _, bias in layers]
            return cls(weights, biases, metadata, _alike(metadata), _scheduled(metadata))
        except ValueError as error:
            raise ValueError(f"{path} is damaged: {error}") from error


def checked_layers(layers: Layers, of: str = "") -> list[tuple[Float32Array, Float32Array]]:
    """Return copies of layers in float32.

    Args:
        layers: One at least.
        of: Of which part of a network they are, for the message.

    Raises:
        ValueError: There are none, their shapes do not chain, or a number is not finite.
    """
    if not layers:
        raise ValueError(f"the network has no layers{of}")
    width = np.shape(layers[0][0])[0] if np.ndim(layers[0][0]) == 2 else -1
    copies = []
    for index, layer in enumerate(layers):
        weight, bias = map(_float32, layer)
        if weight.ndim != 2 or weight.shape[0] != width or bias.shape != weight.shape[1:]:
            raise ValueError(
                f"layer {index}{of} has weights {weight.shape} and biases {bias.shape}, "
                f"which do not follow a layer of width {width}"
            )
        if not (np.all(np.isfinite(weight)) and np.all(np.isfinite(bias))):
            raise ValueError(f"layer {index}{of} holds numbers that are not finite")
        width = weight.shape[1]
        copies.append((weight, bias))
    return copies


def tensors_of(parts: Mapping[str, Sequence[tuple[Float32Array, Float32Array]]]) -> Tensors:
    """Return the tensors of a file: weights and biases of the layers of each part, by its name."""
    return {
        f"{part}{index}.{name}": tensor
        for part, layers in parts.items()
        for index, layer in enumerate(layers)
        for name, tensor in zip(("weight", "bias"), layer, strict=True)
    }


def layers_of(path: Path | str, tensors: Tensors, parts: Sequence[str]) -> list[Layers]:
    """Return the layers of each part, whose tensors are named as `tensors_of` does.

    Raises:
        ValueError: A tensor belongs to none of them.
    """
    counts = [sum(name.startswith(part) for name in tensors) // 2 for part in parts]
    names = [
        [(f"{part}{index}.weight", f"{part}{index}.bias") for index in range(count)]
        for part, count in zip(parts, counts, strict=True)
    ]
    if sorted(tensors) != sorted(name for part in names for layer in part for name in layer):
        raise ValueError(f"{path} holds the tensors {shown(sorted(tensors))}, which are no layers")
    return [[(tensors[weight], tensors[bias]) for weight, bias in part] for part in names]


def _float32(values: NDArray[np.floating]) -> Float32Array:
    return np.array(values, np.float32, order="C")


def _alike(metadata: dict[str, str]) -> Alike | None:
    """Take from the metadata of a file which inputs are of things that are alike.

    Raises:
        ValueError: It is not said in two whole numbers.
    """
    text = metadata.pop(_ALIKE, None)
    if text is None:
        return None
    numbers = re.fullmatch(r"\[([1-9]\d{0,3}), ([1-9]\d{0,3})\]", text)
    if numbers is None:
        raise ValueError(f"{_ALIKE}={shown(text)} must be two whole numbers")
    return Alike(*map(int, numbers.groups()))


def _scheduled(metadata: dict[str, str]) -> int:
    """Take from the metadata of a file how many inputs the outputs are affine in.

    Raises:
        ValueError: It is not said in one whole number.
    """
    text = metadata.pop(_SCHEDULED, "0")
    if re.fullmatch(r"0|[1-9]\d{0,3}", text) is None:
        raise ValueError(f"{_SCHEDULED}={shown(text)} must be a whole number")
    return int(text)


def write_safetensors(path: Path | str, tensors: Tensors, metadata: dict[str, str]) -> None:
    """Write tensors, metadata and their checksum, whole or not at all; equal ones, equal files."""
    from safetensors.numpy import save

    data = save(tensors, {**metadata, _CHECKSUM: _checksum(tensors, metadata)})
    # The library writes the metadata in random order. A file is the length of its JSON header in
    # eight bytes, the header, padded to a multiple of eight, and the tensors.
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    write_atomic(path, len(text).to_bytes(8, "little") + text + data[end:])


def read_safetensors(path: Path | str) -> tuple[Tensors, dict[str, str]]:
    """Read tensors and metadata; nothing in such a file is executed.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is truncated, not safetensors, or not as it was written.
    """
    from safetensors import safe_open

    name = check_file(path)
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = dict(file.metadata() or {})
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except Exception as error:
        # Besides its own error, the library raises what NumPy says of a type that it lacks.
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(
            f"{name} is damaged or not a safetensors file ({reason}); fetch or train it again"
        ) from None
    # The format itself does not notice a changed weight.
    stated = metadata.pop(_CHECKSUM, None)
    if stated is not None and stated != _checksum(tensors, metadata):
        raise ValueError(f"{name} is damaged: its checksum is wrong; fetch or train it again")
    for key, tensor in tensors.items():
        if tensor.dtype.kind != "f" or not tensor.size:
            raise ValueError(
                f"{name}: {shown(key)} is {tensor.dtype} of shape {tensor.shape} and must be "
                "floating-point numbers, one at least"
            )
    with np.errstate(over="ignore"):  # what overflows is found not to be finite
        return {key: tensor.astype(np.float32) for key, tensor in tensors.items()}, metadata


def _checksum(tensors: Tensors, metadata: dict[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tensor.shape}".encode())
        digest.update(tensor.tobytes())
    return digest.hexdigest()
