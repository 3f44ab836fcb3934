"""Which tasks there are, and how one is found by what a user calls it."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from shlex import quote
from types import ModuleType
from typing import Any, cast

import gymnasium as gym

from lagros_envs.checks import shown, suggestion
from lagros_envs.conventions import settings_of
from lagros_envs.task import Described, Task
from lagros_envs.tasks import SHIPPED, Shipped

ENTRY_POINTS = "lagros.tasks"  # the group in which an installed package names its tasks
_FOUND: dict[str, Described] = {}
_FOREIGN: dict[str, Described] = {}  # environments of somebody else's
_CALLED: dict[str, str] = {}  # what a user called those that are not shipped


def task_names() -> tuple[str, ...]:
    """Return the names of all tasks that are known by name."""
    return (*SHIPPED, *(name for name in _FOUND if name not in SHIPPED))


def first_task() -> str:
    """Return the name of the task that is meant where none is named: the paper's."""
    return next(iter(SHIPPED))


def task_named(name: str) -> Described:
    """Return a task with its default settings.

    Raises:
        ValueError: There is no such task.
    """
    if name not in _FOUND:
        if not isinstance(name, str) or name not in SHIPPED:
            names = task_names()
            raise ValueError(
                f"unknown task {shown(name)}.{suggestion(name, names)} Valid: {', '.join(names)}."
            )
        module, _, attribute = SHIPPED[name].task.partition(":")
        _FOUND[name] = getattr(importlib.import_module(module), attribute)()
    return _FOUND[name]


def env_id_of(name: str) -> str:
    """Return the Gymnasium id of a task that is known by name; it is not imported for it."""
    return f"lagros/{SHIPPED[name].title}-v0" if name in SHIPPED else _FOUND[name].env_id


def called(task: Described) -> str:
    """Return what the command line takes for a task: its name, file, or module:class."""
    if task.name in SHIPPED:
        return task.name
    if task.name in _CALLED:
        return quote(_CALLED[task.name])
    module = type(task).__module__
    file = getattr(sys.modules.get(module), "__file__", None)
    own = module == "__main__" or module.startswith("lagros_envs.from_file.")
    if own and file is not None and os.path.isfile(file):
        module = file
    return quote(f"{module}:{type(task).__qualname__}")


def in_preset(task: Described, preset: str) -> Described:
    """Return a task of one body in one of its presets: of other sizes, hence a task of its own.

    The first preset is the task itself, and P the one that is registered as NAME-P.

    Raises:
        ValueError: It has no such preset.
    """
    if not isinstance(preset, str) or preset not in task.presets:
        raise ValueError(
            f"unknown preset {shown(preset)} of {task.name}.{suggestion(preset, task.presets)} "
            f"Valid: {', '.join(task.presets)}."
        )
    return task if preset == task.presets[0] else task_named(f"{task.name}-{preset}")


def with_settings(task: Task, settings: Task | Mapping[str, Any] | None) -> Task:
    """Return a task with settings of its own.

    Args:
        task: With its default settings.
        settings: The task itself; a dictionary of fields that differ from the defaults, and of
            `preset` where the task has several; or None for the defaults.

    Raises:
        ValueError: It is neither, has an unknown entry, or a value that cannot be.
    """
    if isinstance(settings, Mapping) and task.presets and "preset" in settings:
        rest = dict(settings)
        return settings_of(cast(Task, in_preset(task, rest.pop("preset"))), rest)
    return settings_of(task, settings)


def find_task(text: str | Described) -> Described:
    """Return a task by what a user calls it, and register it.

    Args:
        text: A name; the id of its environment, "lagros/Puck-v0"; one in the entry-point group
            `lagros.tasks` of an installed package; "module:attribute"; or the path of a file,
            "./puck.py", or of one with an attribute, "./puck.py:Puck". The file is run. In it the
            task is `task`, or else the only task. A task is taken as it is.

    Raises:
        ValueError: There is no such task, or something is wrong with it.
    """
    from lagros_envs.foreign.task import Foreign

    found = find_any(text)
    if isinstance(found, Foreign):
        raise ValueError(
            f"{found.name} is an environment of somebody else's, without plan, goal and metric: "
            "`lagros bench` and `lagros attack` run there, and nothing else"
        )
    return found


def find_any(text: str | Described) -> Described:
    """Return a task as `find_task` does, or an environment of somebody else's.

    Args:
        text: As for `find_task`; or "gym:ID", an environment of Gymnasium's; where a file or a
            module is named, there may be a `lagros_envs.Foreign` in it.

    Raises:
        ValueError: There is none, or something is wrong with it.
    """
    if isinstance(text, Described):
        return text
    if text in task_names():
        return task_named(text)
    for name in task_names():
        if text == env_id_of(name):
            return task_named(name)
    if text in _FOREIGN:
        return _FOREIGN[text]
    found = _found(text)
    _CALLED[found.name] = text
    return found


