"""Proof of the contraction condition on continuous sets, by interval arithmetic and bisection.

Theorem 2 asks, with A = A(x, x_d, u_d) of `state_dependent_coefficient`, for

    -dW_bar/dt + 2 sym(A W_bar) - 2 nu B(x) B(x)' + 2 alpha W_bar < 0,                       (*)

with W_bar at x, or at x_d. A is the mean of J(y, u_d) = d(f + B u_d)/dx(y) over the segment from
x_d to x, and (*) is affine in A. So it is enough, and this is what is proved, that for every x and
x_d of a box, every point y of the box that differs from them by no more than the errors allowed,
and every u_d

    -dW_bar/dt + 2 sym(J(y, u_d) W_bar) - 2 nu B(x) B(x)' + 2 alpha W_bar < 0.              (**)

The box is convex, so y runs over the whole segment and (*) follows by averaging. With errors of
zero y is x and (**) is the differential condition (of infinitesimal displacements); for a W_bar
that depends on x that alone does not imply (*).

Proved is the condition on the derivative, for the coefficients of the motion as the doubles that
the code computes with. It says nothing of the hold of the control between its instants (for that
there is `prove_hold`), nor of the term by which a disturbance moves W_bar.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import System
from lagros_policies.contraction.condition import contraction_residual
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.regions import BoxRegion, Samples
from lagros_policies.contraction.statement import Statement, at_most
from lagros_policies.contraction.systems import check_polynomial, check_sizes
from lagros_policies.proof.bounds import ProvedBounds, prove_bounds
from lagros_policies.proof.cells import search
from lagros_policies.proof.families import (
    BoxCondition,
    Violation,
    rate_matrices,
)
from lagros_policies.proof.hold import HoldProof, prove_hold
from lagros_policies.proof.sets import Provable, triples

__all__ = [
    "ContractionProof",
    "HoldProof",
    "Proof",
    "Violation",
    "largest_proved",
    "prove",
    "prove_contraction",
    "prove_hold",
]

# Far above the rounding of a residual [1/s].
_SURELY = 1e-6
# Cells of one pass: enough to hide NumPy's cost per call, few enough to stay in the cache.
_BATCH = 100


@dataclass(frozen=True)
class ContractionProof:
    """What the search for a proof came to.

    Attributes:
        box: The set asked about.
        contraction_rate: alpha [1/s].
        proved: Whether (**), and so (*), holds on the whole set.
        boxes: Cells examined.
        seconds: Time taken [s].
        violation: A point where the condition fails, or None.
        undecided: One cell left undecided, ends (2, c) of the coordinates that matter; None if
            proved or violated.
        refuted: Whether (*) itself fails, there or where x = x_d is one of its points: (**) asks
            for more where W_bar or B depends on x.
    """

    box: BoxRegion | Provable
    contraction_rate: float
    proved: bool
    boxes: int
    seconds: float
    violation: Violation | None = None
    undecided: FloatArray | None = None
    refuted: bool = False


@dataclass(frozen=True)
class Proof:
    """The proofs behind statements.

    Attributes:
        statements: What was claimed, and whether it was proved.
        contraction: Theorem 2's condition on the box.
        bounds: Bounds of W_bar and B on the box; None if W_bar is not positive definite on it.
        held: The condition over a hold; None if it was not asked for.
    """

    statements: list[Statement]
    contraction: ContractionProof
    bounds: ProvedBounds | None
    held: HoldProof | None = None


def prove_contraction(
    system: System,
    metric: Metric,
    box: BoxRegion | Provable,
    contraction_rate: float | None = None,
    *,
    most_boxes: int = 1_000_000,
    most_seconds: float = 60.0,
) -> ContractionProof:
    """Prove the condition of Theorem 2, equation (14), on a box, or find where it fails.

    Args:
        system: The system.
        metric: The metric; one of x only where no control moves it.
        box: Where to prove it.
        contraction_rate: alpha [1/s]; None for that of the metric.
        most_boxes: Cells after which the search gives up.
        most_seconds: Processor time after which it gives up [s].

    Returns:
        The proof, or why there is none.

    Raises:
        TypeError: The metric is no polynomial, or the box of another system.
        ValueError: Metric, box and system do not fit each other, a control moves the metric, or
            what matters is not bounded.
    """
    check_polynomial(metric, "prove_contraction")
    rate = metric.contraction_rate if contraction_rate is None else contraction_rate
    start = time.monotonic()
    where = triples(box, system, metric.point)
    check_sizes(system, scaling=(metric.scaling, (system.state_dim,)))
    condition = BoxCondition(where, rate_matrices(system, metric, rate))
    found = search(condition, _BATCH, most_boxes, most_seconds)
    spent = time.monotonic() - start
    refuted = _refutes(system, replace(metric, contraction_rate=rate), found.failure)
    return ContractionProof(
        box, rate, found.proved, found.cells, spent, found.failure, found.undecided, refuted
    )


def _refutes(system: System, metric: Metric, found: Violation | None) -> bool:
    """Return whether the condition itself fails at x and x_d near where that of the proof does."""
    if found is None:
        return False
    nominal = found.place if metric.point == "nominal" else found.nominal
    pairs = [(found.state, nominal), (found.nominal,) * 2, (found.state,) * 2]
    states, nominals = (np.stack(side) for side in zip(*pairs, strict=True))
    samples = Samples(states, nominals, np.tile(found.control, (len(pairs), 1)))
    return bool(contraction_residual(system, metric, samples).max() > _SURELY)


def largest_proved(
    system: System,
    metric: Metric,
    box: Any,
    contraction_rate: float | None = None,
    *,
    rounds: int = 8,
    most_seconds: float = 60.0,
) -> ContractionProof:
    """Find the largest multiple, at most one, of a box on which the condition can be proved.

    Args:
        system: The system.
        metric: The metric.
        box: The shape, and the largest size, of the box; `box.scaled(factor)` is a multiple.
        contraction_rate: alpha [1/s]; None for that of the metric.
        rounds: Halvings of the range of the multiple.
        most_seconds: Processor time for all of it [s]; each attempt gets an equal share.

    Returns:
        The proof for the largest box that was proved; if none was, the last attempt.
    """
    share = most_seconds / (rounds + 1)
    best = prove_contraction(system, metric, box, contraction_rate, most_seconds=share)
    if best.proved:
        return best
    low, high = 0.0, 1.0
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        trial = prove_contraction(
            system, metric, box.scaled(middle), contraction_rate, most_seconds=share
        )
        low, high = (middle, high) if trial.proved else (low, middle)
        if trial.proved or not best.proved:
            best = trial
    return best


def prove(
    system: System,
    metric: Metric,
    box: BoxRegion,
    contraction_rate: float | None = None,
    *,
    period: float | None = None,
    most_seconds: float = 60.0,
) -> Proof:
    """Prove what can be proved of a metric on a box, as statements.

    Args:
        system: The system.
        metric: The metric; one of x only where no control moves it.
        box: Where x and x_d lie, how far apart they are, and where u_d lies.
        contraction_rate: alpha [1/s]; None for that of the metric.
        period: Hold over which its condition is to be proved too [s]; None to leave it out.
        most_seconds: Processor time after which each search gives up [s].

    Returns:
        The statements, all of kind "proved", with the proofs behind them. One that was not proved
        within the time does not hold.

    Raises:
        TypeError: The metric is no polynomial.
        ValueError: As for `prove_contraction`.
    """
    where = describe(box)
    proof = prove_contraction(system, metric, box, contraction_rate, most_seconds=most_seconds)
    bounds, line = bounds_statement(system, metric, box.low, box.high, where)
    lines = [contraction_statement(proof, metric, where), line]
    held = None
    if period is not None:
        held = prove_hold(system, metric, box, contraction_rate, period, most_seconds=most_seconds)
        ends = ", ".join(f"{a:.4g} <= x[{i}] <= {b:.4g}" for i, (a, b) in held.ends.items())
        lines.append(
            held_statement(held, proof.contraction_rate, period, where, ends or "anywhere")
        )
    return Proof(lines, proof, bounds, held)


def contraction_statement(proof: ContractionProof, metric: Metric, where: str) -> Statement:
    """Return Theorem 2's condition as a line of a certificate, for a set in words."""
    return Statement(
        f"-dW/dt + 2 sym(A W) - 2 nu B B' < -2 alpha W, equation (14), with alpha = "
        f"{proof.contraction_rate:g} 1/s and nu = {metric.control_weight:.6g} (W as in its "
        f"file) for {where}",
        "proved",
        proof.proved,
        proof.seconds,
        refuted=proof.refuted,
    )


