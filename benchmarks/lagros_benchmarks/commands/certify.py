"""`lagros certify`: what is proved, calibrated and observed of a task, in one certificate.

Only the standard library, typer and `terminal` are imported here; the command imports the rest.
"""

from __future__ import annotations

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from lagros_benchmarks.commands.outputs import Delivery, check_outputs
from lagros_benchmarks.commands.terminal import fail

if TYPE_CHECKING:
    from rich.table import Table

    from lagros_policies.contraction.certificate import Certificate

# The policies that Theorem 1 speaks of: a network that imitates u*, and u* itself.
POLICIES = {"cartpole": ("lagros", "tube-mpc"), "spacecraft": ("lagros", "centralized")}
BOUNDS = {"cartpole": 0.75, "spacecraft": 0.4}
_EPISODES = {"cartpole": 400, "spacecraft": 20}
_MOST_EPISODES = 1_000_000
_WIDTH = 80
# alpha of the spacecraft's policies, in the plane and of the heading [1/s].
_PLANE_RATE, _TURNING_RATE = 2.0, 0.3
# Episodes that a bound of probability 0.95 needs.
_LEAST = 19
_CHANNELS = {"all": "all states disturbed", "rates": "the rates disturbed, not the positions"}


def certify(
    task: Annotated[str, typer.Argument(help="cartpole or spacecraft.")],
    metric: Annotated[
        Path | None,
        typer.Option(metavar="FILE", dir_okay=False, help="A metric of your own; ours if not."),
    ] = None,
    policy: Annotated[
        str,
        typer.Option(help="lagros; or u* itself: cartpole tube-mpc, spacecraft centralized."),
    ] = "lagros",
    json: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="Write the certificate.")
    ] = None,
    bound: Annotated[float | None, typer.Option(help="d̄; cartpole 0.75, spacecraft 0.4.")] = None,
    episodes: Annotated[
        int | None,
        typer.Option(help="Episodes (worlds) flown; cartpole 400, spacecraft 20; 0 for none."),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Time for each search for a proof, in s.")] = 60.0,
    largest: Annotated[
        bool,
        typer.Option(
            "--largest", help="Cart-pole: claim the largest multiple of the region that is proved."
        ),
    ] = False,
) -> None:
    """Print one certificate: region, α, χ, tube, and which kind each claim is.

    Ends with status 1 if anything that it claims does not hold.
    """
    from lagros_benchmarks.run.settings import check_task
    from lagros_envs.checks import check_disturbance_bound, check_positive, check_whole, shown
    from lagros_envs.reading import check_file

    try:
        check_task(task)
        if policy not in POLICIES[task]:
            raise ValueError(
                f"--policy: {shown(policy)} must be one of {', '.join(POLICIES[task])}: the "
                "theorems speak of u* and of what imitates it"
            )
        if bound is not None:
            check_positive("bound", bound)
            check_disturbance_bound("bound", bound)
        if episodes is not None:
            check_whole("episodes", episodes, 0, _MOST_EPISODES)
        check_positive("seconds", seconds)
        if largest and task != "cartpole":
            raise ValueError("--largest: the spacecraft's proof is for all states already")
        check_outputs({"--json": json}, {"--metric": metric})
    except ValueError as error:
        fail(error)
    level = BOUNDS[task] if bound is None else bound
    try:
        if metric is not None:
            check_file(metric)
        if task == "cartpole":
            found = certify_cartpole(metric, policy, level, episodes, seconds, largest)
        else:
            found = certify_spacecraft(metric, policy, level, episodes, seconds)
    except (ValueError, OSError, RuntimeError) as error:
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


def certify_cartpole(
    metric_file: Path | None = None,
    policy: str = "lagros",
    bound: float = BOUNDS["cartpole"],
    episodes: int | None = None,
    seconds: float = 60.0,
    largest: bool = False,
) -> Certificate:
    """Return the cart-pole's certificate.

    Args:
        metric_file: A metric written by `save_metric`; the shipped one if None.
        policy: "lagros", with its recorded learning error, or "tube-mpc", which is u*.
        bound: d_bar, in units of the state per second.
        episodes: Episodes of each kind of disturbance; 400 if None, 0 for none.
        seconds: Time for each search for a proof [s].
        largest: Whether the largest multiple of the region is claimed on which all can be proved.

    Raises:
        ValueError: The file is no metric.
        FileNotFoundError: There is no such file.
    """
    from lagros_benchmarks.evidence import evidence
    from lagros_benchmarks.tasks.cartpole.certified_box import largest_proofs, load_cartpole_metric
    from lagros_envs.tasks.cartpole.task import CartPoleSettings
    from lagros_policies.tasks.cartpole.certificate import (
        CartPoleQuestion,
        cartpole_certificate,
    )

    task = CartPoleSettings()
    file, large = evidence.metric_to_prove(metric_file)
    metric = load_cartpole_metric(file)
    box, proofs = (
        largest_proofs(metric, seconds)
        if largest
        else evidence.cartpole_proofs(metric, seconds, large)
    )
    learned = policy == "lagros"
    error = evidence.recorded_error("cartpole", policy) if learned else 0.0
    lines = [evidence.recorded_statement("cartpole", policy, "N")] if learned else []
    count = _EPISODES["cartpole"] if episodes is None else episodes
    flights = evidence.fly_cartpole(policy, bound, count) if count else None
    met: float | None = None
    if flights is not None:
        # The network imitates the u* of the task's metric, which may be another.
        met, line = evidence.met_error(flights, task.system, metric, box)
        lines.append(line)
    question = CartPoleQuestion(
        box=box,
        disturbance_bound=bound,
        learning_error=error,
        paper_radius=task.tube.steady_radius,
        policy=policy,
        most_seconds=seconds,
        control_error=met,
    )
    tubes = evidence.cartpole_tubes(task.system, bound)
    held = evidence.cartpole_held_tubes(task.system, bound)
    found = cartpole_certificate(task.system, metric, question, proofs, tubes, held)
    # Nothing is held against a metric that is none.
    if flights is None or found.tube.certified is None:
        return found.with_evidence(lines)
    line, widest = evidence.tube_line(flights, policy, bound)
    calibrated = evidence.calibrated_cartpole(policy, bound, count) if count >= _LEAST else []
    return found.with_evidence([*lines, line, *calibrated], widest)


