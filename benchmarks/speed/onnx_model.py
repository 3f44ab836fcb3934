"""A multilayer perceptron as the bytes of an ONNX model, written without the `onnx` package.

ONNX is a protocol buffer; a network needs a dozen of its fields. The numbers below are those of
onnx.proto3.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lagros_policies.imitation.networks import Mlp

_IR_VERSION, _OPSET = 8, 13
_FLOAT = 1  # TensorProto.DataType.FLOAT


def onnx_bytes(network: Mlp) -> bytes:
    """Return the model: input "x" of shape (1, inputs), output "y" of shape (1, outputs)."""
    nodes, tensors = [], []
    name = "x"
    last = len(network.weights) - 1
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors += [_tensor(f"w{index}", weight), _tensor(f"b{index}", bias)]
        output = "y" if index == last else f"z{index}"
        nodes.append(_node("Gemm", [name, f"w{index}", f"b{index}"], output))
        if index != last:
            nodes.append(_node("Tanh", [output], f"a{index}"))
            name = f"a{index}"
    graph = b"".join(
        [
            *(_field(1, node) for node in nodes),
            _field(2, b"mlp"),
            *(_field(5, tensor) for tensor in tensors),
            _field(11, _port("x", network.inputs)),
            _field(12, _port("y", network.outputs)),
        ]
    )
    return _number(1, _IR_VERSION) + _field(7, graph) + _field(8, _number(2, _OPSET))


def _node(operation: str, inputs: Iterable[str], output: str) -> bytes:
    fields = [_field(1, name.encode()) for name in inputs]
    return b"".join([*fields, _field(2, output.encode()), _field(4, operation.encode())])


def _tensor(name: str, values: np.ndarray) -> bytes:
    shape = b"".join(_number(1, size) for size in values.shape)
    data = np.ascontiguousarray(values, "<f4").tobytes()
    return shape + _number(2, _FLOAT) + _field(8, name.encode()) + _field(9, data)


def _port(name: str, width: int) -> bytes:
    shape = b"".join(_field(1, _number(1, size)) for size in (1, width))
    kind = _field(1, _number(1, _FLOAT) + _field(2, shape))
    return _field(1, name.encode()) + _field(2, kind)


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