def held_statement(
    proof: HoldProof, rate: float, period: float, where: str, ends: str, control: str = "control"
) -> Statement:
    """Return the condition over a hold as a line of a certificate, for sets in words."""
    return Statement(
        f"under a {control} held for {period:g} s, some {control} shrinks an infinitesimal error "
        f"by exp(-alpha {period:g} s) in the metric from one control instant to the next, with "
        f"alpha = {rate:g} 1/s, for {where}; W is positive definite wherever the hold ends, {ends}",
        "proved",
        proof.proved,
        proof.seconds,
        refuted=proof.search.failure is not None,
    )


def bounds_statement(
    system: System,
    metric: Metric,
    low: ArrayLike,
    high: ArrayLike,
    where: str,
    claimed: float | None = None,
) -> tuple[ProvedBounds | None, Statement]:
    """Prove I <= S W_bar S <= chi I and b_bar on a box of states.

    Args:
        system: The system.
        metric: The metric.
        low: As in `prove_bounds`.
        high: As in `prove_bounds`.
        where: The box in words.
        claimed: chi, of W_bar as it is; None for the chi that is proved of some multiple of it.
    """
    start = time.monotonic()
    claim = "I <= S W S <= chi I with "
    if claimed is not None:
        claim += f"chi = {at_most(claimed, 6)} "
    try:
        bounds = prove_bounds(system, metric, low, high)
    except ValueError:
        spent = time.monotonic() - start
        return None, Statement(
            f"{claim}{'' if claimed else 'some chi '}for {where}", "proved", False, spent
        )
    holds = claimed is None or (bounds.least >= 1.0 and bounds.largest <= claimed)
    if claimed is None:
        claim += f"chi = {at_most(bounds.condition, 6)}, of a multiple of W, "
    text = f"{claim}and ||B|| <= b_bar = {at_most(bounds.control_gain, 6)} for {where}"
    return bounds, Statement(text, "proved", holds, bounds.seconds)


def describe(box: BoxRegion) -> str:
    """Return a box in words."""
    parts = [("x", box.low, box.high), ("u_d", box.control_low, box.control_high)]
    entries, free = [], []
    for name, lower, upper in parts:
        for index, (low, high) in enumerate(zip(lower, upper, strict=True)):
            if np.isfinite(low):
                entries.append(f"{low:g} <= {name}[{index}] <= {high:g}")
            else:
                free.append(f"{name}[{index}]")
    errors = ", ".join(f"{value:g}" for value in box.error)
    rest = f", any {', '.join(free)}" if free else ""
    return f"every {', '.join(entries)}{rest}, and x_d likewise, |x - x_d| up to ({errors})"
