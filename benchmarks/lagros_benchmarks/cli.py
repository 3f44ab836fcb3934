"""The command line `lagros`.

Only the standard library, typer and `settings` are imported here; what a command needs is imported
inside it, so that `lagros --help` answers at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import typer

if TYPE_CHECKING:
    from lagros_benchmarks.records import Row
    from lagros_benchmarks.runner import BenchmarkRun, Progress
    from lagros_benchmarks.settings import BenchmarkSettings

USAGE_ERROR = 2
DEMO_FOLDER = Path("runs/demo")
# The paper's experiment: the default policies, 50 episodes, uniform disturbance.
DEMO: dict[str, Any] = {"episodes": 50, "disturbances": ("uniform",), "bounds": (0.75,)}

app = typer.Typer(
    help="Learning-based robust motion planning with guaranteed stability.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)

Value = TypeVar("Value")


def _file(explanation: str) -> Any:
    return typer.Option(metavar="FILE", dir_okay=False, help=explanation)


@dataclass(frozen=True)
class Outputs:
    """Where the results of a run go; None leaves one out.

    Attributes:
        json: All figures of the run, a list with one object per policy and condition.
        csv: The scalar ones.
        latex: The table.
        markdown: The table; success by condition if there are several.
        figure: The error figure of one condition, or the success figure of several.
        episodes: Every episode, one JSON object a line.
    """

    json: Path | None = None
    csv: Path | None = None
    latex: Path | None = None
    markdown: Path | None = None
    figure: Path | None = None
    episodes: Path | None = None

    def check(self) -> None:
        """Check the files before the run and not after it.

        Raises:
            ValueError: A folder cannot be made, or a figure has an unknown suffix.
        """
        if self.figure is not None:
            from lagros_benchmarks.figures import check_figure_path

            check_figure_path(self.figure)
        for path in (self.json, self.csv, self.latex, self.markdown, self.figure, self.episodes):
            if path is None:
                continue
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ValueError(f"cannot write {str(path)!r}: {error.strerror}") from error

    def write(self, run: BenchmarkRun, rows: list[Row]) -> Iterator[Path]:
        """Write the files, and yield the path of each."""
        from lagros_benchmarks import figures, files, records, tables

        if self.json is not None:
            yield files.write_json(self.json, rows)
        if self.csv is not None:
            yield files.write_atomic(self.csv, tables.csv_text(rows))
        if self.latex is not None:
            yield files.write_atomic(self.latex, tables.latex_text(rows))
        if self.markdown is not None:
            yield files.write_atomic(self.markdown, tables.markdown_text(rows))
        if self.episodes is not None:
            yield files.write_json_lines(self.episodes, records.episode_objects(run))
        if self.figure is not None:
            yield figures.draw(rows, self.figure)


def fail(error: Exception | str, status: int = USAGE_ERROR) -> NoReturn:
    """Say what is wrong, without a traceback, and end with the exit status."""
    typer.echo(f"lagros: {error}", err=True)
    raise typer.Exit(status)


def listed(text: str, convert: Callable[[str], Value], option: str) -> tuple[Value, ...]:
    """Split a comma-separated option.

    Raises:
        ValueError: An entry cannot be converted.
    """
    values = []
    for entry in filter(None, (part.strip() for part in text.split(","))):
        try:
            values.append(convert(entry))
        except ValueError:
            raise ValueError(f"{option}: {entry!r} is not a number") from None
    return tuple(values)


@app.callback(invoke_without_command=True)
def main(
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    """Learning-based robust motion planning with guaranteed stability."""
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"lagros {installed('lagros')}")
        raise typer.Exit


@app.command()
def bench(
    task: Annotated[str, typer.Argument(help="cartpole (spacecraft is to come).")],
    policies: Annotated[
        str,
        typer.Option(
            metavar="NAME[,NAME]",
            help="Of learned, tube-mpc, lagros, lqr, random, ppo, a stable-baselines3 .zip, or "
            "module:Class.",
        ),
    ] = "learned,tube-mpc,lagros,lqr",
    episodes: Annotated[int, typer.Option(help="Episodes of each policy and condition.")] = 50,
    seed: Annotated[int, typer.Option(help="Seed; its episodes never occur in training.")] = 0,
    disturbance: Annotated[
        str,
        typer.Option(
            metavar="KIND[,KIND]",
            help="Of none, uniform, sphere, constant, sinusoid, gust, worst.",
        ),
    ] = "uniform",
    bound: Annotated[
        str,
        typer.Option(
            metavar="D[,D]", help="Bounds d̄ of the disturbance, in units of the state per second."
        ),
    ] = "0.75",
    channels: Annotated[str, typer.Option(help="Disturbed states: all, or rates.")] = "all",
    jobs: Annotated[
        int, typer.Option(help="Worker processes; Δt is then measured in a serial pass after.")
    ] = 1,
    timing_episodes: Annotated[int, typer.Option(help="Episodes of that pass.")] = 10,
    replan_every: Annotated[
        int, typer.Option(help="Control steps between the plans of tube-mpc.")
    ] = 1,
    json: Annotated[Path | None, _file("All figures, one object per policy and condition.")] = None,
    csv: Annotated[Path | None, _file("The scalar figures.")] = None,
    latex: Annotated[Path | None, _file("The table, for LaTeX with booktabs.")] = None,
    markdown: Annotated[Path | None, _file("The table, as Markdown.")] = None,
    figure: Annotated[
        Path | None,
        _file("Error over time; success against the bound if there are several conditions."),
    ] = None,
    episodes_file: Annotated[Path | None, _file("Every episode, as JSON Lines.")] = None,
) -> None:
    """Compare policies on the same episodes; print the table, write what is asked for."""
    from lagros_benchmarks.settings import BenchmarkSettings, check_policy

    outputs = Outputs(json, csv, latex, markdown, figure, episodes_file)
    # A policy of the user's own, module:Class, lies in the folder that lagros is run from.
    sys.path.insert(0, os.getcwd())
    try:
        names = listed(policies, str, "--policies")
        planner = {"tube-mpc": {"replan_every": replan_every}} if replan_every != 1 else {}
        settings = BenchmarkSettings(
            task=task,
            policies=names,
            policy_settings=planner,
            episodes=episodes,
            seed=seed,
            disturbances=listed(disturbance, str, "--disturbance"),
            bounds=listed(bound, float, "--bound"),
            channels=channels,
            jobs=jobs,
            timing_episodes=timing_episodes,
        )
        for name in settings.policies:
            check_policy(name)
        outputs.check()
    except ValueError as error:
        fail(error)
    run_and_report(settings, outputs)


@app.command()
def demo() -> None:
    """The paper's cart-pole experiment: 50 paired episodes, the table and the figure."""
    from lagros_benchmarks.settings import BenchmarkSettings

    outputs = Outputs(json=DEMO_FOLDER / "results.json", figure=DEMO_FOLDER / "error.png")
    run_and_report(BenchmarkSettings(**DEMO), outputs)


