"""Networks and cart-pole policies as the bytes of an ONNX model, without the `onnx` package.

ONNX is a protocol buffer; a network needs a dozen of its fields. The numbers below are those of
onnx.proto3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs import cartpole_task as task
from lagros_envs.dynamics.cartpole import ANGLE
from lagros_policies.export.source import NetworkSource
from lagros_policies.imitation.features import FEATURES, cartpole_features
from lagros_policies.imitation.networks import Mlp

Float32Array = NDArray[np.float32]

_IR_VERSION, _OPSET = 8, 13
_FLOAT = 1  # TensorProto.DataType.FLOAT
_BATCH = "batch"


def network_model(network: Mlp) -> bytes:
    """Return a network alone: input "x" of shape (1, inputs), output "y" of shape (1, outputs)."""
    nodes, tensors = _layers(network, "x", "y")
    return _model(nodes, tensors, ("x", 1, network.inputs), ("y", 1, network.outputs))


def policy_model(source: NetworkSource) -> bytes:
    """Return a cart-pole policy with its features and its mirror.

    Args:
        source: The policy.

    Returns:
        A model of input "observation", shape (batch, 13), that of lagros/CartPole-v0, and output
        "force", shape (batch, 1) [N]. The weights' name and digest are in its metadata.
    """
    # Features of the right side are linear: their matrix is what they make of the unit vectors.
    features, _ = cartpole_features(np.eye(task.OBSERVATION_DIM, dtype=np.float32))
    lean = np.zeros((task.OBSERVATION_DIM, 1), np.float32)
    lean[task.INITIAL_STATE.start + ANGLE] = 1.0
    mirror = np.ones(len(FEATURES), np.float32)
    mirror[: FEATURES.index("time [s]")] = -1.0  # time has no side
    layers, tensors = _layers(source.network, "mirrored", "answer")
    tensors = [
        _tensor("features.matrix", features),
        _tensor("lean.vector", lean),
        _tensor("zero", np.zeros(1, np.float32)),
        _tensor("one", np.ones(1, np.float32)),
        _tensor("minus.one", -np.ones(1, np.float32)),
        _tensor("left.signs", mirror),
        _tensor("right.signs", np.ones_like(mirror)),
        *tensors,
    ]
    nodes = [
        _node("MatMul", ["observation", "features.matrix"], "features"),
        _node("MatMul", ["observation", "lean.vector"], "initial.angle"),
        _node("Less", ["initial.angle", "zero"], "left"),
        _node("Where", ["left", "left.signs", "right.signs"], "signs"),
        _node("Mul", ["features", "signs"], "mirrored"),
        *layers,
        _node("Where", ["left", "minus.one", "one"], "side"),
        _node("Mul", ["answer", "side"], "force"),
    ]
    metadata = {"policy": source.name, "weights": source.file, "weights_sha256": source.digest}
    return _model(
        nodes,
        tensors,
        ("observation", _BATCH, task.OBSERVATION_DIM),
        ("force", _BATCH, 1),
        {**metadata, "unit": "N"},
    )


def _layers(network: Mlp, name: str, answer: str) -> tuple[list[bytes], list[bytes]]:
    """Return the nodes and the weights of a network from one value of the graph to another."""
    nodes, tensors = [], []
    last = len(network.weights) - 1
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors += [_tensor(f"w{index}", weight), _tensor(f"b{index}", bias)]
        output = answer if index == last else f"z{index}"
        nodes.append(_node("Gemm", [name, f"w{index}", f"b{index}"], output))
        if index != last:
            nodes.append(_node("Tanh", [output], f"a{index}"))
            name = f"a{index}"
    return nodes, tensors


def _model(
    nodes: Sequence[bytes],
    tensors: Sequence[bytes],
    source: tuple[str, int | str, int],
    answer: tuple[str, int | str, int],
    metadata: dict[str, str] | None = None,
) -> bytes:
    graph = b"".join(
        [
            *(_field(1, node) for node in nodes),
            _field(2, b"policy"),
            *(_field(5, tensor) for tensor in tensors),
            _field(11, _port(*source)),
            _field(12, _port(*answer)),
        ]
    )
    properties = [
        _field(14, _text(1, key) + _text(2, value)) for key, value in (metadata or {}).items()
    ]
    return b"".join(
        [
            _number(1, _IR_VERSION),
            _text(2, "lagros"),
            _field(7, graph),
            _field(8, _number(2, _OPSET)),
            *properties,
        ]
    )


def _node(operation: str, inputs: Sequence[str], output: str) -> bytes:
    fields = [_text(1, name) for name in inputs]
    return b"".join([*fields, _text(2, output), _text(4, operation)])


def _tensor(name: str, values: NDArray[Any]) -> bytes:
    shape = b"".join(_number(1, size) for size in values.shape)
    data = np.ascontiguousarray(values, "<f4").tobytes()
    return shape + _number(2, _FLOAT) + _text(8, name) + _field(9, data)


def _port(name: str, rows: int | str, width: int) -> bytes:
    first = _text(2, rows) if isinstance(rows, str) else _number(1, rows)
    shape = _field(1, first) + _field(1, _number(1, width))
    return _text(1, name) + _field(2, _field(1, _number(1, _FLOAT) + _field(2, shape)))


def _text(field: int, text: str) -> bytes:
    return _field(field, text.encode())


def _varint(value: int) -> bytes:
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*groups, value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _field(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content
