"""The cart-pole's certificate: its proofs, its tubes, and what its flights add to them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import lagros_policies
from lagros_benchmarks.evidence.records import recorded
from lagros_benchmarks.evidence.single import (
    Question,
    SingleFlights,
    calibrated_lines,
    fly_kinds,
    met_error,
    tube_line,
)
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY, CartPole
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import Metric, load_metric
from lagros_policies.contraction.certificate import Certificate
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.held_design import HeldDesign, HeldTube, design_held_contained
from lagros_policies.contraction.statement import Statement
from lagros_policies.contraction.tube_design import (
    ConstantTube,
    TubeDesign,
    design_contained,
)
from lagros_policies.proof.condition import Proof
from lagros_policies.room import shipped_file
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.certificate import CartPoleQuestion, cartpole_certificate
from lagros_policies.tasks.cartpole.plans import PlanBox
from lagros_policies.tasks.cartpole.proof import prove_cartpole
from lagros_policies.tasks.cartpole.proof_program import ProvedDesignSettings

Kind = TypeVar("Kind")

# The bound that the paper's radius of 3.15 belongs to, by the formula it is computed with.
PAPER_BOUND = 0.075
_ANGLE = (0.0, 1.0, 0.0, 0.0)
# Every plan of the task is in this box from 0.8 s on.
_SETTLED = PlanBox(angle=0.4, velocity=7.5, angular_rate=1.2, force=3.0)
_UPRIGHT = PlanBox(angle=0.05, velocity=0.5, angular_rate=0.1, force=0.5)
PROVED_FILE = "cartpole_proved_metric.json"
# What is claimed of a metric that was not designed to be proved on a large box.
SMALL_BOX = ProofBox(0.1, 0.5, 0.5, 0.5, angle_error=0.05, angular_rate_error=0.2)
_STATES = 4
# Multiples are tried in hundredths, whose bounds print as what they are; the largest of them.
_HUNDREDTHS = 100
_LARGEST = 150


def certify(task: CartPoleSettings, question: Question) -> Certificate:
    """Return the cart-pole's certificate; of "lagros" with its recorded learning error.

    Raises:
        ValueError: The file is no metric.
        FileNotFoundError: There is no such file.
    """
    file, large = metric_to_prove(question.metric)
    metric = load_cartpole_metric(file)
    box, proofs = (
        largest_proofs(metric, question.seconds)
        if question.largest
        else cartpole_proofs(metric, question.seconds, large)
    )
    policy, bound = question.policy, question.bound
    error, lines = recorded(task, policy, task.control_unit)
    flights = fly_kinds(task, policy, bound, question.episodes) if question.episodes else None
    met: float | None = None
    if flights is not None:
        # The network imitates the u* of the task's metric, which may be another.
        met, line = met_error(task, flights, metric, instants_in(box, flights))
        lines.append(line)
    asked = CartPoleQuestion(
        box=box,
        disturbance_bound=bound,
        learning_error=error,
        paper_radius=task.tube.steady_radius,
        policy=policy,
        most_seconds=question.seconds,
        control_error=met,
    )
    tubes = cartpole_tubes(task.system, bound)
    held = cartpole_held_tubes(task.system, bound)
    found = cartpole_certificate(task.system, metric, asked, proofs, tubes, held)
    # Nothing is held against a metric that is none.
    if flights is None or found.tube.certified is None:
        return found.with_evidence(lines)
    line, widest = tube_line(flights, policy, bound)
    return found.with_evidence([*lines, line, *calibrated_lines(task, question)], widest)


def instants_in(box: ProofBox, flights: SingleFlights) -> np.ndarray:
    """Return which instants of flights lie in a box of x, x_d and u_d, shape (e, steps)."""
    state, nominal = flights.states[:, :-1], flights.plans[:, :-1]
    inside = np.abs(flights.nominal[..., 0]) <= box.force
    limits = {ANGLE: box.angle, VELOCITY: box.velocity, ANGULAR_RATE: box.angular_rate}
    for place, limit in limits.items():
        inside &= (np.abs(state[..., place]) <= limit) & (np.abs(nominal[..., place]) <= limit)
    error = np.abs(state - nominal)
    inside &= error[..., ANGLE] <= box.angle_error
    inside &= error[..., ANGULAR_RATE] <= box.angular_rate_error
    return inside


def cartpole_tubes(system: CartPole, bound: float) -> list[ConstantTube]:
    """Design the ellipsoids of the certificate: near the upright, and for all settled plans.

    The first is for the `bound` d_bar, the second for `PAPER_BOUND`. Where one is too large for a
    tube to keep itself in its box, there is none, and no claim.
    """
    wanted = [
        (
            _UPRIGHT,
            TubeDesign(
                rate=0.4,
                output=_ANGLE,
                disturbance_bound=bound,
                control_penalty=1e-3,
                floor=0.01,
                margin=0.03,
            ),
        ),
        (_SETTLED, TubeDesign(rate=0.6, output=_ANGLE, disturbance_bound=PAPER_BOUND)),
    ]
    return _contained(design_contained, system, wanted)


def cartpole_held_tubes(system: CartPole, bound: float) -> list[HeldTube]:
    """Design the tubes of a held control: near the upright, and for all settled plans.

    The first is for d_bar = `bound`, held 20 ms, the second for `PAPER_BOUND`, held the 0.1 s
    of the task. Where there is none that keeps itself in its box, there is no claim.
    """
    wanted = [
        (_UPRIGHT, HeldDesign(0.02, 0.4, _ANGLE, disturbance_bound=bound, degree=3)),
        (_SETTLED, HeldDesign(0.1, 0.5, _ANGLE, disturbance_bound=PAPER_BOUND, degree=5)),
    ]
    return _contained(design_held_contained, system, wanted)


def _contained(
    design: Callable[..., Kind], system: CartPole, wanted: Sequence[tuple[PlanBox, Any]]
) -> list[Kind]:
    """Return the tubes that can be designed."""
    tubes = []
    for plan, settings in wanted:
        with suppress(InfeasibleError, RuntimeError):
            tubes.append(design(system, plan, settings))
    return tubes


def metric_to_prove(path: Path | None) -> tuple[Path | None, bool]:
    """Return which metric to load, a user's or ours, and whether the large box is claimed."""
    folder = Path(lagros_policies.__file__).parent / "pretrained"
    ours = folder / PROVED_FILE
    if path is not None:
        return path, ours.exists()
    return (ours, True) if ours.exists() else (None, False)


