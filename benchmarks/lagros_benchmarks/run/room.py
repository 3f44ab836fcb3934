"""Where the parts of a benchmark are that depend on the task: its room.

A task of one body needs none: the parts that stand here serve it. One that has a folder of its own
under `lagros_benchmarks.tasks` names there, in `ROOM`, those that it brings itself.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

from lagros_envs.task import Described


@dataclass(frozen=True)
class Room:
    """Places of the parts, as module:attribute; each is imported when it is asked for.

    Attributes:
        experiment: An `Experiment`'s constructor, from settings and toolbox.
        rows: The rows of a run.
        episodes: The objects of a run's episodes.
        tables: The texts and columns of its tables.
        figures: Its figures.
        game: What `lagros watch` plays.
        attack: Episodes and search of an attack, a `worst_case.attack.Bench`.
        certify: The certificate.
        reproduce: Everything from nothing.
        train: Training by reinforcement.
        demonstrations: The expert whose episodes `lagros data` writes.
    """

    experiment: str = "lagros_benchmarks.run.single:SingleExperiment"
    rows: str = "lagros_benchmarks.report.single:rows"
    episodes: str = "lagros_benchmarks.report.single:episode_objects"
    tables: str = "lagros_benchmarks.report.single_tables:TABLES"
    figures: str = "lagros_benchmarks.report.single_figures:draw"
    game: str = "lagros_benchmarks.report.watched:SingleGame"
    attack: str = "lagros_benchmarks.worst_case.single:SingleBench"
    certify: str = "lagros_benchmarks.evidence.single:certify"
    reproduce: str = "lagros_benchmarks.run.reproduce:ReproduceSettings"
    train: str = "lagros_benchmarks.training.single:TRAINING"
    demonstrations: str = "lagros_benchmarks.run.demonstrations:SingleExpert"

    def part(self, name: str) -> Any:
        """Import one of the parts by the name of its attribute."""
        module, _, attribute = str(getattr(self, name)).partition(":")
        return getattr(importlib.import_module(module), attribute)


def room_of(task: Described) -> Room:
    """Return the room of a task."""
    if task.room is None:
        return Room()
    found: Room = importlib.import_module(f"lagros_benchmarks.tasks.{task.room}").ROOM
    return found
