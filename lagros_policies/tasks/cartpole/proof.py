"""What is proved of a cart-pole's metric, as statements for a certificate."""

from __future__ import annotations

import math
from dataclasses import replace

from lagros_envs.tasks.cartpole.physics import ANGLE, CartPole
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.statement import at_most
from lagros_policies.proof.condition import (
    Proof,
    bounds_statement,
    contraction_statement,
    held_statement,
    prove_contraction,
    prove_hold,
)
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.systems import check_cartpole_metric

# Cells of angle, rate and push that enclose where a hold ends.
_ENDS = (20, 10, 6)

PROVED_BOX = ProofBox.apart(angle=0.9, velocity=1.5, angular_rate=1.5, force=1.0)


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
) -> Proof:
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
    check_cartpole_metric(metric, "prove_cartpole")
    proof = prove_contraction(system, metric, box, contraction_rate, most_seconds=most_seconds)
    half = angle_box(box.angle)
    bounds, line = bounds_statement(
        system, metric, *half, f"every |theta| <= {box.angle:g} rad", metric.condition_bound
    )
    lines = [contraction_statement(proof, metric, describe(box)), line]
    if held_box is None:
        return Proof(lines, proof, bounds)
    rate = metric.contraction_rate if held_rate is None else held_rate
    held = prove_hold(
        *(system, metric, held_box, rate, period),
        counts=_ENDS,
        also=(ANGLE,),
        most_seconds=most_seconds,
    )
    after = max(abs(end) for end in held.ends[ANGLE])
    where = describe(replace(held_box, **_NO_ERRORS))
    lines.append(
        held_statement(held, rate, period, where, f"|theta| <= {at_most(after)} rad", "force")
    )
    return Proof(lines, proof, bounds, held)


def angle_box(angle: float) -> tuple[list[float], list[float]]:
    """Return the bounds of states with |theta| <= angle, each (4,); all else is free."""
    low, high = [-math.inf] * 4, [math.inf] * 4
    low[ANGLE], high[ANGLE] = -angle, angle
    return low, high


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
