"""What the help of a command says of the tasks: their names and defaults, from the registry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from operator import attrgetter
from typing import Any


@cache
def described() -> Mapping[str, str]:
    """Return texts by name, such as "tasks" and "bounds"."""
    from lagros_envs.disturbances import KINDS
    from lagros_envs.registry import task_named, task_names
    from lagros_policies.policy import policy_names

    tasks = [task_named(name) for name in task_names()]

    def each(value: Callable[[Any], Any]) -> str:
        """Return a value once, or that of every task where they differ; "" where it is empty."""
        values = {task.name: _worded(value(task)) for task in tasks}
        known = {name: text for name, text in values.items() if text}
        if len(set(known.values())) <= 1:
            return next(iter(known.values()), "")
        return "; ".join(f"{name}: {text}" for name, text in known.items())

    defaults = ("bound", "bounds", "episodes", "agents", "safety_filter", "speed")
    return {
        **{name: each(attrgetter(f"defaults.{name}")) for name in defaults},
        "tasks": ", ".join(task_names()),
        "policies": each(policy_names) + ".",
        "presets": each(attrgetter("presets")),
        "disturbances": ", ".join(KINDS),
    }


def _worded(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_worded, value))
    if isinstance(value, float):
        return f"{value:g}"
    return "" if value in (None, "none") else str(value)