def certify_spacecraft(
    metric_file: Path | None = None,
    policy: str = "lagros",
    bound: float = BOUNDS["spacecraft"],
    worlds: int | None = None,
    seconds: float = 60.0,
) -> Certificate:
    """Return the spacecraft's certificate.

    Args:
        metric_file: A metric of the axes; that of the policies if None.
        policy: "lagros", with its recorded learning error, or "centralized", which is u*.
        bound: d_bar, in units of the state per second.
        worlds: Worlds to fly; 20 if None, 0 for none.
        seconds: Not needed: the proofs are exact and take milliseconds.

    Raises:
        ValueError: The file is no such metric.
        FileNotFoundError: There is no such file.
    """
    from lagros_benchmarks.evidence import evidence
    from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
    from lagros_policies.tasks.spacecraft.certificate import spacecraft_certificate

    task = SpacecraftSettings()
    period = task.control_period
    plane = evidence.load_axis_metric(metric_file, _PLANE_RATE, period)
    learned = policy == "lagros"
    found = spacecraft_certificate(
        plane,
        evidence.load_axis_metric(None, _TURNING_RATE, period),
        task.system,
        disturbance_bound=bound,
        learning_error=evidence.recorded_error("spacecraft", policy) if learned else 0.0,
        paper_radius=task.tube.steady_radius,
        thrust=task.thrust_scale,
        policy=policy,
    )
    if learned:
        found = found.with_evidence([evidence.recorded_statement("spacecraft", policy, "m/s^2")])
    count = _EPISODES["spacecraft"] if worlds is None else worlds
    if count == 0 or metric_file is not None:
        return found
    lines, largest = evidence.fly_spacecraft(found, policy, bound, count)
    if count >= _LEAST:
        lines.extend(evidence.calibrated_spacecraft(bound, count))
    return found.with_evidence(lines, largest)


def print_certificate(found: Certificate) -> None:
    """Print a certificate, 80 columns wide: what it comes to, its figures, every claim."""
    from rich.console import Console
    from rich.text import Text

    console = Console(width=_WIDTH, highlight=False)
    console.print(Text(f"Certificate of {found.task}, policy {found.policy}, d̄ = {found.d_bar:g}"))
    console.print(Text(verdict(found), style="bold"))
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
    if failed or not claims:
        return f"NOT every claim holds: {failed} of {len(claims)} do not, and come first."
    kinds = [(sum(line.kind == kind for line in claims), kind) for kind in get_args(Kind)]
    counted = ", ".join(f"{count} {kind}" for count, kind in kinds if count)
    if found.task == "cartpole":
        certified, unit = found.tube.certified, ""
        limits = f"for a control at will, in the region, with {_CHANNELS[found.channels]}"
        bound = f"Theorem 1 bounds the error {limits}, by"
    else:
        certified, unit = found.details["tubes"]["position_held_without_learning_error"], " m"
        bound = "u*, held for 0.1 s and without learning error, is proved to stay on its plan to"
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
    if found.task == "spacecraft":
        region = f"all states; to draw from: {region}"
    tube, terms = found.tube, len(found.coefficients)
    rows = {
        "region": region,
        "α [1/s]": f"{found.alpha:.6g}",
        "χ": at_most(found.chi, 6),
        "ν": at_most(found.nu, 6),
        "b̄": at_most(found.b_bar, 6),
        "ε_ℓ": f"{found.epsilon_l:.6g} (observed)",
        "d̄": f"{found.d_bar:g}",
        "tube, paper": f"{tube.paper:g} (the success threshold; no bound)",
        "tube, certified": "none"
        if tube.certified is None
        else f"{at_most(tube.certified)} ({_CHANNELS[found.channels]})",
        "tube, observed": "not flown" if tube.observed is None else f"{tube.observed:.4g}",
        "W̄(x)": f"{terms} coefficient{'s' * (terms != 1)} of {found.basis}",
    }
    for name, value in rows.items():
        table.add_row(Text(name), Text(value))
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
        holds = "yes" if line.holds else "NO"
        table.add_row(line.kind, holds, f"{line.seconds:.1f}", Text(line.text))
    return table
