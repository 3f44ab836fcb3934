"""`lagros train TASK --algo c3m`: one run, its weights and its record."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import asdict
from typing import Any, NamedTuple

from lagros_benchmarks.run.files import plain, write_json
from lagros_benchmarks.run.surroundings import machine, versions
from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.training.c3m_run import C3mRun
from lagros_benchmarks.training.evaluation import final_row
from lagros_benchmarks.training.run import Place, check_same, digest_of
from lagros_benchmarks.training.settings import FINAL
from lagros_envs.reading import Record
from lagros_envs.registry import find_task
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Task
from lagros_policies.c3m import C3mPolicy, ContractionNetworks
from lagros_policies.learning.c3m import fit_c3m, region_of
from lagros_policies.trained_for import training_of, weights_record

_LOG = logging.getLogger(__name__)
_CHECKPOINT = "progress-{}.safetensors"
_KINDS = "uniform", "constant"
# Namespace of the episodes that choose among the candidates ("scan" in ASCII).
_SCANNED = 0x7363616E


def train(run: C3mRun, place: Place, command: str = "", tell: Progress = untold) -> dict[str, Any]:
    """Train, or go on with a run that was interrupted; a complete run is only read.

    Args:
        run: The run.
        place: Where it is kept.
        command: What prints the run again, for its record.
        tell: Called with the epochs done and their number, of all candidates.

    Returns:
        The record, as it is written.

    Raises:
        ValueError: The folder holds another run, or its checkpoint is damaged.
    """
    settings = plain(run.record())
    if place.record.exists():
        found = Record.load(place.record, "the record of a run")
        check_same(place.folder, found.record("training").entries, settings)
        if place.weights.exists() and digest_of(place.weights) == found.entries["weights_sha256"]:
            return dict(found.entries)
    task: Any = find_task(run.task)
    place.folder.mkdir(parents=True, exist_ok=True)
    begun = time.process_time()
    tried = [_tried(run, task, place, 0, tell)]
    if tried[0].said["conditions"]["closed"] < run.enough:
        tried += [_tried(run, task, place, number, tell) for number in range(1, len(run.scan))]
    best = max(tried, key=_merit)
    spent = time.process_time() - begun
    best.networks.save(place.weights)
    record = plain(
        {
            "command": command,
            "training": run.record(),
            "scan": [one.said for one in tried],
            "chosen": best.said["candidate"],
            "region": best.region,
            "conditions": best.said["conditions"],
            "final": _flown(task, best.networks, run.final_episodes, FINAL),
            "cpu_seconds": round(spent, 1),
            "machine": machine(),
            "versions": versions(),
            "weights_sha256": digest_of(place.weights),
        }
    )
    write_json(place.record, record)
    for path in place.folder.glob(_CHECKPOINT.format("*")):
        path.unlink()
    finished: dict[str, Any] = record
    return finished


class _Tried(NamedTuple):
    """A candidate after its training: what flies, where it was trained, and what came of it."""

    networks: ContractionNetworks
    region: dict[str, Any]
    said: dict[str, Any]


def _tried(run: C3mRun, task: Task, place: Place, number: int, tell: Progress) -> _Tried:
    candidate = run.scan[number]
    settings = run.settings_of(candidate, task.time_limit)
    region = region_of(task, run.seed, candidate.met)

    def told(epoch: int, loss: float) -> None:
        _LOG.info("%s #%d %d/%d: loss %.4g", place.folder, number, epoch, settings.epochs, loss)
        tell(run.label, number * settings.epochs + epoch, len(run.scan) * settings.epochs)

    checkpoint = place.folder / _CHECKPOINT.format(number)
    made, observed = fit_c3m(task, region, settings, checkpoint, told)
    trained_for = training_of(task).range(timed=False)
    networks = made.frozen_copy(weights_record(task.name, run.label, trained_for))
    figures = _flown(task, networks, run.scan_episodes, _SCANNED)
    tried = {**asdict(candidate), "rate": settings.rate}
    said = {"candidate": tried, "conditions": observed, "figures": figures}
    return _Tried(networks, asdict(region), said)


def _merit(one: _Tried) -> tuple[float, float, float]:
    """Return by what a candidate is judged, the largest first: success, strict, distance left."""
    rows = one.said["figures"]
    success, strict, left = (
        sum(row[name] for row in rows) for name in ("success", "strict", "final_distance")
    )
    return success, strict, -left


def _flown(
    task: Task, networks: ContractionNetworks, episodes: int, namespace: int
) -> list[dict[str, Any]]:
    """Return the figures under disturbances of the task's bound."""
    policy = C3mPolicy(task, networks, deadline=math.inf)
    seeds = episode_seeds(0, episodes, namespace)
    return [final_row(policy, seeds, kind, task.defaults.bound) for kind in _KINDS]