def _found(text: str) -> Described:
    from importlib.metadata import entry_points

    from lagros_envs.foreign.task import PREFIX, Foreign

    if text.startswith(PREFIX):
        return _registered(Foreign(text.removeprefix(PREFIX)))
    for point in entry_points(group=ENTRY_POINTS, name=text):
        return _registered(_made(_loaded(point.value), f"the entry point {text!r}"))
    place, colon, attribute = text.rpartition(":")
    if not colon or os.sep in attribute or attribute.endswith(".py"):
        place, attribute = text, ""
    if place.endswith(".py") or os.sep in place:
        from lagros_envs.from_file import imported

        module = imported(Path(place))
        found = getattr(module, attribute, None) if attribute else _only_task(module, place)
        if found is None:
            raise ValueError(f"{place} has no attribute {attribute}")
        return _registered(_made(found, text))
    if attribute:
        return _registered(_made(_loaded(text), text))
    names = (*task_names(), *entry_points(group=ENTRY_POINTS).names)
    raise ValueError(
        f"unknown task {shown(text)}.{suggestion(text, names)} Valid: {', '.join(names)}; "
        'the path of a file with a task, such as "./puck.py"; or "module:attribute"'
    )


def register_task(task: Task) -> Task:
    """Check a task and register it with Gymnasium, under its `env_id`.

    Args:
        task: With its default settings.

    Returns:
        The same.

    Raises:
        TypeError: It is no `Task`, or its system lacks something.
        ValueError: Something is wrong with it, or another task has its name; the message says
            what.
    """
    from lagros_envs.check_task import check_task

    check_task(task)
    if task.name in SHIPPED and type(task) is type(task_named(task.name)):
        return task
    whose = f"name={task.name!r}, title={task.title!r}"
    for name, shipped in SHIPPED.items():
        if name == task.name or shipped.title == task.title:
            raise ValueError(
                f"{whose} are taken by the task {name!r} of this package; choose others"
            )
    for name, known in _FOUND.items():
        # A file that is read again, or a cell of a notebook, makes the same class anew.
        same = _class_of(known) == _class_of(task)
        if (name == task.name or known.title == task.title) and not same:
            raise ValueError(f"{whose} are those of another task, {called(known)}; choose others")
    _FOUND[task.name] = task
    register_env(task.name, Shipped("", task.title, task.steps))
    return task


def register_env(name: str, shipped: Shipped) -> None:
    """Register environment and vector form of a task with Gymnasium."""
    env_id = f"lagros/{shipped.title}-v0"
    gym.registry.pop(env_id, None)
    general = shipped.env == Shipped._field_defaults["env"]
    gym.register(
        id=env_id,
        entry_point=shipped.env,
        vector_entry_point=shipped.vector,
        max_episode_steps=shipped.steps,
        kwargs={"task": name} if general else {},
    )


def _class_of(task: Described) -> tuple[str, str]:
    return type(task).__qualname__, type(task).__module__


def _registered(task: Described) -> Described:
    from lagros_envs.foreign.task import Foreign

    if _FOUND.get(getattr(task, "name", "")) is task:
        return task
    if isinstance(task, Task):
        return register_task(task)
    if isinstance(task, Foreign):
        _ = task.facts  # it can be made and pushed, or what is wrong is said
        _FOREIGN[task.name] = task
    return task


def _loaded(text: str) -> Any:
    """Import module:attribute."""
    name, _, attribute = text.partition(":")
    try:
        found: Any = importlib.import_module(name)
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{text}: {error}. A module is looked for on Python's path; name a file by its path, "
            'such as "./puck.py"'
        ) from error
    except (Exception, SystemExit) as error:
        raise ValueError(f"{text}: {name} raises {type(error).__name__}: {error}") from error
    return found


def _made(found: Any, text: str) -> Described:
    """Return the task that something is, or that it makes."""
    if (isinstance(found, type) and issubclass(found, Described)) or callable(found):
        try:
            found = found()
        except (Exception, SystemExit) as error:
            raise ValueError(
                f"{text}: {getattr(found, '__name__', shown(found))}() makes no task: "
                f"{type(error).__name__}: {error}"
            ) from error
    if not isinstance(found, Described):
        raise ValueError(
            f"{text} is {shown(found)}; it must be a Task, a subclass that can be made without "
            "arguments, or a function that returns one"
        )
    return found


def _only_task(module: ModuleType, place: str) -> Any:
    """Return `task` of a module, or the only task that it makes or defines."""
    if hasattr(module, "task"):
        return module.task
    own = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, Task)
        or (isinstance(value, type) and issubclass(value, Task) and _is_own(value, module))
    }
    made = {name: value for name, value in own.items() if isinstance(value, Task)} or own
    if len(made) == 1:
        return next(iter(made.values()))
    if not made:
        raise ValueError(
            f"{place} has no task: define a subclass of lagros_envs.Task in it, or an instance "
            "called task"
        )
    raise ValueError(
        f"{place} has several tasks, {', '.join(made)}; say which, for instance "
        f'"{place}:{next(iter(made))}", or call one of them task'
    )


def _is_own(kind: type, module: ModuleType) -> bool:
    return kind.__module__ == module.__name__