@app.command()
def reproduce(
    task: Annotated[str, typer.Argument(help="cartpole (spacecraft is to come).")],
    folder: Annotated[
        Path, typer.Option("--out", file_okay=False, help="Where the run is kept and resumed.")
    ] = Path("runs/reproduce-cartpole"),
    jobs: Annotated[int, typer.Option(help="Worker processes; they change no result.")] = 2,
    episodes: Annotated[int, typer.Option(help="Episodes of each policy in the table.")] = 50,
) -> None:
    """From nothing to the table: metric, expert data, training, benchmark, figure."""
    from lagros_benchmarks.reproduce import ReproduceSettings, reproduce_cartpole
    from lagros_benchmarks.settings import check_task

    try:
        check_task(task)
        settings = ReproduceSettings(jobs=jobs, episodes=episodes)
        with progress_bar() as progress:
            benchmark = reproduce_cartpole(folder, settings, progress, progress_line)
    except ValueError as error:
        fail(error)
    outputs = Outputs(
        json=folder / "results.json",
        latex=folder / "table.tex",
        figure=folder / "error.png",
    )
    run_and_report(benchmark, outputs)


def progress_line(line: str) -> None:
    """Print a line above the progress bar."""
    typer.echo(line, err=True)


def run_and_report(settings: BenchmarkSettings, outputs: Outputs) -> list[Row]:
    """Run a benchmark with a progress bar, print its table and write its files.

    Args:
        settings: What to run.
        outputs: What to write.

    Returns:
        The rows.
    """
    from lagros_benchmarks.library import SetupError
    from lagros_benchmarks.records import summarise
    from lagros_benchmarks.runner import run_benchmark

    try:
        with progress_bar() as progress:
            run = run_benchmark(settings, progress=progress)
    except SetupError as error:
        # No weights, damaged weights, an extra that is not installed.
        fail(error, status=1)
    rows = summarise(run)
    report(rows)
    for path in outputs.write(run, rows):
        typer.echo(f"wrote {path}")
    return rows


def report(rows: list[Row]) -> None:
    """Print the tables, the paired differences and what raised."""
    from rich.console import Console
    from rich.text import Text

    from lagros_benchmarks import tables

    console = Console(highlight=False)
    for group in tables.by_condition(rows):
        console.print(tables.terminal_table(group))
        for line in tables.comparison_lines(group):
            console.print(line)
        console.print()
    for line in (tables.LEGEND, *tables.error_lines(rows)):
        # As text: the message of an exception may hold what rich takes for markup.
        console.print(Text(line))


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Give a function that draws progress on the terminal's error stream."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    with Bar(
        TextColumn("{task.description:<9}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        tasks: dict[str, Any] = {}

        def update(title: str, done: int, total: int) -> None:
            if title not in tasks:
                tasks[title] = bar.add_task(title, total=total)
            bar.update(tasks[title], completed=done)

        yield update
