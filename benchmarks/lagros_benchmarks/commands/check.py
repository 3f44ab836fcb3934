"""`lagros check`: what is wrong with a task, a user's own above all, and what to write instead."""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagros_benchmarks.commands.outputs import Delivery, check_outputs
from lagros_benchmarks.commands.terminal import (
    QUIET,
    fail,
    file_option,
    find_users_modules,
    progress_bar,
)

if TYPE_CHECKING:
    from lagros_policies.inspection import Finding

_MOST_EPISODES = 1000


def check(
    task: Annotated[
        str, typer.Argument(help="A .py file, module:attribute, or a name as for `lagros bench`.")
    ],
    episodes: Annotated[int, typer.Option(help="Random episodes that are planned and flown.")] = 8,
    seed: Annotated[int, typer.Option(help="Seed; its episodes are of no other command.")] = 0,
    json: Annotated[Path | None, file_option("Write the findings.")] = None,
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """Say what is wrong with a task of one body, and what to write instead.

    Looked at are names and units, energy and mirror image if the system states them, the hold,
    plans, what controls move, their limits, flights at the task's disturbance, regulator, metric,
    networks and rules. Exit status 1: there is a fault.
    """
    from lagros_envs.checks import check_seed, check_whole
    from lagros_envs.registry import find_task
    from lagros_envs.task import Task
    from lagros_policies.inspection import count, inspect_task, refused, verdict_of

    try:
        check_whole("episodes", episodes, 1, _MOST_EPISODES)
        check_seed(seed)
        if task.endswith(".py") and not Path(task).is_file():
            raise ValueError(f"{task}: there is no such file; `lagros new {task}` writes one")
        check_outputs({"--json": json})
    except ValueError as error:
        fail(error)
    find_users_modules([task])
    name = task if len(task) <= 80 else f"{task[:79]}…"
    try:
        described: Any = find_task(task)
        name = described.name
    except (TypeError, ValueError) as error:
        findings = [refused(error)]
    else:
        if not isinstance(described, Task):
            fail(f"{name} is a world of many agents; lagros check is for one body")
        with progress_bar() as tell:
            findings = inspect_task(described, episodes, seed, tell)
    verdict = verdict_of(name, findings)
    record = {
        "task": name,
        "verdict": verdict,
        "faults": count(findings, "fault"),
        "warnings": count(findings, "warning"),
        "episodes": episodes,
        "seed": seed,
        "findings": [asdict(one) for one in findings],
    }
    delivery = Delivery()
    delivery.write_text(
        json, lambda: json_module.dumps(record, indent=1, ensure_ascii=False) + "\n"
    )
    print_findings(verdict, findings)
    delivery.tell()
    if record["faults"]:
        raise typer.Exit(1)


def print_findings(verdict: str, findings: Sequence[Finding]) -> None:
    """Print the verdict, then every finding, the worst first, with its remedy under it."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from lagros_policies.inspection import VERDICTS

    console = Console(width=80, highlight=False)
    console.print(Text(verdict, style="bold"), soft_wrap=True)
    console.print()
    table = Table(box=None, padding=(0, 1), show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column()
    for one in sorted(findings, key=lambda one: VERDICTS.index(one.verdict)):
        table.add_row(one.verdict, one.subject, Text(one.text))
        if one.remedy:
            table.add_row("", "", Text(f"→ {one.remedy}"))
    console.print(table)
