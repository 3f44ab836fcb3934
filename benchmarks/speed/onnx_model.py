"""The ONNX peer of the speed study: the model that `lagros export` builds its own around."""

from lagros_policies.export.onnx import network_model as onnx_bytes

__all__ = ["onnx_bytes"]
