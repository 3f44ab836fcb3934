"""`lagros train TASK --algo c3m`: one run, its weights and its record."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import asdict
from typing import Any

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
from lagros_policies.c3m import C3mPolicy
from lagros_policies.learning.c3m import fit_c3m, region_of
from lagros_policies.trained_for import training_of, weights_record

_LOG = logging.getLogger(__name__)
_CHECKPOINT = "progress.safetensors"
_KINDS = "uniform", "constant"


def train(run: C3mRun, place: Place, command: str = "", tell: Progress = untold) -> dict[str, Any]:
    """Train, or go on with a run that was interrupted; a complete run is only read.

    Args:
        run: The run.
        place: Where it is kept.
        command: What prints the run again, for its record.
        tell: Called with the epochs done and their number.

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
    region = region_of(task, run.seed)
    place.folder.mkdir(parents=True, exist_ok=True)
    begun, checkpoint = time.process_time(), place.folder / _CHECKPOINT

    def told(epoch: int, loss: float) -> None:
        _LOG.info("%s %d/%d: loss %.4g", place.folder, epoch, run.settings.epochs, loss)
        tell(run.label, epoch, run.settings.epochs)

    networks, observed = fit_c3m(task, region, run.settings, checkpoint, told)
    spent = time.process_time() - begun
    trained_for = training_of(task).range(timed=False)
    networks.frozen_copy(weights_record(task.name, run.label, trained_for)).save(place.weights)
    record = plain(
        {
            "command": command,
            "training": run.record(),
            "region": asdict(region),
            "conditions": observed,
            "final": _final(task, place, run.final_episodes),
            "cpu_seconds": round(spent, 1),
            "machine": machine(),
            "versions": versions(),
            "weights_sha256": digest_of(place.weights),
        }
    )
    write_json(place.record, record)
    checkpoint.unlink(missing_ok=True)
    finished: dict[str, Any] = record
    return finished


def _final(task: Task, place: Place, episodes: int) -> list[dict[str, Any]]:
    """Return the figures under disturbances of the task's bound."""
    policy = C3mPolicy(task, place.weights, deadline=math.inf)
    seeds = episode_seeds(0, episodes, FINAL)
    return [final_row(policy, seeds, kind, task.defaults.bound) for kind in _KINDS]
