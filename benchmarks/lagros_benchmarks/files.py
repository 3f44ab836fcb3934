"""Results are written whole or not at all."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np


def write_atomic(path: str | Path, data: str | bytes) -> Path:
    """Write a file under a temporary name beside it, then rename.

    A reader, or a run that is killed, sees the old file or the new one and never half of one.

    Args:
        path: The file; its folder is made if need be.
        data: Text (written as UTF-8) or bytes.

    Returns:
        The path.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # A plain open, not tempfile, whose files nobody else may read.
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            stream.write(data.encode() if isinstance(data, str) else data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    return target


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


def write_json(path: str | Path, value: Any) -> Path:
    """Write a value as indented JSON, lists of numbers on one line each."""
    return write_atomic(path, _pretty(plain(value)) + "\n")


def write_json_lines(path: str | Path, values: Iterable[Any]) -> Path:
    """Write one JSON object a line."""
    lines = (json.dumps(plain(value), allow_nan=False) for value in values)
    return write_atomic(path, "".join(f"{line}\n" for line in lines))


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
