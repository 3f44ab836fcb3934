"""`lagros certify`: for how many episodes what is guaranteed, and what that rests on."""

from __future__ import annotations

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

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
    from rich.table import Table

    from lagros_envs.task import Described
    from lagros_policies.contraction.certificate import Certificate

_MOST_EPISODES = 1_000_000
_WIDTH = 80
_CHANNELS = {"all": "all states disturbed", "rates": "the rates disturbed, not the positions"}


def certify(
    task: Annotated[str, typer.Argument(help="As for `lagros bench`.")],
    metric: Annotated[
        Path | None, file_option("Certify this contraction metric in place of flights.")
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Who flies, as for `lagros bench`; of many agents lagros or centralized.",
        ),
    ] = None,
    json: Annotated[Path | None, file_option("Write the certificate.")] = None,
    bound: Annotated[float | None, typer.Option(help="d̄; the task's own if not given.")] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            help="Episodes (worlds) that are to be guaranteed and flown; the task's own if not "
            "given, 0 for the task's metric in their place."
        ),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(
            help="Time for each search for a proof, and for a smaller bound where nothing is "
            "guaranteed, in s."
        ),
    ] = 60.0,
    largest: Annotated[
        bool,
        typer.Option("--largest", help="Claim the largest multiple of the region that is proved."),
    ] = False,
    quiet: Annotated[bool, QUIET] = False,
) -> None:
    """Print for how many episodes what is guaranteed, and which kind each claim behind it is.

    Ends with status 1 if anything that it claims does not hold.
    """
    from lagros_benchmarks.evidence.single import Question, UnservedError
    from lagros_benchmarks.run.library import SetupError
    from lagros_benchmarks.run.room import room_of
    from lagros_envs.checks import check_disturbance_bound, check_positive, check_whole
    from lagros_envs.reading import check_file
    from lagros_envs.registry import find_task

    find_users_modules([task, *([policy] if policy else [])])
    try:
        described = find_task(task)
        defaults = described.defaults
        asked = defaults.certify_policies[0] if policy is None else policy
        check_asked(described, asked)
        question = Question(
            policy=asked,
            bound=defaults.bound if bound is None else bound,
            episodes=defaults.certify_episodes if episodes is None else episodes,
            metric=metric,
            seconds=seconds,
            largest=largest,
        )
        check_positive("bound", question.bound)
        check_disturbance_bound("bound", question.bound)
        check_whole("episodes", question.episodes, 0, _MOST_EPISODES)
        check_positive("seconds", seconds)
        check_outputs({"--json": json}, {"--metric": metric})
        asks = metric is not None or largest or question.episodes == 0
        # The certificate of many agents takes all of it.
        of_metric = asks and described.most_agents == 1
        if of_metric and (policy or episodes):
            raise ValueError(
                "--metric, --largest and --episodes 0 are about a metric, which nobody flies: "
                "leave out --policy and --episodes"
            )
    except ValueError as error:
        fail(error)
    try:
        if metric is not None:
            check_file(metric)
        part = "certify_metric" if of_metric else "certify"
        with progress_bar() as tell:
            found = room_of(described).part(part)(described, question, tell)
    except UnservedError as error:
        fail(error)
    except (ValueError, OSError, RuntimeError, ImportError, SetupError) as error:
        # A metric that cannot be read, or is none, is a certificate that cannot be given.
        fail(error, status=1)
    delivery = Delivery()
    delivery.write_text(
        json, lambda: json_module.dumps(found.as_json(), indent=1, allow_nan=False) + "\n"
    )
    print_certificate(found)
    delivery.tell()
    if not found.holds:
        raise typer.Exit(1)


def check_asked(task: Described, policy: str) -> None:
    """Check that a certificate can be asked for a policy.

    Raises:
        ValueError: It is none of the task; of many agents, of which nothing is said either.
    """
    from lagros_benchmarks.run.settings import check_policy
    from lagros_envs.checks import shown

    names = task.defaults.certify_policies
    if task.most_agents == 1:
        check_policy(policy, task.name)
    elif policy not in names:
        raise ValueError(
            f"--policy: {shown(policy)} must be one of {', '.join(names)}: no statement of ours is "
            "about another"
        )


