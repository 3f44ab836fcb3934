"""The cart-pole's certificate: what is proved of a metric on a box, and which tubes follow.

Theorem 1 holds while the state stays in the box on which the condition was proved; it does not say
that it stays there. So there are two kinds of tube here: the paper's, conditional on that, and
those of `tube_design` and, for a control that is held, of `held_design`, which keep the state in
their box by themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY, CartPole
from lagros_policies.contraction.certificate import Certificate, Stopwatch, TubeSizes
from lagros_policies.contraction.condition import Samples
from lagros_policies.contraction.ellipsoid import prove_tube
from lagros_policies.contraction.held_design import HeldTube
from lagros_policies.contraction.held_ellipsoid import SHORTEST, HeldTubeProof, prove_held_tube
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.statement import Statement, at_most
from lagros_policies.contraction.theorems import disturbed_rate, feasibility_residual
from lagros_policies.contraction.tube import Tube, diverging_bound
from lagros_policies.contraction.tube_design import ConstantTube
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
        control_error: Distance from a control that contracts in *this* metric, which is what
            Theorem 1 takes for eps_l [N]; None if the network imitates the u* of this metric.
    """

    box: ProofBox
    disturbance_bound: float
    learning_error: float
    paper_radius: float
    policy: str = "lagros"
    most_seconds: float = 60.0
    control_error: float | None = None

    @property
    def error(self) -> float:
        """What Theorem 1 takes for eps_l [N]."""
        return self.learning_error if self.control_error is None else self.control_error


def cartpole_certificate(
    system: CartPole,
    metric: Metric,
    question: CartPoleQuestion,
    proofs: Sequence[Statement] | None = None,
    tubes: Sequence[ConstantTube] = (),
    held: Sequence[HeldTube] = (),
) -> Certificate:
    """Prove what can be proved of a metric and return it as a certificate.

    A metric that is no metric on the box gives a certificate that does not hold, and no exception.

    Args:
        system: The cart-pole.
        metric: The metric.
        question: What is asked.
        proofs: Statements of what was proved, first of all (14) on the box; proved here if None,
            and taken as proved elsewhere if there are none.
        tubes: Tubes of constant metrics to prove as well.
        held: Tubes of a held control, likewise.

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
        question.error,
        bounds.control_gain,
    )
    radius = tube.steady_radius * (1.0 + _ROUNDING)
    if contracts and math.isfinite(radius):
        text = _theorem_one(tube, question, drift, rate, alpha)
        lines.append(Statement(text, "proved", True, watch.lap()))
    lines.extend(_theorem_two(system, metric, box))
    lemma, lipschitz = _lemma(system, question, bounds)
    lines.append(lemma)
    for constant in tubes:
        proof = prove_tube(system, constant, question.most_seconds)
        lines.append(tube_statement(constant, proof.proved, proof.seconds))
    lines.extend(
        held_statement(tube, prove_held_tube(system, tube, question.most_seconds)) for tube in held
    )
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
            "control_error": question.control_error,
            "largest_disturbance_of_the_angle": 2.0 * alpha / drift if drift > 0.0 else None,
            "tubes": [tube_record(constant) for constant in tubes],
            "held_tubes": [held_record(tube) for tube in held],
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


def tube_record(tube: ConstantTube) -> dict[str, object]:
    """Return a tube of a constant metric as what JSON can hold."""
    return {
        "method": tube.design.method,
        **_record(tube),
        "largest_d_bar": tube.largest_bound,
        "nu": tube.control_weight,
        "W": tube.dual.tolist(),
    }


def held_record(tube: HeldTube) -> dict[str, object]:
    """Return a tube of a held control as what JSON can hold; `Q` are Bernstein's coefficients."""
    return {
        **_record(tube),
        "hold": tube.design.period,
        "shorter_holds_too": tube.design.aperiodic,
        "deviation": tube.largest_deviation,
        "K": tube.gain.tolist(),
        "Q": tube.duals.tolist(),
    }


def _record(tube: ConstantTube | HeldTube) -> dict[str, object]:
    design, names = tube.design, ("p", "theta", "p_dot", "theta_dot")
    return {
        "output": None if design.output is None else list(design.output),
        "alpha": design.rate,
        "d_bar": design.disturbance_bound,
        "radius": tube.steady_radius,
        "outputs": dict(zip(names, tube.steady_outputs.tolist(), strict=True)),
        "contained": tube.contained,
        "plan": asdict(tube.plan),
        "region": {name: list(ends) for name, ends in region_of(tube.proof_box).items()},
    }


def tube_statement(tube: ConstantTube, proved: bool, seconds: float) -> Statement:
    """Return a tube of a constant metric as a line of a certificate."""
    text = (
        f"{tube.design.method} tube, all disturbances up to {tube.design.disturbance_bound:g}, "
        f"control at will, e(0) = 0: {_widths(tube)}; it keeps the state in its box while "
        f"{_where(tube)}"
    )
    return Statement(text, "proved", proved, seconds)


def held_statement(tube: HeldTube, proof: HeldTubeProof) -> Statement:
    """Return a tube of a held control as a line of a certificate."""
    design = tube.design
    holds = f"holds of {SHORTEST * design.period:g} to" if design.aperiodic else "held"
    text = (
        f"ellipsoid tube, control {holds} {design.period:g} s, at the instants and between them, "
        f"all disturbances up to {design.disturbance_bound:g}, e(0) = 0: {_widths(tube)}, "
        f"|u - u_d| <= {at_most(tube.largest_deviation)} N for u = u_d + K e, K = "
        f"{np.round(tube.gain[0], 3).tolist()} (rounded); it keeps the state in its box while "
        f"{_where(tube)}"
    )
    return Statement(text, "proved", proof.proved, proof.seconds)


def _widths(tube: ConstantTube | HeldTube) -> str:
    p, angle = tube.steady_outputs[[0, ANGLE]]
    return (
        f"|theta - theta_d| <= {at_most(angle)} rad, |p - p_d| <= {at_most(p)} m, ||e|| <= "
        f"{at_most(tube.steady_radius)}"
    )


def _where(tube: ConstantTube | HeldTube) -> str:
    plan = tube.plan
    return (
        f"|theta_d| <= {plan.angle:g} rad, |p_d'| <= {plan.velocity:g} m/s, |theta_d'| <= "
        f"{plan.angular_rate:g} rad/s and |u_d| <= {plan.force:g} N"
    )


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
    known = ""
    if question.control_error is None and question.learning_error > 0.0:
        known = " (how far it is from that was not flown; taken is the recorded ||u_L - u*||)"
    return (
        f"Theorem 1, control at will, e(0) = 0, while x stays in the region: ||e(t)|| <= "
        f"{at_most(tube.steady_radius)} (1 - exp(-{at_most(tube.contraction_rate)} t)) for {what}, "
        f"and a control within {at_most(question.error)} N of one that contracts in this metric"
        f"{known}"
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
