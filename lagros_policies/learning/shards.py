"""Pieces of data that depend on nothing but settings and index: resumable, in any process.

A shard is written under a temporary name and renamed, so that whatever interrupts the work, every
finished shard survives and the rest is made again, bit for bit.
"""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.files import write_atomic
from lagros_envs.reading import read_json, read_npz
from lagros_policies.backends import LOKY, Backend, each

Shard = dict[str, NDArray[Any]]

_LOG = logging.getLogger(__name__)


def make_shards(
    folder: Path,
    count: int,
    make: Callable[[int], Shard],
    record: Mapping[str, Any],
    jobs: int = 1,
    on_shard: Callable[[int], None] | None = None,
    backend: Backend = LOKY,
) -> list[Shard]:
    """Make all shards, or those that an interrupted call left out or that are damaged.

    Args:
        folder: Where the shards are kept.
        count: How many there are.
        make: From the index of a shard to its arrays; sent to the processes.
        record: What the data depend on; kept beside them.
        jobs: Processes.
        on_shard: Called with the number of shards that are finished.
        backend: Whose processes they are; they need not see the folder.

    Returns:
        The shards in the order of their indices.

    Raises:
        ValueError: The folder holds data of another record.
        BackendError: The backend is not installed, not reachable, or loses its workers.
    """
    folder.mkdir(parents=True, exist_ok=True)
    claim(folder / "manifest.json", record, "expert data")
    paths = [folder / f"shard_{index:04d}.npz" for index in range(count)]
    shards: dict[int, Shard] = {}
    for index, path in enumerate(paths):
        try:
            shards[index] = read_npz(path)
        except FileNotFoundError:
            continue
        except ValueError as error:
            _LOG.warning("%s; it is made again", error)
    missing = [index for index in range(count) if index not in shards]
    if on_shard is not None:
        on_shard(len(shards))
    for one, packed in each(partial(_packed, make), missing, jobs, backend):
        path = write_atomic(paths[missing[one]], packed)
        shards[missing[one]] = read_npz(path)
        if on_shard is not None:
            on_shard(len(shards))
    return [shards[index] for index in range(count)]


def claim(path: Path, record: Mapping[str, Any], what: str) -> None:
    """Write the record of a folder, or check that it is the one that is there.

    Args:
        path: File of the record.
        record: What the folder's content depends on.
        what: Name of the content, for the error.

    Raises:
        ValueError: The folder belongs to another record, or its own cannot be read.
    """
    plain = json.loads(json.dumps(record))
    if not path.exists():
        write_atomic(path, json.dumps(plain, indent=1) + "\n")
        return
    try:
        found = read_json(path, "the record of a folder")
    except ValueError as error:
        raise ValueError(f"{error}; name another folder or remove {path.parent}") from error
    if found != plain:
        raise ValueError(
            f"{path.parent} holds {what} of other settings; name another folder or remove it"
        )


def _packed(make: Callable[[int], Shard], index: int) -> bytes:
    buffer = io.BytesIO()
    # Arrays that pickle would have to write are refused, not pickled.
    np.savez(buffer, allow_pickle=False, **make(index))
    return buffer.getvalue()
