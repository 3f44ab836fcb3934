"""`lagros train`: the baselines that learn, by stable-baselines3 and by C3M."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagros_benchmarks.commands.extras import check_extra
from lagros_benchmarks.commands.outputs import Delivery, check_outputs
from lagros_benchmarks.commands.terminal import (
    QUIET,
    fail,
    file_option,
    interrupted,
    listed,
    progress_bar,
)

if TYPE_CHECKING:
    from lagros_benchmarks.training.c3m_run import C3mRun
    from lagros_benchmarks.training.settings import Training
    from lagros_envs.task import Described

RUNS = Path("runs/train")
_C3M, _MISSING = "c3m", "missing"
_FILLED = _C3M, "ppo", "sac"
# Files of a run, see `training.run.Place`.
KEPT = ("record.json", "weights.safetensors", "checkpoint.pt")


def train(
    task: Annotated[str, typer.Argument(help="As for `lagros bench`.")],
    algo: Annotated[
        str,
        typer.Option(
            metavar="NAME[,NAME]",
            help="One body: of ppo, sac, td3, c3m; or missing: those of c3m, ppo and sac that the "
            "task has no weights of, which are put where its policies look. Many agents: ppo.",
        ),
    ] = "ppo",
    seed: Annotated[
        str, typer.Option(metavar="N[,N]", help="Seeds; their episodes never occur in evaluation.")
    ] = "0",
    out: Annotated[
        Path, typer.Option(file_okay=False, help="Folder of the runs, TASK-ALGO/seed-N each.")
    ] = RUNS,
    segments: Annotated[
        int | None, typer.Option(help="Length of a run; each segment ends with a checkpoint.")
    ] = None,
    residual: Annotated[
        float | None,
        typer.Option(
            metavar="BETA",
            help="Learn a correction of LAG-ROS of at most so much, in units of the control.",
        ),
    ] = None,
    preset: Annotated[
        str | None, typer.Option(metavar="NAME", help="Of many agents: worlds of another preset.")
    ] = None,
    agents: Annotated[
        int | None, typer.Option(metavar="N", help="Of many agents: how many in a world.")
    ] = None,
    parallel_env: Annotated[
        bool,
        typer.Option(
            "--parallel-env",
            help="Of many agents: rows from PettingZoo's environment; the same episodes, slower.",
        ),
    ] = False,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Write events for TensorBoard beside each run.")
    ] = False,
    json: Annotated[Path | None, file_option("The learning curves of all runs.")] = None,
    figure: Annotated[Path | None, file_option("The same, drawn.")] = None,
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """Train baselines, one after the other; go on where a run was killed, skip what is complete."""
    from lagros_benchmarks.training.course import course_of
    from lagros_envs.registry import find_task

    try:
        names = listed(algo, str, "--algo")
        seeds = listed(seed, int, "--seed")
        if not names or not seeds:
            raise ValueError("--algo and --seed must not be empty")
        for option, values in (("--algo", names), ("--seed", seeds)):
            if len(set(values)) < len(values):
                raise ValueError(f"{option} names a run twice; give each once")
        described = find_task(task)
        many = course_of(described).takes_parallel
        if parallel_env and not many:
            raise ValueError(f"--parallel-env is for many agents; leave it out for {task}")
        if not many and (preset, agents) != (None, None):
            raise ValueError(
                f"--preset and --agents are for many agents; leave them out for {task}"
            )
        if residual is not None and many:
            raise ValueError(f"--residual is for one body; leave it out for {task}")
        fill = names == (_MISSING,)
        if fill:
            if many or len(seeds) > 1:
                raise ValueError(f"--algo {_MISSING} is for one body and one seed")
            names = tuple(name for name in _FILLED if not _shipped(described, name).is_file())
        if many and _C3M in names:
            raise ValueError(f"--algo {_C3M} is for one body")
        learned = {"--segments": segments, "--residual": residual, "--json": json}
        learned |= {"--figure": figure, "--tensorboard": tensorboard or None}
        for option, value in learned.items():
            if value is not None and _C3M in names:
                raise ValueError(f"{option} is for reinforcement learning; leave it out for {_C3M}")
        changes: dict[str, Any] = {} if segments is None else {"segments": segments}
        if residual is not None:
            changes["largest_correction"] = residual
        runs = [_run(described.name, name, number, changes) for number in seeds for name in names]
        if (preset, agents) != (None, None):
            runs = [run.in_worlds(preset, agents) for run in runs]  # type: ignore[union-attr]
        if figure is not None:
            from lagros_benchmarks.report.canvas import check_figure_path

            check_figure_path(figure)
        kept = [folder_of(run, out) / name for run in runs for name in KEPT]
        check_outputs(
            {**{f"--out ({path})": path for path in kept}, "--json": json, "--figure": figure}
        )
    except ValueError as error:
        fail(str(error).replace("largest_correction", "--residual"))
    options = {"--segments": segments, "--preset": preset, "--agents": agents}
    asked = "".join(f" {name} {value}" for name, value in options.items() if value is not None)
    try:
        records = [
            _train_one(run, out, asked, residual, tensorboard, parallel_env, fill) for run in runs
        ]
    except (ImportError, ValueError, OSError) as error:
        # An extra that is not installed, a folder of another run, a full disk.
        fail(error, status=1)
    except KeyboardInterrupt:
        interrupted(f"; the same command goes on with what is in {out}")
    _write_curves(records, json, figure).tell()


def _run(task: str, name: str, seed: int, changes: dict[str, Any]) -> Training | C3mRun:
    from lagros_benchmarks.training.course import default_training
    from lagros_envs.registry import find_task

    if name != _C3M:
        others = () if find_task(task).most_agents > 1 else (_C3M, _MISSING)
        return replace(default_training(task, name, others), seed=seed, **changes)
    from lagros_benchmarks.training.c3m_run import C3mRun

    return C3mRun(task).seeded(seed)


def _shipped(task: Described, name: str) -> Path:
    from lagros_policies.room import shipped_file

    return shipped_file(task, f"{name}.safetensors")


def folder_of(run: Training | C3mRun, out: Path) -> Path:
    """Return the folder of a run."""
    return out / f"{run.task}-{run.label}" / f"seed-{run.seed}"


def _train_one(
    run: Training | C3mRun,
    out: Path,
    asked: str,
    residual: float | None,
    tensorboard: bool,
    parallel_env: bool,
    fill: bool,
) -> dict[str, Any]:
    from lagros_envs.files import write_atomic

    check_extra("lagros train", "rl", "stable_baselines3")
    import torch
    from rich.console import Console

    from lagros_benchmarks.training import c3m
    from lagros_benchmarks.training.c3m_run import C3mRun
    from lagros_benchmarks.training.course import lesson_of
    from lagros_benchmarks.training.run import Place
    from lagros_benchmarks.training.run import train as train_run
    from lagros_benchmarks.training.table import final_table
    from lagros_envs.registry import find_task

    # One thread: networks this small gain nothing from more, and the sums stay reproducible.
    torch.set_num_threads(1)
    place = Place(folder_of(run, out), tensorboard)
    with progress_bar() as tell:
        # Of the error stream that is here, which prints above the bar.
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(message)s")
        if isinstance(run, C3mRun):
            command = f"lagros train {run.task} --algo {run.label} --seed {run.seed}"
            record = c3m.train(run, place, command, tell)
            name = run.label
        else:
            command = f"lagros train {run.task} --algo {run.algorithm.name} --seed {run.seed}"
            command += asked
            command += "" if residual is None else f" --residual {residual:g}"
            record = train_run(run, place, lambda: lesson_of(run, parallel_env), command, tell)
            name = run.algorithm.name if residual is None else "residual"
    try:
        table = final_table(record)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{place.record} is damaged ({type(error).__name__}: {error}); delete {place.folder}"
        ) from error
    typer.echo(f"{place.weights}, on held-out episodes:")
    Console(highlight=False).print(table)
    home = _shipped(find_task(run.task), name)
    if fill:
        home.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(home, place.weights.read_bytes())
        write_atomic(home.with_suffix(".json"), place.record.read_bytes())
        typer.echo(f"copied to {home}: they fly as the policy {name!r}")
    elif run.label == name:
        typer.echo(f"copy them to {home}, and they fly as the policy {name!r}")
    else:
        typer.echo(
            f"lagros_policies.make({name!r}, env, weights={str(place.weights)!r}) flies them"
        )
    return record


def _write_curves(
    records: Sequence[dict[str, Any]], json: Path | None, figure: Path | None
) -> Delivery:
    delivery = Delivery()
    if json is None and figure is None:
        return delivery
    from lagros_benchmarks.run.files import json_text
    from lagros_benchmarks.run.surroundings import own_command
    from lagros_benchmarks.training.curves import curves_of, draw

    curves = curves_of(records, " ".join(own_command()))
    delivery.write_text(json, lambda: json_text(curves))
    delivery.write(figure, lambda path: draw(curves, path))
    return delivery
