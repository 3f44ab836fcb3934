"""Which tasks there are, and how one is found by what a user calls it."""

from __future__ import annotations

import importlib

from lagros_envs.checks import shown, suggestion
from lagros_envs.task import Described
from lagros_envs.tasks import SHIPPED

_REGISTERED: dict[str, Described] = {}


def task_names() -> tuple[str, ...]:
    """Return the names of all tasks that are known by name."""
    return (*SHIPPED, *(name for name in _REGISTERED if name not in SHIPPED))


def task_named(name: str) -> Described:
    """Return a task with its default settings.

    Args:
        name: As in `task_names`.

    Raises:
        ValueError: There is no such task.
    """
    if name not in _REGISTERED:
        if not isinstance(name, str) or name not in SHIPPED:
            names = task_names()
            raise ValueError(
                f"unknown task {shown(name)}.{suggestion(name, names)} Valid: {', '.join(names)}."
            )
        module, _, attribute = SHIPPED[name].partition(":")
        _REGISTERED[name] = getattr(importlib.import_module(module), attribute)()
    return _REGISTERED[name]
