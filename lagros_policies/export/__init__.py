"""Policies as files for other machines: an ONNX model or one C99 file.

Both map what a policy that is a network observes to controls in their own units, features included.
"""

from lagros_envs.aliases import moved_names
from lagros_policies.export.source import Source, exported_names, load_source

moved_names(__name__)

__all__ = ["Source", "exported_names", "load_source"]