def cartpole_proofs(
    metric: Metric, most_seconds: float, large: bool
) -> tuple[ProofBox, Sequence[Statement] | None]:
    """Prove (14) and the condition over a hold on the boxes of the shipped metric.

    Returns:
        The box of x, x_d and u_d, and the statements. Where the large boxes are not claimed, these
        are the small one and None: its proof is left to the certificate.
    """
    if not large:
        return SMALL_BOX, None
    box, first, second = prove_multiple(metric, 1.0, most_seconds)
    return box, merged(first, second)


def load_cartpole_metric(path: Path | None) -> Metric:
    """Read a metric of the cart-pole from a file, or the one that the policies use.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no metric, or none of four states, or not symmetric to the last bit
            (the proofs use that W_bar is symmetric), or of a degree that nothing was designed for.
    """
    metric = load_metric(path or shipped_file(CartPoleSettings(), "metric.json"), _STATES)
    coefficients = metric.coefficients
    if not np.array_equal(coefficients, np.swapaxes(coefficients, 1, 2)):
        raise ValueError(f"{path}: W_bar must be symmetric to the last bit: average it with W_bar'")
    return metric


def prove_multiple(
    metric: Metric, factor: float, most_seconds: float
) -> tuple[ProofBox, Proof, Proof]:
    """Prove (14) and the condition over a hold on a multiple of the boxes of the shipped metric.

    The share of the lean stays; each search takes so much processor time [s] at most.

    Returns:
        The box of x, x_d and u_d, the proof on it, and that for forces that lean with the pole.
    """
    wanted = ProvedDesignSettings()
    box, leaning = wanted.box.scaled(factor), wanted.leaning.scaled(factor)
    first = prove_cartpole(metric, box, most_seconds=most_seconds)
    second = prove_cartpole(
        metric, leaning, held_box=leaning, period=wanted.period, most_seconds=most_seconds
    )
    return box, first, second


def largest_proofs(metric: Metric, most_seconds: float) -> tuple[ProofBox, Sequence[Statement]]:
    """Find the largest multiple of the boxes of the shipped metric on which all can be proved.

    Returns:
        The box of x, x_d and u_d and what was proved on it, and which multiple it is; the whole
        box, with what failed there, if no multiple was found.
    """
    begun = time.monotonic()
    best = prove_multiple(metric, 1.0, most_seconds)
    low, high = (_HUNDREDTHS, _LARGEST + 1) if _proved(best) else (0, _HUNDREDTHS)
    while high - low > 1:
        middle = (low + high) // 2
        trial = prove_multiple(metric, middle / _HUNDREDTHS, most_seconds)
        if _proved(trial):
            best, low = trial, middle
        else:
            high = middle
    box, first, second = best
    # The chi of the metric's file is for the box that it was designed on.
    lines = [first.statements[0], second.statements[0], second.statements[-1]]
    text = f"the box is {low / _HUNDREDTHS:g} times the one that is asked for"
    if not low:
        text = f"some multiple from {1 / _HUNDREDTHS:g} of the box that is asked for is proved"
    elif low < _LARGEST:
        text += f"; {high / _HUNDREDTHS:g} times was not proved"
    # The statements of the last proof carry their own time.
    spent = time.monotonic() - begun - sum(line.seconds for line in lines)
    return box, (*lines, Statement(text, "proved", low > 0, max(spent, 0.0)))


def merged(*proofs: Proof) -> list[Statement]:
    """Return the statements of proofs, each text once."""
    return list({line.text: line for proof in proofs for line in proof.statements}.values())


def _proved(trial: tuple[ProofBox, Proof, Proof]) -> bool:
    """Return whether the conditions were proved; the chi of the metric's file is not asked for."""
    _, first, second = trial
    held = second.statements[-1].holds
    bounds = first.bounds is not None
    return first.contraction.proved and second.contraction.proved and held and bounds
