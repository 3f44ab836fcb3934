"""The command line `lagros`."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagros_benchmarks.commands.attack import attack
from lagros_benchmarks.commands.certify import certify
from lagros_benchmarks.commands.check import check
from lagros_benchmarks.commands.data import data
from lagros_benchmarks.commands.doctor import doctor
from lagros_benchmarks.commands.export import export
from lagros_benchmarks.commands.extras import check_extra
from lagros_benchmarks.commands.first_steps import a_few_worlds, first_steps
from lagros_benchmarks.commands.leaderboard import leaderboard
from lagros_benchmarks.commands.new import new
from lagros_benchmarks.commands.outputs import check_outputs, policy_files
from lagros_benchmarks.commands.streams import printing_failed
from lagros_benchmarks.commands.suite import suite
from lagros_benchmarks.commands.terminal import (
    ADDRESS,
    BACKEND,
    QUIET,
    Command,
    Commands,
    fail,
    file_option,
    find_users_modules,
    interrupted,
    listed,
    listed_or_none,
    progress_bar,
    progress_line,
    refuse_options,
    task_in_preset,
)
from lagros_benchmarks.commands.train import train
from lagros_benchmarks.commands.watch import watch
from lagros_benchmarks.run.process import undone

if TYPE_CHECKING:
    from lagros_benchmarks.report.delivery import Outputs
    from lagros_benchmarks.report.records import Row
    from lagros_benchmarks.run.keeping import Kept
    from lagros_benchmarks.run.settings import BenchmarkSettings

BENCH_FOLDER, DEMO_FOLDER = Path("runs/bench"), Path("runs/demo")
DEMO: dict[str, Any] = {}  # what the demonstration changes of the paper's experiment: nothing

app = typer.Typer(cls=Commands, add_completion=False, pretty_exceptions_show_locals=False)

TASK = typer.Argument(help="{tasks}; or one of your own: module:attribute, or a .py file.")
ANY_TASK = typer.Argument(
    help="{tasks}; or one of your own: module:attribute, or a .py file; or gym:ID, an environment "
    "of Gymnasium's."
)


@app.callback(invoke_without_command=True)
def main(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    """Learning-based robust motion planning with guaranteed stability."""
    if version:
        from lagros_benchmarks.run.surroundings import versions

        typer.echo(f"lagros {versions().get('lagros', '(run from its folder, not installed)')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(first_steps())


@app.command(cls=Command)
def bench(
    task: Annotated[str, ANY_TASK],
    policies: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME]",
            help="{policies} Or ablation: all with a colon, and lqr-plan. Or a stable-baselines3 "
            ".zip, or module:Class.",
        ),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Episodes (worlds) of each policy and condition; {episodes}.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed; its episodes never occur in training.")] = 0,
    disturbance: Annotated[
        str, typer.Option(metavar="KIND[,KIND]", help="Of {disturbances}.")
    ] = "uniform",
    bound: Annotated[
        str | None,
        typer.Option(
            metavar="D[,D]",
            help="Bounds d̄ of the disturbance, in units of the state per second; {bounds}.",
        ),
    ] = None,
    channels: Annotated[str, typer.Option(help="Disturbed states: all, or rates.")] = "all",
    agents: Annotated[
        str | None,
        typer.Option(metavar="N[,N]", help="Agents in a world, {agents}; several compare them."),
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help="Kind of worlds of agents, or form of a body; {presets}.")
    ] = None,
    safety_filter: Annotated[
        str | None,
        typer.Option(help="Of agents: none, all (use it), both, or proved; {safety_filter}."),
    ] = None,
    jobs: Annotated[
        int, typer.Option(help="Worker processes; Δt is then measured in a serial pass after.")
    ] = 1,
    backend: Annotated[str, BACKEND] = "loky",
    address: Annotated[str | None, ADDRESS] = None,
    timing_episodes: Annotated[
        int, typer.Option(help="Episodes of that pass, which worlds of agents always have.")
    ] = 10,
    replan_every: Annotated[
        int | None,
        typer.Option(
            help="One body: control steps between the plans of tube-mpc; if left out it plans "
            "again where goal or discs have moved."
        ),
    ] = None,
    guarantee: Annotated[
        bool,
        typer.Option(
            "--guarantee",
            help="One body: prove, plan by plan, of how many episodes what they come to; takes up "
            "to a second for each, policy and bound.",
        ),
    ] = False,
    initial_error: Annotated[
        float,
        typer.Option(
            metavar="SHARE",
            help="One body: begin beside the plan, by up to this share of the scale of each "
            "coordinate, and show how the error dies out.",
        ),
    ] = 0.0,
    json: Annotated[
        Path | None, file_option("All figures, one object per policy and condition.")
    ] = None,
    csv: Annotated[Path | None, file_option("The scalar figures.")] = None,
    latex: Annotated[Path | None, file_option("The table, for LaTeX with booktabs.")] = None,
    markdown: Annotated[Path | None, file_option("The table, as Markdown.")] = None,
    figure: Annotated[
        Path | None,
        file_option(
            "One body: error over time, or success against the bound. Agents: success and effort "
            "against the bound; against their number success and time."
        ),
    ] = None,
    scene: Annotated[
        Path | None, file_option("Agents: trajectories of every policy in one world.")
    ] = None,
    scene_world: Annotated[int, typer.Option(help="Which of the run's worlds, from 0.")] = 0,
    episodes_file: Annotated[
        Path | None, file_option("Every episode (every agent), as JSON Lines.")
    ] = None,
    html: Annotated[
        Path | None,
        file_option("One page for a browser: table, figures, and episodes to play side by side."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            file_okay=False,
            help="Keeps finished work, with which the same command goes on where it was killed. "
            f"If left out it is {BENCH_FOLDER}, and emptied at the end.",
        ),
    ] = None,
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """Compare policies on the same episodes; print the table, write what is asked for.

    A policy is waited for, however long it takes. Exit status 3: everything is written, and in some
    episodes a policy raised; they count as failures, and their rows are marked.
    """
    from lagros_benchmarks.report.delivery import Outputs
    from lagros_benchmarks.run.settings import BenchmarkSettings, check_policy
    from lagros_envs.checks import check_whole
    from lagros_envs.registry import find_any
    from lagros_policies.backends import Backend
    from lagros_policies.naming import listed_names, with_parts
    from lagros_policies.policy import policy_names

    outputs = Outputs(json, csv, latex, markdown, figure, episodes_file, scene, scene_world, html)
    named = None if policies is None else listed_names(policies)
    find_users_modules((task, *(named or ())))
    try:
        task, preset = task_in_preset(task, preset)
        described: Any = find_any(task)
        if named is not None and "" in named:
            raise ValueError("--policies: an entry is empty; write them as a,b")
        named = None if named is None else with_parts(named, policy_names(described))
        if scene is None:
            refuse_options(["--scene-world"], "no --scene is asked for")
        if disturbance.strip() == "none":
            refuse_options(["--bound"], "no disturbance has a bound")
        planned = [
            name
            for name in named or described.defaults_in(preset).policies
            if name.partition(":")[0] == "tube-mpc"
        ]
        if replan_every is not None:
            if described.most_agents > 1:
                raise ValueError(f"--replan-every is for one body; leave it out for {task}")
            if not planned:
                raise ValueError("--replan-every is for tube-mpc, which is none of --policies")
            check_whole("replan_every", replan_every, 1, described.steps)
        settings = BenchmarkSettings.for_task(
            task,
            policies=listed_or_none(named, str, "--policies"),
            policy_settings=None
            if replan_every is None
            else {name: {"replan_every": replan_every} for name in planned},
            episodes=episodes,
            seed=seed,
            disturbances=listed(disturbance, str, "--disturbance"),
            bounds=listed_or_none(bound, float, "--bound"),
            channels=channels,
            agents=listed_or_none(agents, int, "--agents"),
            preset=preset,
            safety_filter=safety_filter,
            jobs=jobs,
            timing_episodes=timing_episodes,
            backend=Backend(backend, address),
            guarantee=guarantee,
            initial_error=initial_error,
        )
        for name in settings.policies:
            check_policy(name, described.name)
        files = policy_files(settings.policies)
        outputs.check(described, settings.episodes, files, {"--out": out}, BENCH_FOLDER)
    except ValueError as error:
        fail(error)
    run_and_report(settings, outputs, out or BENCH_FOLDER, keep=out is not None)


@app.command(cls=Command)
def demo(quiet: Annotated[bool, QUIET] = False) -> None:
    """The paper's first experiment: 50 paired episodes; then a few worlds of agents; a report."""
    from lagros_benchmarks.report.delivery import Outputs
    from lagros_benchmarks.run.settings import BenchmarkSettings

    place, pages = DEMO_FOLDER, [DEMO_FOLDER / "report.html", DEMO_FOLDER / "worlds.html"]
    outputs = Outputs(json=place / "results.json", figure=place / "error.png", html=pages[0])
    worlds = Outputs(json=place / "worlds.json", html=pages[1])
    try:
        outputs.check()
        worlds.check()
    except ValueError as error:
        fail(error)
    run_and_report(BenchmarkSettings(**DEMO), outputs, place)
    run_and_report(a_few_worlds(), worlds, place)
    typer.echo(f"open {pages[0]} and {pages[1]} in a browser: every episode there can be played")


