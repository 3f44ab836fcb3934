"""The file of any policy that can be exported."""

from __future__ import annotations

from lagros_policies.export.c99 import Tanh, c_source
from lagros_policies.export.onnx import policy_model
from lagros_policies.export.source import Source, SpacecraftSource
from lagros_policies.tasks.spacecraft.c99 import spacecraft_source
from lagros_policies.tasks.spacecraft.onnx import spacecraft_model


def c_file(source: Source, tanh: Tanh = "rational") -> str:
    """Return the C99 file of a policy; `tanh` is for the cart-pole, see `c_source`."""
    if isinstance(source, SpacecraftSource):
        return spacecraft_source(source)
    return c_source(source, tanh)


def onnx_file(source: Source) -> bytes:
    """Return the ONNX model of a policy."""
    if isinstance(source, SpacecraftSource):
        return spacecraft_model(source)
    return policy_model(source)
