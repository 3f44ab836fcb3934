"""Where the parts of a benchmark are that depend on the task: its room.

A task of one body needs none: the parts that stand here serve it. One that has a folder of its own
under `lagros_benchmarks.tasks` names there, in `ROOM`, those that it brings itself.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

from lagros_envs.foreign.task import PREFIX, Foreign
from lagros_envs.registry import task_named, task_names
from lagros_envs.task import Described


@dataclass(frozen=True)
class Room:
    """Places of the parts, each module:attribute or a module, imported when it is asked for.

    Attributes:
        experiment: An `Experiment`, whose `set_up` takes settings and toolbox.
        records: A module with the figures of its rows, and with its episodes as objects.
        tables: A module with the texts and columns of its tables.
        figures: Draws rows into a file; None, as in all that follow, where there is no such thing.
        scene: Draws what every policy made of one world of a run.
        fly_scene: Flies that world.
        reels: Flies episodes again for a page in a browser.
        camera: Notes what such a page shows of an episode, a `report.page.reels.Camera`.
        reproduced: Name of the figure of `lagros reproduce`.
        game: What `lagros watch` plays.
        attack: Episodes and search of an attack, a `worst_case.single.SingleBench`.
        guaranteed: What is proved of the episodes of a policy.
        certify: The certificate of flights.
        certify_metric: The certificate of a metric.
        reproduce: Everything from nothing.
        train: How it is learned by reinforcement, a `training.course.SingleCourse`.
        demonstrations: The expert whose episodes `lagros data` writes.
    """

    experiment: str = "lagros_benchmarks.run.single:SingleExperiment"
    records: str = "lagros_benchmarks.report.single"
    tables: str = "lagros_benchmarks.report.single_tables"
    figures: str | None = "lagros_benchmarks.report.single_figures:draw"
    scene: str | None = None
    fly_scene: str | None = None
    reels: str | None = "lagros_benchmarks.report.page.single:SingleReels"
    camera: str | None = "lagros_benchmarks.report.page.single:SingleCamera"
    reproduced: str = "error.png"
    game: str | None = "lagros_benchmarks.report.watched:SingleGame"
    attack: str = "lagros_benchmarks.worst_case.single:SingleBench"
    guaranteed: str | None = "lagros_benchmarks.evidence.columns:guaranteed"
    certify: str | None = "lagros_benchmarks.evidence.single:certify"
    certify_metric: str | None = "lagros_benchmarks.evidence.metric:certify_metric"
    reproduce: str | None = "lagros_benchmarks.run.reproduce:ReproduceSettings"
    train: str | None = "lagros_benchmarks.training.course:COURSE"
    demonstrations: str | None = "lagros_benchmarks.run.demonstrations:SingleExpert"

    def part(self, name: str) -> Any:
        """Import one of the parts by the name of its attribute.

        Raises:
            ValueError: There is none.
        """
        place = getattr(self, name)
        if place is None:
            raise ValueError(f"this task has no part {name!r}")
        module, _, attribute = str(place).partition(":")
        found = importlib.import_module(module)
        return getattr(found, attribute) if attribute else found


def room_of(task: Described) -> Room:
    """Return the room of a task."""
    if task.room is None:
        return Room()
    found: Room = importlib.import_module(f"lagros_benchmarks.tasks.{task.room}").ROOM
    return found


def room_named(task: str) -> Room:
    """Return the room of a task by the name that stands in its rows.

    A task that is not known here, of rows that were read from a file, has one body; an
    environment of somebody else's says by its name what it is.
    """
    if task.startswith(PREFIX):
        return room_of(Foreign(task.removeprefix(PREFIX)))
    return room_of(task_named(task)) if task in task_names() else Room()
