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
from shlex import quote
from typing import Any

from lagros_envs.registry import called, task_named, task_names, with_settings
from lagros_envs.task import Described, Task
from lagros_envs.tasks import SHIPPED

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
    return with_settings(usual, settings)


def run_folder(task: Described) -> Path:
    """Return where `lagros reproduce` keeps a run of a task, from the working directory."""
    return Path(f"runs/reproduce-{task.name}")


def weights_folder(task: Described) -> Path:
    """Return the folder of a task's metric and networks: its own, the package's, or of its run."""
    own = getattr(task, "weights", None)
    if own is not None:
        return Path(own)
    return PRETRAINED if task.name in SHIPPED else run_folder(task)


def shipped_file(task: Described, what: str) -> Path:
    """Return where a task's file of weights is, or would be.

    Args:
        task: The task.
        what: Its part of the name, such as "metric.json" or "lagros.safetensors"; a run calls its
            metric by this alone.
    """
    folder = weights_folder(task)
    path, short = folder / f"{task.name}_{what}", folder / what
    return short if short.is_file() and not path.is_file() else path


def found_file(task: Described, what: str, train: str = "") -> Path:
    """Return a task's file of weights.

    Args:
        task: The task.
        what: As for `shipped_file`.
        train: Options of `lagros train` that makes it; "" where `lagros reproduce` does.

    Raises:
        FileNotFoundError: It has not been made.
    """
    path = shipped_file(task, what)
    if not path.is_file():
        if train:
            made = f"`lagros train {called(task)} {train}` makes it, to be copied there"
        else:
            made = f"`{reproducing(task)}` makes it"
        raise FileNotFoundError(f"{task.name} has no {path.name} in {path.parent}; {made}")
    return path


def reproducing(task: Described) -> str:
    """Return the command that makes metric and networks where the policies of a task look."""
    folder = weights_folder(task)
    usual = folder in (PRETRAINED, run_folder(task))
    return f"lagros reproduce {called(task)}" + ("" if usual else f" --out {quote(str(folder))}")
