"""The certificate of a metric of the cart-pole: its proofs on boxes of its own."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import lagros_policies
from lagros_benchmarks.evidence.metric import IDEAL
from lagros_benchmarks.evidence.single import Question
from lagros_benchmarks.run.workers import Progress, untold
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import Metric, load_metric
from lagros_policies.contraction.certificate import Certificate
from lagros_policies.contraction.statement import Statement
from lagros_policies.proof.condition import Proof
from lagros_policies.room import shipped_file
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.certificate import CartPoleQuestion, cartpole_certificate
from lagros_policies.tasks.cartpole.proof import prove_cartpole
from lagros_policies.tasks.cartpole.proof_program import ProvedDesignSettings

PROVED_FILE = "cartpole_proved_metric.json"
# What is claimed of a metric that was not designed to be proved on a large box.
SMALL_BOX = ProofBox(0.1, 0.5, 0.5, 0.5, angle_error=0.05, angular_rate_error=0.2)
_STATES = 4
# Multiples are tried in hundredths, whose bounds print as what they are; the largest of them.
_HUNDREDTHS = 100
_LARGEST = 150


def certify_metric(
    task: CartPoleSettings, question: Question, tell: Progress = untold
) -> Certificate:
    """Return the certificate of a metric of the cart-pole: a user's, or the one that is proved.

    Raises:
        ValueError: The file is no metric.
        FileNotFoundError: There is no such file.
    """
    file, large = metric_to_prove(question.metric)
    metric = load_cartpole_metric(file)
    tell("proof", 0, 1)
    box, proofs = (
        largest_proofs(metric, question.seconds)
        if question.largest
        else cartpole_proofs(metric, question.seconds, large)
    )
    asked = CartPoleQuestion(
        box=box,
        disturbance_bound=question.bound,
        learning_error=0.0,
        paper_radius=task.tube.steady_radius,
        policy=IDEAL,
        most_seconds=question.seconds,
    )
    tell("proof", 1, 1)
    return cartpole_certificate(task.system, metric, asked, proofs)


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
