"""`lagros attack`: search the bounded disturbance that a policy stands worst."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagros_benchmarks.commands.extras import check_extra
from lagros_benchmarks.commands.outputs import Delivery, check_outputs, policy_files
from lagros_benchmarks.commands.terminal import (
    BOUND,
    QUIET,
    fail,
    file_option,
    find_users_modules,
    options_given,
    progress_bar,
    refuse_options,
    task_in_preset,
)

if TYPE_CHECKING:
    from lagros_benchmarks.worst_case.attack import AttackSettings
    from lagros_benchmarks.worst_case.replay import Outcome


def attack(
    task: Annotated[str, typer.Argument(help="As for `lagros bench`.")],
    policy: Annotated[
        str, typer.Option(metavar="NAME", help="A policy of the task, as for `lagros bench`.")
    ] = "lagros",
    goal: Annotated[
        str | None,
        typer.Option(
            help="What to break: tube (||x - x_d|| over its radius), success, clearance (a fall, a "
            "collision); of one body also error, the largest ||x - x_d||; of gym:ID return (the "
            "least) or termination (the earliest). success if not given, of gym:ID return."
        ),
    ] = None,
    bound: Annotated[float | None, BOUND] = None,
    episodes: Annotated[
        int | None,
        typer.Option(help="Episodes, each with its own worst case; the task's own if not given."),
    ] = None,
    budget: Annotated[
        int | None,
        typer.Option(metavar="N", help="Flights per episode; the task's own if not given."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of episodes and search.")] = 0,
    method: Annotated[
        str, typer.Option(help="Of random, cross-entropy, cma, gradient, hybrid; for one body.")
    ] = "hybrid",
    safety_filter: Annotated[
        bool, typer.Option("--safety-filter", help="Put the safety filter on the policy.")
    ] = False,
    proved_filter: Annotated[
        bool, typer.Option("--proved-filter", help="Put the filter with a proof on it.")
    ] = False,
    agents: Annotated[
        int | None, typer.Option(help="Agents in a world; the task's own if not given.")
    ] = None,
    preset: Annotated[str | None, typer.Option(help="Kind of worlds of agents; {presets}.")] = None,
    json: Annotated[Path | None, file_option("All figures, as JSON.")] = None,
    npz: Annotated[Path | None, file_option("The sequences found, to replay.")] = None,
    replay: Annotated[
        Path | None,
        file_option("Fly the sequences of such a file again, and fail where a figure differs."),
    ] = None,
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """Search the worst bounded disturbance, fly it, and hold the certificate against it.

    Exit status 3: everything is written, and the policy raised in some episodes, which are broken.
    """
    from lagros_benchmarks.run.library import SetupError
    from lagros_benchmarks.worst_case.attack import AttackSettings

    find_users_modules([policy])
    try:
        if replay is not None:
            refuse_options(
                options_given(but=("--replay", "--policy", "--quiet")),
                "--replay flies what the file says",
            )
            _replay(task, policy, replay)
            return
        if method == "cma":
            check_extra("--method cma", "attack")
        task, preset = task_in_preset(task, preset)
        settings = AttackSettings.for_task(
            task,
            method,
            budget,
            policy=policy,
            goal=goal,
            bound=bound,
            episodes=episodes,
            seed=seed,
            safety_filter=safety_filter,
            proved_filter=proved_filter,
            agents=agents,
            preset=preset,
        )
        check_outputs({"--json": json, "--npz": npz}, policy_files([policy]))
        _search(settings, json, npz)
    except (ValueError, OSError) as error:
        fail(error)
    except (ImportError, SetupError) as error:
        fail(error, status=1)


def _search(settings: AttackSettings, json: Path | None, npz: Path | None) -> None:
    from lagros_benchmarks.run.files import json_text
    from lagros_benchmarks.worst_case.attack import run_attack
    from lagros_benchmarks.worst_case.replay import save_worst_cases

    with progress_bar() as tell:
        found = run_attack(settings, tell)
    delivery = Delivery()
    command = " ".join(["lagros", *sys.argv[1:]])
    record = {"command": command, "verdict": verdict(found.row), **found.row}
    delivery.write_text(json, lambda: json_text(record))
    delivery.write(npz, lambda path: save_worst_cases(found.cases, path))
    for line in summary(found.row):
        typer.echo(line)
    delivery.tell()
    if found.row["errors"]:
        from lagros_benchmarks.run.flying import RAISED, raised_line

        line = raised_line([(settings.policy, found.row["errors"], found.row["episodes"])])
        typer.echo(f"lagros: {line}", err=True)
        raise typer.Exit(RAISED)


def _replay(task: str, policy: str, path: Path) -> None:
    from lagros_benchmarks.worst_case.attack import fly_again
    from lagros_benchmarks.worst_case.replay import load_worst_cases
    from lagros_envs.registry import find_any

    described = find_any(task)
    try:
        cases = load_worst_cases(path)
        _check_command(cases.command, described.name, policy)
        flown = fly_again(cases)
    except FileNotFoundError as error:
        raise ValueError(f"--replay: {error}; --npz of an earlier attack writes one") from None
    except ValueError as error:
        text = str(error)
        raise ValueError(f"--replay: {text if str(path) in text else f'{path}: {text}'}") from None
    differing = 0
    for before, now in zip(cases.outcomes, flown, strict=True):
        same = before == now
        differing += not same
        typer.echo(f"{_line(now)}: {'as stored' if same else f'differs, stored {_line(before)}'}")
    if differing:
        typer.echo(f"lagros: {differing} of {len(cases.outcomes)} differ", err=True)
        raise typer.Exit(1)


def _check_command(command: Mapping[str, Any], task: str, policy: str) -> None:
    """Check what a file says that it was made with against what was asked for.

    Raises:
        ValueError: It is of another task, or of a policy that is code and was not asked for.
    """
    from lagros_policies.naming import is_code

    if command.get("task") != task:
        raise ValueError(f"it is of the task {command.get('task')!r}, not {task!r}")
    its = str(command.get("policy"))
    if is_code(its) and its != policy:
        raise ValueError(
            f"it was found against {its!r}, which is code of somebody's: name it, too, with "
            f"--policy {its}, if you trust it"
        )


def _line(outcome: Outcome) -> str:
    broken = "broken" if outcome.broken else "held"
    return f"seed {outcome.seed} {broken} score {outcome.score!r}"


def verdict(row: Mapping[str, Any]) -> str:
    """Return what an attack came to, in one sentence."""
    worn = "+filter" if row["safety_filter"] else ""
    if row.get("proved_filter"):
        worn = "+proved"
    count, name = row["episodes"], f"{row['policy']}{worn}"
    under = f"d̄ = {row['bound']:g}"
    if row["broken_rate"] is None:
        return (
            f"The least return of {name} in {count} episodes is {-row['score_worst']:.4g} under a "
            f"disturbance within {under} that was searched for, and "
            f"{-row['random_score_worst']:.4g} under a random one; the environment names no "
            "return that counts as broken."
        )
    found, random = (round(count * row[key]) for key in ("broken_rate", "random_broken_rate"))
    tried = f"{row['flights_per_episode']} flights for each"
    if not found:
        beside = f", but in {random} by a random disturbance" if random else ""
        return (
            f"{name} was not broken in any of {count} episodes by the search within {under}, "
            f"{tried}{beside}: observed, and no proof."
        )
    return (
        f"{name} is broken in {found} of {count} episodes by a disturbance within {under} "
        f"({tried}), and in {random} by a random one."
    )


def summary(row: dict[str, Any]) -> list[str]:
    """Return what an attack came to, in a sentence and a few lines."""
    count = row["episodes"]
    lines = [
        verdict(row),
        f"{row['task']}, goal {row['goal']}, searched for {row['search_seconds']:.0f} s",
        f"worst score {row['score_worst']:.4g}, median {row['score_median']:.4g} "
        f"(random: worst {row['random_score_worst']:.4g})",
    ]
    if row.get("max_tracking_error_max") is not None:
        each = row["max_tracking_error_per_bound"]
        lines.append(f"observed tube {row['max_tracking_error_max']:.3g}, {each:.3g} per unit of d̄")
        if row.get("in_region_rate") is not None:
            left = round((1.0 - row["in_region_rate"]) * count)
            lines[-1] += f"; {left} of {count} flights left the region of the metric"
    if row.get("share_of_certified_max") is not None:
        lines.append(
            f"observed position error {row['max_position_error_max']:.3g} m, "
            f"{100 * row['share_of_certified_max']:.3g} % of the certified margin"
        )
    return lines
