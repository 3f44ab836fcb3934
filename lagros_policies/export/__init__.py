"""Policies as files for other machines: an ONNX model or one C99 file.

Both map what the cart-pole policies (a) and (c) see to the force in newtons, features and mirror
included.
"""

from lagros_policies.export.source import NAMES, NetworkSource, load_source

__all__ = ["NAMES", "NetworkSource", "load_source"]
