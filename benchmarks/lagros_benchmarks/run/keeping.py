"""Finished chunks of a benchmark, kept on disk so that a run that was killed goes on.

A chunk is one JSON file with a checksum. Floats are written as Python reads them back, bit for bit;
nothing in a file is executed, and a file that is not as it was written is made again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lagros_envs.files import write_atomic

__all__ = ["Keepable", "Kept", "decode", "encode"]

_LOG = logging.getLogger(__name__)
_KEEPABLE: dict[str, Any] = {}


class Keepable:
    """A dataclass that chunks are made of; whoever derives from it is read back by its name."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        _KEEPABLE[cls.__name__] = cls


class Kept:
    """The finished chunks of one run in a folder of its own.

    Args:
        folder: The folder; made with the first chunk.
        key: What the chunks depend on, see `fingerprints.fingerprint`. Those of another key are
            not taken.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder
        self.key = key
        # A policy may change the working folder.
        self._place = folder.absolute()
        self._failed = False

    @classmethod
    def named(cls, folder: Path, task: str, key: str) -> Kept:
        """Return those of a key in a folder of their own, named after their task."""
        plain = re.sub(r"[^\w.-]", "-", task)
        return cls(folder / f"{plain}-{key[:16]}", key)

    def __len__(self) -> int:
        return sum(1 for _ in self._place.glob("*.json"))

    def found(self, title: str, count: int) -> dict[int, Any]:
        """Return the chunks of one stage that are there and whole, by index below `count`."""
        chunks = {}
        for index in range(count):
            # A list, because an outcome may be None.
            chunk = self._read(title, index)
            if chunk:
                chunks[index] = chunk[0]
        return chunks

    def add(self, title: str, index: int, outcome: Any) -> None:
        """Keep a chunk. That it cannot be kept is said once, and ends no run."""
        if self._failed:
            return
        try:
            body = json.dumps(encode(outcome))
            write_atomic(
                self._path(title, index), f"{self._checksum(title, index, body)}\n{body}\n"
            )
        except (OSError, TypeError, ValueError) as error:
            self._failed = True
            _LOG.warning(
                "finished work cannot be kept in %s (%s): if the run is interrupted, it begins "
                "anew",
                self.folder,
                getattr(error, "strerror", None) or error,
            )

    def remove(self) -> None:
        """Remove all chunks, with the folder."""
        shutil.rmtree(self._place, ignore_errors=True)

    def _path(self, title: str, index: int) -> Path:
        return self._place / f"{title}-{index:05d}.json"

    def _checksum(self, title: str, index: int, body: str) -> str:
        # With its place, so that a file that was renamed is not taken for another.
        return hashlib.sha256(f"{self.key} {title} {index} {body}".encode()).hexdigest()

    def _read(self, title: str, index: int) -> list[Any]:
        try:
            checksum, body, _ = self._path(title, index).read_text(encoding="utf-8").split("\n")
        except (OSError, ValueError):
            return []
        if checksum != self._checksum(title, index, body):
            return []
        return [decode(json.loads(body))]


def encode(value: Any) -> Any:
    """Return a value as JSON holds it, so that `decode` returns an equal one of the same types.

    Raises:
        TypeError: There is something in it that is not known here.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return [encode(item) for item in value]
    if isinstance(value, tuple):
        return {"tuple": [encode(item) for item in value]}
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return {"array": value.tolist(), "shape": value.shape, "dtype": value.dtype.str}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {key: encode(item) for key, item in value.items()}}
    if _KEEPABLE.get(type(value).__name__) is type(value):
        fields = dataclasses.fields(value)
        return {
            "record": type(value).__name__,
            "fields": {field.name: encode(getattr(value, field.name)) for field in fields},
        }
    raise TypeError(f"{type(value).__name__} is not known to be kept")


def decode(data: Any) -> Any:
    """Return the value that `encode` made JSON of."""
    if isinstance(data, list):
        return [decode(item) for item in data]
    if not isinstance(data, dict):
        return data
    if "tuple" in data:
        return tuple(decode(item) for item in data["tuple"])
    if "array" in data:
        return np.array(data["array"], data["dtype"]).reshape(data["shape"])
    if "dict" in data:
        return {key: decode(item) for key, item in data["dict"].items()}
    return _KEEPABLE[data["record"]](
        **{name: decode(item) for name, item in data["fields"].items()}
    )
