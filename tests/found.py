"""Every task that is found: shipped ones by name, those of `examples/` by their file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lagros_envs.registry import find_task, task_named
from lagros_envs.task import Task
from lagros_envs.tasks import SHIPPED

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted(
    path
    for path in (ROOT / "examples").glob("*.py")
    if "(Task):" in path.read_text(encoding="utf-8")
)
SINGLE = [name for name in SHIPPED if isinstance(task_named(name), Task)]
# As a command takes them.
TASKS = [*SHIPPED, *map(str, EXAMPLES)]
SINGLE_BODY = [*SINGLE, *map(str, EXAMPLES)]


def task_of(text: str) -> Any:
    """Return a task that is found."""
    return find_task(text)


def named(texts: list[str]) -> list[Any]:
    """Return parameters with short ids."""
    return [pytest.param(text, id=Path(text).stem) for text in texts]
