"""Policies as files for other machines: an ONNX model or one C99 file.

Both map what a policy (a) or (c) observes of the cart-pole or the spacecraft to forces in newtons,
features included.
"""

from lagros_policies.export.source import NAMES, NetworkSource, SpacecraftSource, load_source

__all__ = ["NAMES", "NetworkSource", "SpacecraftSource", "load_source"]