@app.command(cls=Command)
def reproduce(
    task: Annotated[str, TASK],
    folder: Annotated[
        Path | None,
        typer.Option(
            "--out",
            file_okay=False,
            help="Where the run is kept and resumed; runs/reproduce-TASK if left out.",
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(help="Worker processes; they change no result.")] = 2,
    backend: Annotated[str, BACKEND] = "loky",
    address: Annotated[str | None, ADDRESS] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Episodes (worlds) of each policy in the table.")
    ] = None,
    shipped: Annotated[
        bool, typer.Option("--shipped-weights", help="Only the benchmark, with what is shipped.")
    ] = False,
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """From nothing to the table and figures: metric or expert, data, training, benchmark."""
    from lagros_benchmarks.report.delivery import Outputs
    from lagros_benchmarks.run.reproduction import reproduce as run_reproduction
    from lagros_benchmarks.run.room import room_of
    from lagros_envs.registry import find_task
    from lagros_policies.backends import Backend, BackendError, running
    from lagros_policies.room import run_folder

    find_users_modules((task,))
    place = folder or Path("runs/reproduce")
    try:
        described = find_task(task)
        place = folder or run_folder(described)
        room = room_of(described)
        if not shipped:
            check_extra("lagros reproduce", "train")
        workers = Backend(backend, address)
        wanted = room.part("reproduce").for_task(task, episodes, jobs=jobs, backend=workers)
        outputs = Outputs(
            json=place / "results.json",
            latex=place / "table.tex",
            figure=place / room.reproduced,
            scene=None if room.scene is None else place / "scene.png",
        )
        check_outputs({}, folders={"--out": place})
        outputs.check(described)
        with progress_bar() as progress, running(workers, jobs):
            benchmark = (
                wanted.benchmark(None)
                if shipped
                else run_reproduction(place, wanted, progress, progress_line)
            )
    except ValueError as error:
        fail(str(error).replace("worlds=", "--episodes="))
    except (ImportError, BackendError) as error:
        fail(error, status=1)
    except KeyboardInterrupt:
        interrupted(f"; the same command goes on with what is in {place}")
    run_and_report(benchmark, outputs, place / "benchmark", keep=True)


app.command(cls=Command)(new)
app.command(cls=Command)(check)
app.command(cls=Command)(watch)
app.command(cls=Command)(export)
app.command(cls=Command)(certify)
app.command(cls=Command)(train)
app.command(cls=Command)(attack)
app.command(cls=Command)(suite)
app.command(cls=Command)(leaderboard)
app.command(cls=Command)(doctor)
app.add_typer(data, name="data")


def run_and_report(
    settings: BenchmarkSettings, outputs: Outputs, folder: Path, keep: bool = False
) -> list[Row]:
    """Run a benchmark with a progress bar, write its files, print its table and return its rows.

    The folder keeps finished work until the run is complete and its results are safe, or longer.

    Raises:
        typer.Exit: With status 1 if the run cannot begin or a file was not written, with 3 if
            episodes raised.
    """
    from lagros_benchmarks.report.delivery import print_report
    from lagros_benchmarks.report.records import summarise
    from lagros_benchmarks.run.flying import RAISED, raised_line
    from lagros_benchmarks.run.library import SetupError
    from lagros_benchmarks.run.runner import kept_in, run_benchmark
    from lagros_envs.files import remove_folders
    from lagros_policies.backends import BackendError

    kept = kept_in(folder, settings)
    if len(kept):
        progress_line(
            f"going on with {len(kept)} finished chunks of {kept.folder}; remove it to begin anew"
        )
    try:
        # What policies print is not ours, and where they go is no matter.
        with progress_bar() as progress, redirect_stdout(sys.stderr), undone():
            run = run_benchmark(settings, progress=progress, kept=kept)
        rows = summarise(run)
        with progress_bar() as progress:
            delivery = outputs.write(run, rows, progress)
    except (SetupError, BackendError) as error:
        # No weights, damaged weights, an extra that is not installed, a cluster that is not there.
        fail(error, status=1)
    except KeyboardInterrupt:
        interrupted(_where_kept(kept))
    print_report(rows)
    if delivery.problems or not (delivery.written or printing_failed() is None):
        if len(kept):
            progress_line(f"lagros: not all was written or printed{_where_kept(kept)}")
    elif not keep:
        kept.remove()
        if folder == BENCH_FOLDER:
            remove_folders((folder.parent, folder))
    delivery.tell()
    raised = raised_line((row["policy"], row["raised"], row["episodes"]) for row in rows)
    if not raised and any(row["timing_raised"] for row in rows):
        raised = f"episodes raised where Δt was measured; exit status {RAISED}"
    if raised:
        typer.echo(f"lagros: {raised}", err=True)
        raise typer.Exit(RAISED)
    return rows


def _where_kept(kept: Kept) -> str:
    if not len(kept):
        return ""
    return f"; all that is finished is kept in {kept.folder}, and the same command goes on there"