def print_certificate(found: Certificate) -> None:
    """Print a certificate, 80 columns wide: one sentence, its figures, every claim."""
    from rich.console import Console
    from rich.text import Text

    console = Console(width=_WIDTH, highlight=False)
    console.print(Text(found.headline or verdict(found), style="bold"), soft_wrap=True)
    console.print()
    console.print(Text(f"Certificate of {found.task}, policy {found.policy}, d̄ = {found.d_bar:g}"))
    if found.headline:
        console.print(Text(verdict(found)))
    console.print()
    console.print(_numbers(found))
    console.print()
    console.print(_lines(found))
    console.print(Text(f"the evidence took {found.seconds:.1f} s"))


def verdict(found: Certificate) -> str:
    """Return what a certificate comes to, in one sentence."""
    from lagros_policies.contraction.statement import Kind, at_most

    claims = found.statements
    failed = sum(not line.holds for line in claims)
    if failed and all(line.verdict != "NO" for line in claims):
        return f"Not every claim is shown: {failed} of {len(claims)} are not, and come first."
    if failed or not claims:
        return f"NOT every claim holds: {failed} of {len(claims)} do not, and come first."
    kinds = [(sum(line.kind == kind for line in claims), kind) for kind in get_args(Kind)]
    counted = ", ".join(f"{count} {kind}" for count, kind in kinds if count)
    certified, unit = found.reached, f" {found.unit}" if found.unit else ""
    limits = f"for a control at will, in the region, with {_CHANNELS[found.channels]}"
    bound = found.reach or f"Theorem 1 bounds the error {limits}, by"
    tube = "no tube is certified" if certified is None else f"{bound} {at_most(certified)}{unit}"
    observed = found.tube.observed
    flown = "nothing was flown"
    if observed is not None:
        flown = f"the largest error flown is {observed:.4g}{unit}"
    return f"Every claim holds ({counted}); {tube}; {flown}."


def _numbers(found: Certificate) -> Table:
    """Return the figures as a table."""
    from rich.table import Table
    from rich.text import Text

    from lagros_policies.contraction.statement import at_most

    table = Table(show_header=False, box=None, padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column()
    region = ", ".join(
        f"{name} {low:.4g}..{high:.4g}" for name, (low, high) in found.region.items()
    )
    if found.everywhere:
        region = f"all states; to draw from: {region}"
    tube = found.tube
    rows = {"d̄": f"{found.d_bar:g}"}
    if found.epsilon_l is not None:
        rows = {"ε_ℓ": f"{found.epsilon_l:.6g} (observed)", **rows}
    if found.coefficients is not None:
        numbers = {"χ": found.chi, "ν": found.nu, "b̄": found.b_bar}
        rows = {
            "region": region,
            "α [1/s]": f"{found.alpha:.6g}",
            **{name: at_most(value, 6) for name, value in numbers.items() if value is not None},
            **rows,
        }
    limits = _CHANNELS[found.channels] if found.coefficients is not None else "guaranteed flights"
    rows |= {
        "tube, paper": "none is published"
        if tube.paper is None
        else f"{tube.paper:g} (the success threshold; no bound)",
        "tube, certified": "none"
        if tube.certified is None
        else f"{at_most(tube.certified)} ({limits})",
        "tube, observed": "not flown" if tube.observed is None else f"{tube.observed:.4g}",
    }
    if found.coefficients is not None:
        terms = len(found.coefficients)
        rows["W̄(x)"] = f"{terms} coefficient{'s' * (terms != 1)} of {found.basis}"
    for name, value in rows.items():
        table.add_row(Text(name), Text(value))
    for heading, said in (("predicted", found.predicted), ("not proved", found.not_proved)):
        for line in said:
            table.add_row(Text(heading), Text(line))
    return table


def _lines(found: Certificate) -> Table:
    """Return the claims as a table."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1), header_style="bold")
    for heading in ("kind", "holds", "s"):
        table.add_column(heading, no_wrap=True, justify="right" if heading == "s" else "left")
    table.add_column("claim")
    # What does not hold first.
    for line in sorted(found.statements, key=lambda line: line.holds):
        holds = line.verdict
        table.add_row(line.kind, holds, f"{line.seconds:.1f}", Text(line.text))
    return table
