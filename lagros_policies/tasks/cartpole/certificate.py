"""The cart-pole's certificate: what is proved of a metric on a box, and which tubes follow.

Theorem 1 holds while the state stays in the box on which the condition was proved; it does not say
that it stays there, and it is of a control that answers at every instant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY, CartPole
from lagros_policies.contraction.certificate import Certificate, Stopwatch, TubeSizes
from lagros_policies.contraction.condition import Samples
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.statement import Statement, at_most
from lagros_policies.contraction.theorems import disturbed_rate, feasibility_residual
from lagros_policies.contraction.tube import Tube, diverging_bound
from lagros_policies.proof.bounds import ProvedBounds, metric_drift, prove_bounds
from lagros_policies.proof.condition import prove_contraction
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.lipschitz import lipschitz_constant
from lagros_policies.tasks.cartpole.proof import angle_box
from lagros_policies.tasks.cartpole.systems import check_cartpole, check_cartpole_metric

# States at which the feasibility of u* is checked besides its proof.
_CHECKS = 10_000
# Above the rounding of a few products and roots, relative.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class CartPoleQuestion:
    """What a certificate is asked for.

    Attributes:
        box: Where the condition is to hold.
        disturbance_bound: d_bar, in units of the state per second.
        learning_error: eps_l of the network, for the u* that it imitates [N].
        paper_radius: What the published tube tends to.
        policy: Whose learning error that is.
        most_seconds: Time for each search for a proof [s].
    """

    box: ProofBox
    disturbance_bound: float
    learning_error: float
    paper_radius: float
    policy: str = "lagros"
    most_seconds: float = 60.0


def cartpole_certificate(
    system: CartPole,
    metric: Metric,
    question: CartPoleQuestion,
    proofs: Sequence[Statement] | None = None,
) -> Certificate:
    """Prove what can be proved of a metric and return it as a certificate.

    A metric that is no metric on the box gives a certificate that does not hold, and no exception.

    Args:
        system: The cart-pole.
        metric: The metric.
        question: What is asked.
        proofs: Statements of what was proved, first of all (14) on the box; proved here if None,
            and taken as proved elsewhere if there are none.

    Raises:
        TypeError: The system is no cart-pole, or the metric no polynomial.
        ValueError: The metric is of other than four states.
    """
    check_cartpole(system, "cartpole_certificate")
    check_cartpole_metric(metric, "cartpole_certificate")
    watch = Stopwatch()
    lines = list(_contraction(system, metric, question) if proofs is None else proofs)
    # Without (14) nothing follows from it.
    contracts = all(line.holds for line in lines[:1])
    watch.lap()
    box, alpha = question.box, metric.contraction_rate
    certificate = Certificate(
        task="cartpole",
        policy=question.policy,
        region=region_of(box),
        alpha=alpha,
        chi=math.inf,
        nu=metric.control_weight,
        b_bar=math.inf,
        epsilon_l=question.learning_error,
        d_bar=question.disturbance_bound,
        channels="all",
        basis=basis_of(metric),
        coefficients=metric.coefficients,
        tube=TubeSizes(question.paper_radius, None),
        statements=(),
    )
    plain = replace(metric, scaling=np.ones(system.state_dim))
    try:
        bounds = prove_bounds(system, plain, *angle_box(box.angle))
        # W is even in the angle: one half of it will do.
        drift = metric_drift(metric, 0.0, box.angle)
    except ValueError as error:
        failed = Statement(f"W_bar is a metric on the box: {error}", "proved", False, watch.lap())
        return replace(certificate, statements=(*lines, failed))
    lines.append(
        Statement(
            f"I <= W_bar <= {at_most(bounds.condition, 6)} I and ||B|| <= "
            f"{at_most(bounds.control_gain, 6)} for every |theta| <= {box.angle:g} rad",
            "proved",
            True,
            watch.lap(),
        )
    )
    rate = disturbed_rate(metric, drift, question.disturbance_bound)
    channels = "all" if rate > 0.0 else "rates"
    tube = Tube(
        rate if rate > 0.0 else alpha,
        bounds.condition,
        question.disturbance_bound,
        question.learning_error,
        bounds.control_gain,
    )
    radius = tube.steady_radius * (1.0 + _ROUNDING)
    if contracts and math.isfinite(radius):
        text = _theorem_one(tube, question, drift, rate, alpha)
        lines.append(Statement(text, "proved", True, watch.lap()))
    lines.extend(_theorem_two(system, metric, box))
    lemma, lipschitz = _lemma(system, question, bounds)
    lines.append(lemma)
    return replace(
        certificate,
        chi=bounds.condition,
        nu=metric.control_weight / bounds.least,
        b_bar=bounds.control_gain,
        channels=channels,
        coefficients=metric.coefficients / bounds.least,
        tube=TubeSizes(question.paper_radius, radius if contracts else None),
        statements=tuple(lines),
        details={
            "drift": drift,
            "disturbed_rate": rate,
            "lipschitz": lipschitz,
            "largest_disturbance_of_the_angle": 2.0 * alpha / drift if drift > 0.0 else None,
        },
    )


def region_of(box: ProofBox) -> dict[str, tuple[float, float]]:
    """Return a box by name; x and x_d lie in it, u_d and the errors too."""
    names = {
        "theta": box.angle,
        "p_dot": box.velocity,
        "theta_dot": box.angular_rate,
        "u_d": box.force,
        "theta_error": min(box.angle_error, 2.0 * box.angle),
        "theta_dot_error": min(box.angular_rate_error, 2.0 * box.angular_rate),
    }
    region = {name: (-value, value) for name, value in names.items()}
    if box.lean > 0.0:
        region["u_d_lean"] = (0.0, box.lean)
    return region


def basis_of(metric: Metric) -> str:
    """Return how W_bar depends on the state, in words."""
    if metric.degree == 0:
        return "1 (W_bar is constant); the state is [p, theta, p_dot, theta_dot]"
    return "cos(theta)^i; the state is [p, theta, p_dot, theta_dot]"


def _contraction(
    system: CartPole, metric: Metric, question: CartPoleQuestion
) -> tuple[Statement, ...]:
    proof = prove_contraction(system, metric, question.box, most_seconds=question.most_seconds)
    why = ""
    if proof.violation is not None:
        why = f" (fails at x = {np.round(proof.violation.state, 4).tolist()})"
    elif not proof.proved:
        why = " (undecided when time was up)"
    text = (
        f"equation (14) on the whole region, alpha = {metric.contraction_rate:g} 1/s, "
        f"control at will{why}"
    )
    return (Statement(text, "proved", proof.proved, proof.seconds, proof.refuted),)


def _theorem_one(
    tube: Tube, question: CartPoleQuestion, drift: float, rate: float, alpha: float
) -> str:
    bound = question.disturbance_bound
    if rate > 0.0:
        what = (
            f"all disturbances up to {bound:g}, rate alpha - kappa d_bar / 2 = {rate:.4g} 1/s for "
            f"their part in dM/dt (kappa = {at_most(drift)})"
        )
    else:
        what = (
            f"disturbances up to {bound:g} of the two rates only (of all four states "
            f"d_bar < {2.0 * alpha / drift:.3g} would be needed: kappa = {at_most(drift)})"
        )
    return (
        f"Theorem 1, control at will, e(0) = 0, while x stays in the region: ||e(t)|| <= "
        f"{at_most(tube.steady_radius)} (1 - exp(-{at_most(tube.contraction_rate)} t)) for {what}, "
        f"and a control within {at_most(question.learning_error)} N of one that contracts in this "
        "metric"
    )


def _theorem_two(system: CartPole, metric: Metric, box: ProofBox) -> list[Statement]:
    watch = Stopwatch()
    samples = draw_region(np.random.default_rng(0), box, _CHECKS)
    worst = float(feasibility_residual(system, metric, samples).max())
    return [
        Statement(
            f"Theorem 2: the program for u* is feasible, by u_d - nu B'W_bar^-1 e, at all "
            f"{_CHECKS} states drawn from the region (worst {worst:.3g} 1/s; negative is feasible)",
            "observed",
            worst <= 0.0,
            watch.lap(),
        )
    ]


def _lemma(
    system: CartPole, question: CartPoleQuestion, bounds: ProvedBounds
) -> tuple[Statement, float]:
    box = question.box
    # The lean adds at most the force that holds the pole still at the largest angle.
    balance = (system.cart_mass + system.pole_mass) * system.gravity * math.tan(box.angle)
    force = (box.force + box.lean * balance) * (1.0 + 1e-12)
    watch = Stopwatch()
    found = lipschitz_constant(system, replace(box, force=force, lean=0.0))
    at = diverging_bound(
        np.array([0.5, 1.0, 2.0]),
        found.upper,
        question.disturbance_bound,
        question.learning_error,
        bounds.control_gain,
    )
    line = Statement(
        f"Lemma 1, e(0) = 0, while x stays in the region: L_f <= {at_most(found.upper)} 1/s for a "
        f"u_d that does not answer to x; without feedback ||e|| is bounded by "
        f"{', '.join(at_most(bound, 3) for bound in at)} after 0.5, 1 and 2 s only",
        "proved",
        found.upper >= found.lower,
        watch.lap(),
    )
    return line, found.upper


def draw_region(rng: np.random.Generator, box: ProofBox, count: int) -> Samples:
    """Draw triples (x, x_d, u_d) of a box, e = x - x_d not zero; the lean is left out."""
    half = np.zeros(4)
    half[[0, ANGLE, VELOCITY, ANGULAR_RATE]] = 1.0, box.angle, box.velocity, box.angular_rate
    reach = np.array([1.0, box.angle_error, 2.0 * box.velocity, box.angular_rate_error])
    nominal = rng.uniform(-1.0, 1.0, (count, 4)) * half
    state = nominal + rng.uniform(-1.0, 1.0, (count, 4)) * reach
    state = np.clip(state, -half, half)
    state[:, 0] += 1e-3
    force = rng.uniform(-1.0, 1.0, (count, 1)) * box.force
    return Samples(state, nominal, force)
