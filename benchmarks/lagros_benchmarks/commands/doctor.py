"""`lagros doctor`: what a report of a fault needs to say of the machine and the packages."""

from __future__ import annotations

import json as json_module
from importlib import metadata
from importlib.util import find_spec
from typing import Annotated, Any

import typer

from lagros_benchmarks.commands.extras import MODULES
from lagros_benchmarks.run.surroundings import machine, threads, versions


def doctor(
    json: Annotated[bool, typer.Option("--json", help="As JSON, for a program to read.")] = False,
) -> None:
    """Print what lagros runs on: versions, processor, threads, extras; for a report of a fault."""
    found = diagnosis()
    if json:
        typer.echo(json_module.dumps(found, indent=2))
        return
    for title, facts in found.items():
        typer.echo(title)
        for name, fact in facts.items():
            typer.echo(f"  {name:<22} {fact}")


def diagnosis() -> dict[str, dict[str, Any]]:
    """Return what is known, by heading."""
    return {
        "machine": machine(),
        "versions": versions(),
        "threads": {
            name: "not set" if value is None else value for name, value in threads().items()
        },
        "extras": {extra: _state(modules) for extra, modules in MODULES.items()},
        "tasks": _announced(),
    }


def _state(modules: tuple[str, ...]) -> str:
    """Return whether an extra is there."""
    missing = [module for module in modules if find_spec(module) is None]
    return f"missing: {', '.join(missing)}" if missing else "installed"


def _announced() -> dict[str, str]:
    """Return tasks of other distributions, by name; nothing of theirs is imported."""
    return {point.name: point.value for point in metadata.entry_points(group="lagros.tasks")}
