"""Results are written whole or not at all."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lagros_envs.files import write_atomic

__all__ = ["json_lines_text", "json_text", "plain", "write_atomic", "write_json"]


def plain(value: Any) -> Any:
    """Return a value as JSON knows it: tuples and arrays as lists, what is not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def json_text(value: Any) -> str:
    """Return a value as indented JSON, lists of numbers on one line each."""
    return _pretty(plain(value)) + "\n"


def json_lines_text(values: Iterable[Any]) -> str:
    """Return one JSON object a line."""
    return "".join(f"{json.dumps(plain(value), allow_nan=False)}\n" for value in values)


def write_json(path: str | Path, value: Any) -> Path:
    """Write a value as `json_text`."""
    return write_atomic(path, json_text(value))


def _pretty(value: Any, indent: str = "") -> str:
    # json.dumps(indent=2) gives a curve of 91 points 91 lines.
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        items = [f"{json.dumps(key)}: {_pretty(item, deeper)}" for key, item in value.items()]
        return "{\n" + ",\n".join(deeper + item for item in items) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        items = [_pretty(item, deeper) for item in value]
        return "[\n" + ",\n".join(deeper + item for item in items) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)
