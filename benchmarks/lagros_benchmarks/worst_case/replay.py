"""What found sequences did, kept in files and read back.

What is published about a worst case is what happens here and not what the search saw: one world at
a time, the real policy, the environment's own clock, so that a file gives the same figures to the
last bit whenever it is flown on the same machine and versions.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import is_number, shown
from lagros_envs.files import write_atomic
from lagros_envs.reading import Record, named, parse_json, read_npz

_FORMAT = "lagros-worst-case-1"
# Of all sequences together: a thousand worlds of eight agents have less.
_MOST_BYTES = 1 << 28


@dataclass(frozen=True)
class Outcome:
    """What one sequence did to one episode.

    Attributes:
        seed: Seed of the episode.
        score: How bad it was for the goal; larger is worse.
        broken: Whether the goal was broken: for "tube" the tube was left (one body: the radius of
            success around x_d; agents: the certified margin), for "success" the episode failed (of
            some agent), for "clearance" the body fell or collided.
        measures: Further figures, by name.
        error: The exception that ended the episode, which then counts as broken; None if none did.
    """

    seed: int
    score: float
    broken: bool
    measures: Mapping[str, float | bool | int | None]
    error: str | None = None


@dataclass(frozen=True)
class WorstCases:
    """Found sequences and all that it takes to fly them again.

    Attributes:
        command: What found them: the options of `lagros attack`, by name.
        pushes: d, shape (episodes, steps, n), or (episodes, steps, agents, n).
        outcomes: What each did.
    """

    command: Mapping[str, Any]
    pushes: FloatArray
    outcomes: tuple[Outcome, ...]


def save_worst_cases(found: WorstCases, path: Path | str) -> None:
    """Write sequences as .npz, atomically; no object is pickled."""
    record = {
        "format": _FORMAT,
        "command": dict(found.command),
        "outcomes": [asdict(outcome) for outcome in found.outcomes],
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, pushes=found.pushes, record=np.array(json.dumps(record)))
    write_atomic(path, buffer.getvalue())


def load_worst_cases(path: Path | str) -> WorstCases:
    """Read what `save_worst_cases` wrote.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no such file, or damaged.
    """
    arrays = read_npz(path, ("pushes", "record"), _MOST_BYTES)
    name = named(path)
    text, pushes = arrays["record"], arrays["pushes"]
    if text.dtype.kind != "U" or text.ndim:
        raise ValueError(f"{name} is not a file of `lagros attack --npz`: 'record' is no text")
    # The score of a flight that raised is infinite.
    record = Record(parse_json(str(text), f"{name}: 'record'", all_finite=False), name)
    record.must("format", _FORMAT)
    if pushes.dtype.kind != "f" or pushes.ndim not in (3, 4) or not np.all(np.isfinite(pushes)):
        raise ValueError(
            f"{name}: 'pushes' of shape {pushes.shape} and type {pushes.dtype} must be finite "
            "numbers of shape (episodes, steps, n) or (episodes, steps, agents, n)"
        )
    entries = record.list("outcomes")
    if len(entries) != len(pushes):
        raise ValueError(f"{name}: {len(entries)} 'outcomes' do not match pushes {pushes.shape}")
    outcomes = tuple(
        _outcome(Record(entry, f"{name}: outcome {index}")) for index, entry in enumerate(entries)
    )
    return WorstCases(record.record("command").entries, pushes.astype(np.float64), outcomes)


def _outcome(entry: Record) -> Outcome:
    """Return what a file says of one sequence, without what earlier versions called certified.

    Raises:
        ValueError: An entry is missing or of another type.
    """
    score, broken, error = entry["score"], entry["broken"], entry["error"]
    if not is_number(score):
        raise ValueError(f"{entry.name}: 'score' is {shown(score)} and must be a number")
    if not isinstance(broken, bool):
        raise ValueError(f"{entry.name}: 'broken' is {shown(broken)} and must be true or false")
    if not isinstance(error, str | None):
        raise ValueError(f"{entry.name}: 'error' is {shown(error)} and must be text or null")
    measures = {
        name: None if name.startswith("certified") else value
        for name, value in entry.record("measures").entries.items()
    }
    return Outcome(entry.whole("seed"), float(score), broken, measures, error)
