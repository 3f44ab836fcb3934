"""From episodes to the rows of a published table: one flat object per policy and condition."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from typing import Any

from lagros_benchmarks.run.experiment import BenchmarkRun, Row
from lagros_benchmarks.run.surroundings import machine, own_command, threads, versions
from lagros_benchmarks.tasks.cartpole import records as cartpole_records
from lagros_benchmarks.tasks.cartpole.experiment import CartPoleRun
from lagros_benchmarks.tasks.spacecraft import records as spacecraft_records
from lagros_benchmarks.tasks.spacecraft.experiment import SpacecraftRun

__all__ = ["Row", "episode_objects", "machine", "summarise", "threads", "versions"]


def summarise(run: BenchmarkRun, command: Sequence[str] | None = None) -> list[Row]:
    """Return one row per policy and condition: the public figures of a run.

    Efforts are averaged over the episodes that did not raise: one that raised has no effort, and
    counting none would flatter the policy. It still counts as a failure in every rate.

    Args:
        run: The episodes.
        command: What made the run; the command line of this process if None.

    Returns:
        The rows, in the order of the conditions and then of the policies.

    Raises:
        TypeError: The run is of no task that is known here.
    """
    surroundings = {
        "machine": machine(),
        "versions": versions(),
        "threads": {
            **threads(),
            "jobs": run.settings.jobs,
            "backend": run.settings.backend.name,
        },
        "command": shlex.join(command if command is not None else own_command()),
    }
    if isinstance(run, CartPoleRun):
        rows = cartpole_records.rows(run)
    elif isinstance(run, SpacecraftRun):
        rows = spacecraft_records.rows(run)
    else:
        raise TypeError(f"there are no rows for a {type(run).__name__}")
    return [{**row, **surroundings} for row in rows]


def episode_objects(run: BenchmarkRun) -> Iterable[dict[str, Any]]:
    """Yield every episode, or every agent of every world, as a JSON object.

    Raises:
        TypeError: The run is of no task that is known here.
    """
    if isinstance(run, CartPoleRun):
        return cartpole_records.episode_objects(run)
    if isinstance(run, SpacecraftRun):
        return spacecraft_records.agent_objects(run)
    raise TypeError(f"there are no episodes in a {type(run).__name__}")
