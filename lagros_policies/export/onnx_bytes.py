"""ONNX models as bytes, without the `onnx` package.

ONNX is a protocol buffer; a network needs a dozen of its fields. The numbers below are those of
onnx.proto3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

BATCH = "batch"

_IR_VERSION, _OPSET = 8, 13
_FLOAT, _INT64 = 1, 7  # TensorProto.DataType
_INTEGER = 2  # AttributeProto.AttributeType.INT


def model(
    nodes: Sequence[bytes],
    tensors: Sequence[bytes],
    source: tuple[str, int | str, int],
    answer: tuple[str, int | str, int],
    metadata: dict[str, str] | None = None,
) -> bytes:
    """Return a model, opset 13.

    Args:
        nodes: From `node`, in the order of their computation.
        tensors: From `tensor`.
        source: Name, rows (a number, or a name for any) and columns of the input.
        answer: The same of the output.
        metadata: Stored beside the graph.
    """
    graph = b"".join(
        [
            *(_field(1, item) for item in nodes),
            _field(2, b"policy"),
            *(_field(5, item) for item in tensors),
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


def node(operation: str, inputs: Sequence[str], output: str, **attributes: int) -> bytes:
    """Return an operation of the graph, between values with these names."""
    fields = [_text(1, name) for name in inputs]
    settings = [
        _field(5, _text(1, name) + _number(3, value) + _number(20, _INTEGER))
        for name, value in attributes.items()
    ]
    return b"".join([*fields, _text(2, output), _text(4, operation), *settings])


def tensor(name: str, values: NDArray[Any]) -> bytes:
    """Return a constant: integers as int64, everything else as float32."""
    whole = np.issubdtype(values.dtype, np.integer)
    shape = b"".join(_number(1, size) for size in values.shape)
    data = np.ascontiguousarray(values, "<i8" if whole else "<f4").tobytes()
    kind = _INT64 if whole else _FLOAT
    return shape + _number(2, kind) + _text(8, name) + _field(9, data)


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
