"""Which metric of the cart-pole is certified, and the largest box on which it can be."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lagros_policies.contraction import Metric, load_metric
from lagros_policies.contraction.statement import Statement
from lagros_policies.proof.box import ProofBox
from lagros_policies.tasks.cartpole.proof import CartPoleProof, prove_cartpole
from lagros_policies.tasks.cartpole.proof_program import ProvedDesignSettings

_STATES = 4
# Multiples are tried in hundredths, whose bounds print as what they are; the largest of them.
_HUNDREDTHS = 100
_LARGEST = 150


def load_cartpole_metric(path: Path | None) -> Metric:
    """Read a metric of the cart-pole.

    Args:
        path: A file of `save_metric`; None for the one that the policies use.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no metric, or none of four states, or not symmetric to the last bit
            (the proofs use that W_bar is symmetric), or of a degree that nothing was designed for.
    """
    metric = load_metric(path, _STATES)
    coefficients = metric.coefficients
    if not np.array_equal(coefficients, np.swapaxes(coefficients, 1, 2)):
        raise ValueError(f"{path}: W_bar must be symmetric to the last bit: average it with W_bar'")
    return metric


def prove_multiple(
    metric: Metric, factor: float, most_seconds: float
) -> tuple[ProofBox, CartPoleProof, CartPoleProof]:
    """Prove (14) and the condition over a hold on a multiple of the boxes of the shipped metric.

    Args:
        metric: The metric.
        factor: The multiple; the share of the lean stays.
        most_seconds: Processor time of each search [s].

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

    Args:
        metric: The metric.
        most_seconds: Processor time of each search [s].

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


def merged(*proofs: CartPoleProof) -> list[Statement]:
    """Return the statements of proofs, each text once."""
    return list({line.text: line for proof in proofs for line in proof.statements}.values())


def _proved(trial: tuple[ProofBox, CartPoleProof, CartPoleProof]) -> bool:
    """Return whether the conditions were proved; the chi of the metric's file is not asked for."""
    _, first, second = trial
    held = second.statements[-1].holds
    bounds = first.bounds is not None
    return first.contraction.proved and second.contraction.proved and held and bounds
