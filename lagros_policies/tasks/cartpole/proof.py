"""What is proved of a cart-pole's metric, as statements for a certificate."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.statement import Statement, at_most
from lagros_policies.proof.cells import Search, search
from lagros_policies.proof.condition import (
    ContractionProof,
    ProofBox,
    ProvedBounds,
    prove_bounds,
    prove_contraction,
)
from lagros_policies.proof.hold import HeldViolation, HoldCondition

# Cells of one pass of the condition over a hold.
_BATCH = 400

PROVED_BOX = ProofBox.apart(angle=0.9, velocity=1.5, angular_rate=1.5, force=1.0)


@dataclass(frozen=True)
class CartPoleProof:
    """The proofs behind the statements.

    Attributes:
        statements: What was claimed, and whether it was proved.
        contraction: Theorem 2's condition on the box.
        bounds: Bounds of W_bar and B on the box; None if W_bar is not positive definite on it.
        held: The condition over a hold; None if it was not asked for.
    """

    statements: list[Statement]
    contraction: ContractionProof
    bounds: ProvedBounds | None
    held: Search[HeldViolation] | None


def prove_cartpole(
    metric: Metric,
    box: ProofBox = PROVED_BOX,
    system: CartPole | None = None,
    contraction_rate: float | None = None,
    *,
    held_box: ProofBox | None = None,
    held_rate: float | None = None,
    period: float = 0.1,
    most_seconds: float = 60.0,
) -> CartPoleProof:
    """Prove a metric on a box, by interval arithmetic.

    Args:
        metric: The metric.
        box: Where Theorem 2's condition (14) is to hold; `ProofBox.apart` for x and x_d anywhere.
        system: The cart-pole; the paper's if left out.
        contraction_rate: alpha [1/s]; None for that of the metric.
        held_box: Where the condition over a hold is to hold; None to leave it out.
        held_rate: Its alpha [1/s]; None for that of the metric.
        period: Hold [s].
        most_seconds: Processor time after which each of the two searches gives up [s].

    Returns:
        The statements, all of kind "proved", with the proofs behind them. One that was not proved
        within the time does not hold.
    """
    system = system or CartPole()
    proof = prove_contraction(system, metric, box, contraction_rate, most_seconds=most_seconds)
    statements = [
        Statement(
            f"-dW/dt + 2 sym(A W) - 2 nu B B' < -2 alpha W, equation (14), with alpha = "
            f"{proof.contraction_rate:g} 1/s and nu = {metric.control_weight:.6g} (W as in its "
            f"file) for {describe(box)}",
            "proved",
            proof.proved,
            proof.seconds,
        )
    ]
    bounds, statement = _bounds(system, metric, box)
    statements.append(statement)
    held = None
    if held_box is not None:
        rate = metric.contraction_rate if held_rate is None else held_rate
        condition = HoldCondition(system, metric, held_box, rate, period)
        held = search(condition, _BATCH, 1_000_000, most_seconds)
        start = time.monotonic()
        after = condition.largest_angle_after()
        definite = _definite(system, metric, max(after, held_box.angle))
        text = (
            f"under a force held for {period:g} s, some force shrinks an infinitesimal error by "
            f"exp(-alpha {period:g} s) in the metric from one control instant to the next, with "
            f"alpha = {rate:g} 1/s, for {describe(replace(held_box, **_NO_ERRORS))}; W is positive "
            f"definite wherever the hold ends, |theta| <= {at_most(after)} rad"
        )
        seconds = held.seconds + time.monotonic() - start
        statements.append(Statement(text, "proved", held.proved and definite, seconds))
    return CartPoleProof(statements, proof, bounds, held)


def describe(box: ProofBox) -> str:
    """Return the box in words, with units."""
    text = (
        f"every |theta| <= {box.angle:g} rad, |dp/dt| <= {box.velocity:g} m/s, |dtheta/dt| <= "
        f"{box.angular_rate:g} rad/s, any position, "
    )
    if box.angle_error >= 2.0 * box.angle and box.angular_rate_error >= 2.0 * box.angular_rate:
        text += "x and x_d each anywhere in it, "
    elif box.angle_error == 0.0 and box.angular_rate_error == 0.0:
        text += "x_d = x (the differential form), "
    else:
        text += (
            f"x and x_d both in it with errors up to {box.angle_error:g} rad and "
            f"{box.angular_rate_error:g} rad/s, "
        )
    if box.lean == 0.0:
        return f"{text}|u_d| <= {box.force:g} N"
    return (
        f"{text}u_d within {box.force:g} N of 0 to {box.lean:g} times the force that holds the "
        "pole still"
    )


_NO_ERRORS = {"angle_error": 0.0, "angular_rate_error": 0.0}


def _definite(system: CartPole, metric: Metric, angle: float) -> bool:
    """Return whether W_bar is shown to be positive definite for every |theta| <= angle."""
    try:
        prove_bounds(system, metric, angle)
    except ValueError:
        return False
    return True


def _bounds(
    system: CartPole, metric: Metric, box: ProofBox
) -> tuple[ProvedBounds | None, Statement]:
    """Prove I <= S W_bar S <= chi I and b_bar on the box."""
    start = time.monotonic()
    claim = f"I <= S W S <= chi I with chi = {at_most(metric.condition_bound, 6)} "
    where = f"for every |theta| <= {box.angle:g} rad"
    try:
        bounds = prove_bounds(system, metric, box.angle)
    except ValueError:
        return None, Statement(claim + where, "proved", False, time.monotonic() - start)
    holds = bounds.least >= 1.0 and bounds.largest <= metric.condition_bound
    text = f"{claim}and ||B|| <= b_bar = {at_most(bounds.control_gain, 6)} {where}"
    return bounds, Statement(text, "proved", holds, bounds.seconds)
