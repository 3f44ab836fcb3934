"""Where the parts of a policy are that depend on the task: its room, and the files of its weights.

A task needs no room: the general parts serve it. One with a folder of its own under
`lagros_policies.tasks` names there, in capitals, the parts that it brings itself, each as
module:attribute:

    POLICIES    names of the policies that it adds or replaces
    PLANNER     what plans its target trajectories, of a task (`planning.planner.TaskPlanner`)
    PREFERENCE  what u* prefers along a plan, of a task (`expert.Regulator`)
    WEIGHTS     weights of a regulator, of a task (`baselines.bryson_weights`)
    SPACES      shapes and bounds of its observations and actions (`sb3_model.single_spaces`)
    TRAINED     what its networks may fly, of a task (`trained_for.Training`)
    VIEW        what its networks see, of a task (`learning.features.Usual`)
    METRIC      how its metric is made (`learning.metric.MetricSettings`)

and the function `told(world, settings)`, what its policies are built with besides the task.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lagros_envs.conventions import settings_of
from lagros_envs.registry import task_named, task_names
from lagros_envs.task import Described, Task

PRETRAINED = Path(__file__).parent / "pretrained"


def imported(place: str) -> Any:
    """Return what module:attribute names."""
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(module), attribute)


def named_in(task: Described, name: str, general: Any) -> Any:
    """Return an entry of a task's room; the general one where it has none."""
    if task.room is None:
        return general
    return getattr(importlib.import_module(f"lagros_policies.tasks.{task.room}"), name, general)


def part_of(task: Described, name: str, general: str) -> Any:
    """Import a part of a task.

    Args:
        task: The task.
        name: Of the part, in capitals; see the module.
        general: What serves a task that names none.
    """
    return imported(named_in(task, name, general))


def task_of(settings: Task | Mapping[str, Any] | None) -> Task:
    """Return the task of a policy that is built by its class.

    Args:
        settings: The task; None, or a dictionary of fields that differ, for the paper's.

    Raises:
        ValueError: It is none of these.
    """
    if isinstance(settings, Task):
        return settings
    usual: Any = task_named(task_names()[0])
    found: Task = settings_of(usual, settings)
    return found


def shipped_file(task: Described, what: str) -> Path:
    """Return where a task's file of weights is, or would be.

    Args:
        task: The task.
        what: Its part of the name, such as "metric.json" or "lagros.safetensors".
    """
    folder = getattr(task, "weights", None) or PRETRAINED
    return Path(folder) / f"{task.name}_{what}"


def found_file(task: Described, what: str, command: str = "reproduce") -> Path:
    """Return a task's file of weights.

    Args:
        task: The task.
        what: As for `shipped_file`.
        command: Of `lagros`, that makes it.

    Raises:
        FileNotFoundError: It has not been made.
    """
    path = shipped_file(task, what)
    if not path.is_file():
        raise FileNotFoundError(
            f"{task.name} has no {path.name} in {path.parent}; `lagros {command} {task.name}` makes"
            " it (of a task of your own, name the file)"
        )
    return path
