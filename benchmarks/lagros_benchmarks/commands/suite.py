"""`lagros suite`: all systems x all policies, as one page."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagros_benchmarks.commands.outputs import Delivery, check_outputs
from lagros_benchmarks.commands.terminal import (
    QUIET,
    fail,
    file_option,
    find_users_modules,
    interrupted,
    listed,
    progress_bar,
    progress_line,
    refuse_options,
)
from lagros_benchmarks.run.process import undone

if TYPE_CHECKING:
    from lagros_benchmarks.run.suite import SuiteSettings

FOLDER = Path("runs/suite")
# What the rows of a file were made with, and cannot be changed for some of them.
_OF_ALL = (
    *("--policies", "--episodes", "--fewer", "--worlds", "--disturbance", "--initial-error"),
    *("--proved", "--worst", "--worst-flights", "--seed"),
)


def suite(
    tasks: Annotated[
        list[str] | None,
        typer.Argument(help="{tasks}, or of your own; all of these if none is named."),
    ] = None,
    policies: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME]",
            help="Of tasks of one body; what a task does not have is said to be missing.",
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Of each policy and condition.")] = 200,
    fewer: Annotated[
        str,
        typer.Option(metavar="NAME=N[,NAME=N]", help="Episodes of policies that take long."),
    ] = "mpc=20",
    worlds: Annotated[int, typer.Option(help="Of many agents.")] = 50,
    disturbance: Annotated[
        str, typer.Option(metavar="KIND[,KIND]", help="Of {disturbances}.")
    ] = "uniform,constant",
    initial_error: Annotated[
        float,
        typer.Option(metavar="SHARE", help="Of the episodes that begin beside their plan, too."),
    ] = 0.2,
    proved: Annotated[
        int, typer.Option(help="Plans of which is proved what they come to; 0 for none.")
    ] = 50,
    worst: Annotated[
        int,
        typer.Option(
            help="Episodes for which the worst disturbance is searched, as `lagros attack` does; 0 "
            "for none."
        ),
    ] = 5,
    worst_flights: Annotated[
        int, typer.Option(help="Flights that a search may spend on each of them.")
    ] = 300,
    seed: Annotated[int, typer.Option(help="Seed; its episodes never occur in training.")] = 0,
    jobs: Annotated[int, typer.Option(help="Worker processes.")] = 1,
    begun: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FILE",
            dir_okay=False,
            help="JSON of an earlier suite: the tasks that are named are flown anew, the others "
            "taken from it; without names it is only drawn again.",
        ),
    ] = None,
    json: Annotated[Path | None, file_option("All figures; suite.json in --out if not.")] = None,
    markdown: Annotated[Path | None, file_option("The page; all.md in --out if not.")] = None,
    figure: Annotated[Path | None, file_option("Its figure; all.png in --out if not.")] = None,
    out: Annotated[
        Path,
        typer.Option(
            metavar="FOLDER",
            file_okay=False,
            help="Keeps finished work, with which the same command goes on where it was killed.",
        ),
    ] = FOLDER,
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """Fly every system with every policy at its own bound, and write one page of it.

    Every task is flown without and with an error at the start, under each kind of disturbance;
    files are written after each task.
    """
    from lagros_benchmarks.report.canvas import check_figure_path
    from lagros_benchmarks.run.suite import SuiteSettings, read_result
    from lagros_envs.registry import task_names
    from lagros_policies.naming import listed_names

    places = (json or out / "suite.json", markdown or out / "all.md", figure or out / "all.png")
    find_users_modules((*(tasks or ()), *(policies or "").split(",")))
    try:
        for name in tasks or ():
            _check_task(name)
        given: dict[str, Any] = {} if policies is None else {"policies": listed_names(policies)}
        if "" in given.get("policies", ()):
            raise ValueError("--policies: an entry is empty; write them as a,b")
        if begun is not None:
            refuse_options(_OF_ALL, "--from says what the suite is")
            result = read_result(begun)
            settings = SuiteSettings(
                **result["settings"] | {"tasks": tuple(tasks or ()), "jobs": jobs}
            )
        else:
            result = {}
            settings = SuiteSettings(
                tasks=tuple(tasks or task_names()),
                episodes=episodes,
                fewer=_counts(fewer),
                worlds=worlds,
                disturbances=listed(disturbance, str, "--disturbance"),
                initial_error=initial_error,
                proved=proved,
                worst=worst,
                worst_flights=worst_flights,
                seed=seed,
                jobs=jobs,
                **given,
            )
        check_figure_path(places[2])
        named = {"--json": json, "--markdown": markdown, "--figure": figure}
        check_outputs(named, {"--from": None if begun == places[0] else begun}, {"--out": out})
    except (ValueError, OSError) as error:
        fail(error)
    _fly(settings, result, out / "work", places)


def _check_task(name: str) -> None:
    from lagros_envs.registry import find_task

    try:
        find_task(name)
    except ValueError as error:
        raise ValueError(f"tasks: {error}") from None


def _counts(text: str) -> dict[str, int]:
    """Return the numbers of NAME=N,NAME=N; "none" for none."""
    found: dict[str, int] = {}
    if text == "none":
        return found
    for entry in text.split(","):
        name, equals, number = entry.partition("=")
        if not (name.strip() and equals and number.strip().isdigit()):
            raise ValueError(f"--fewer: {entry!r} is not NAME=N, such as mpc=20; or give none")
        found[name.strip()] = int(number)
    return found


def _fly(
    settings: SuiteSettings, result: dict[str, Any], folder: Path, places: tuple[Path, Path, Path]
) -> None:
    """Fly the tasks one after the other, and write all files after each."""
    from lagros_benchmarks.run.suite import fly_task, with_task
    from lagros_policies.backends import BackendError

    if not settings.tasks:
        delivery = _write(result, places)
        _print(result)
        delivery.tell()
        return
    delivery = Delivery()
    for name in settings.tasks:
        try:
            with progress_bar() as progress, redirect_stdout(sys.stderr), undone():
                flown = fly_task(settings, name, folder, progress, progress_line)
        except BackendError as error:
            fail(error, status=1)
        except KeyboardInterrupt:
            interrupted(f"; the same command goes on with what is in {folder}")
        result = with_task(result, settings, flown)
        delivery = _write(result, places)
    _print(result)
    delivery.tell()


def _print(result: dict[str, Any]) -> None:
    from rich.console import Console

    from lagros_benchmarks.report.suite_page import printed_tables

    console = Console(highlight=False, markup=False)
    for title, table in printed_tables(result):
        console.print(title)
        console.print(table)
        console.print()


def _write(result: dict[str, Any], places: tuple[Path, Path, Path]) -> Delivery:
    from lagros_benchmarks.report.suite_figure import suite_figure
    from lagros_benchmarks.report.suite_page import page_text
    from lagros_benchmarks.run.files import json_text

    rows, page, drawing = places
    delivery = Delivery()
    delivery.write_text(rows, lambda: json_text(result))
    one_body = any("agents" not in row for row in result["rows"])
    delivery.write_text(page, lambda: page_text(result, page, drawing if one_body else None))
    if one_body:
        delivery.write(drawing, lambda path: suite_figure(result["rows"], path))
    return delivery
