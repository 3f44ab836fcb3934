"""The spacecraft's certificate: for all states, by exact arithmetic and a Schur complement.

What is said of the law that flies is said of the gain of its metric, held. Theorem 1 is for a
control at will and is a line of the certificate of a metric alone, which nobody flies.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.physics import Spacecraft, check_spacecraft
from lagros_policies.contraction.certificate import Certificate, Stopwatch, TubeSizes
from lagros_policies.contraction.double_integrator import (
    AxisMetric,
    certified_margin,
    position_tube,
    state_tube,
)
from lagros_policies.contraction.statement import Statement, at_most
from lagros_policies.tasks.spacecraft.gain_control import PLAN_ACCELERATION, GainTracking
from lagros_policies.tasks.spacecraft.proof import (
    contracts_at_will,
    control_square,
    lies_between,
    prove_axis,
    prove_gain,
    prove_spacecraft,
)

_AXES = 3
# Far above the rounding of an eigenvalue, and what the proof of an axis gives up of the rate.
_ROUNDING = 1e-9


def spacecraft_certificate(
    plane: AxisMetric,
    turning: AxisMetric,
    body: Spacecraft,
    *,
    disturbance_bound: float,
    paper_radius: float,
    thrust: float = 1.0,
    policy: str = "centralized",
    law: GainTracking | None = None,
    flown: bool = True,
) -> Certificate:
    """Return the certificate of a metric of the plane, taken for all three axes.

    Args:
        plane: Metric of x and y, with the period of the hold; it serves the heading here too.
        turning: Metric that the tracking law has for the heading.
        body: The spacecraft, of any mass and arms; its thrusters push as those of `Spacecraft`.
        disturbance_bound: d_bar, in units of the state per second.
        paper_radius: What the published tube tends to.
        thrust: Largest force of a thruster in u_d [N], which bounds the terms of the heading in A.
        policy: What flies.
        law: The law that flies, whose tube is claimed; None for a metric alone, of which Theorem 1
            and the least-norm u* are.
        flown: Whether a law of that metric flies, so that a tube is claimed.

    Raises:
        TypeError: The body is no spacecraft.
        ValueError: B B' depends on the heading, or the metric's coupling leaves no room for a
            finite nu.
    """
    check_spacecraft(body, "spacecraft_certificate")
    watch = Stopwatch()
    square = control_square(body)
    if square is None:
        raise ValueError(f"B B' of {body} is not one diagonal at every heading")
    gain = _root_above(max(square))
    # Thrusters push both ways along each body axis, two at a time.
    push = _root_above(8 * (Fraction(thrust) / Fraction(body.mass)) ** 2)
    weight = control_weight(plane, float(min(square)), push)
    dual = whole_dual(plane)
    values = np.linalg.eigvalsh(dual)
    # I <= W_bar: the least eigenvalue is brought to one, with room for its rounding.
    least = float(values[0]) * (1.0 - _ROUNDING)
    chi = prove_axis(plane).condition * (1.0 + 2.0 * _ROUNDING)
    rate, nu, coefficients = plane.rate * (1.0 - _ROUNDING), weight / least, dual / least
    # The numbers above are guesses in floats; this decides, in fractions of what is written.
    block = coefficients[np.ix_([0, _AXES], [0, _AXES])]
    shown = contracts_at_will(block, rate, nu, min(square), push) and lies_between(
        block, Fraction(1), Fraction(chi)
    )
    statements = prove_spacecraft(plane, turning, body)
    watch.lap()
    certified, reach, details = None, "", {}
    lines: list[Statement] = []
    if law is not None:
        lines, margin = _of_the_gain(law, disturbance_bound)
        reach = "what flies, u_d + K e held for 0.1 s, is proved to stay on its plan to"
        details = {"tubes": {"position_held": margin}, "gain": _gain_record(law)}
    elif flown:
        radius = state_tube(plane, disturbance_bound).steady_radius * (1.0 + 2.0 * _ROUNDING)
        certified, margin = radius, certified_margin(plane, disturbance_bound)
        lines = _of_the_metric(plane, disturbance_bound, radius, shown)
        reach = "the least-norm u*, held for 0.1 s, stays on its plan, but for the turn, to"
        details = {"tubes": {"position_held": margin}}
    return Certificate(
        task="spacecraft",
        policy=policy,
        region=_region(thrust),
        alpha=rate,
        chi=chi,
        nu=nu,
        b_bar=gain,
        epsilon_l=0.0 if flown else None,
        d_bar=disturbance_bound,
        channels="all",
        basis="1 (W_bar is constant); the state is [x, y, heading, vx, vy, spin]",
        coefficients=coefficients[None],
        tube=TubeSizes(paper_radius, certified),
        statements=(
            *statements,
            Statement(
                f"equation (14) for the six states and a control at will, with the nu of this "
                f"certificate, for every u_d of thrusters up to {thrust:g} N: Schur complement",
                "proved",
                shown,
                watch.lap(),
            ),
            *lines,
        ),
        verdict_radius=margin if reach else None,
        reach=reach,
        unit="m",
        everywhere=True,
        details=details,
    )


def _of_the_gain(law: GainTracking, bound: float) -> tuple[list[Statement], float]:
    """Return what is proved of the law that flies, and the bound of the position error [m]."""
    watch = Stopwatch()
    lines = [
        Statement(
            f"{name}: v = K e, K = [{axis.gain[0]:.6g}, {axis.gain[1]:.6g}], held for "
            f"{axis.period:g} s, contracts V by exp(-2 alpha h) for every e, alpha = "
            f"{axis.rate:.4g} (1 - 1e-9) 1/s: u* is this gain, and no projection acts",
            "proved",
            prove_gain(axis),
            watch.lap(),
        )
        for name, axis in (("x and y", law.plane), ("heading", law.turning))
    ]
    margin = law.margin(bound)
    tube = Statement(
        f"that law around plans of at most {PLAN_ACCELERATION:g} m/s^2, e(0) = 0: ||p - p_d|| "
        f"never exceeds {at_most(margin)} m under d_bar = {bound:g}, at and between the instants, "
        "with the turn of the body in a hold, the environment's Runge-Kutta steps and single "
        "precision",
        "proved",
        math.isfinite(margin),
        watch.lap(),
    )
    return [*lines, tube], margin


def _gain_record(law: GainTracking) -> dict[str, object]:
    """Return the laws of the axes as what JSON can hold."""
    return {
        name: {
            "K": axis.gain.tolist(),
            "W": axis.dual.tolist(),
            "alpha": axis.rate,
            "hold": axis.period,
        }
        for name, axis in (("plane", law.plane), ("heading", law.turning))
    }


def control_weight(metric: AxisMetric, gain: float, push: float) -> float:
    """Return a nu for which (14) holds for the six states at the metric's own rate, in floats.

    It is that of `contracts_at_will`, which proves it in fractions, and a millionth more.

    Args:
        metric: The metric, with q < -alpha, which a hold brings about.
        gain: The least entry g of B B'.
        push: Bound of the acceleration of u_d, at every heading.

    Raises:
        ValueError: q is not below -alpha.
    """
    alpha, q, s = metric.rate, metric.coupling, metric.stiffness
    room = -2.0 * (q + alpha)
    if not room > 0.0:
        raise ValueError(
            f"coupling={q!r} must be below -{alpha!r} for a finite nu: use a metric with a period"
        )
    size = 2.0 * alpha * s + 2.0 * abs(q) * push + (abs(s + 2.0 * alpha * q) + push) ** 2 / room
    return size / (2.0 * gain) * (1.0 + 1e-6)


def _root_above(square: Fraction) -> float:
    """Return a double no less than the root of a fraction: its own where that is a double."""
    root = math.sqrt(square)
    while Fraction(root) ** 2 < square:
        root = math.nextafter(root, math.inf)
    return root


def whole_dual(metric: AxisMetric) -> FloatArray:
    """Return W for the six states [x, y, heading, vx, vy, spin], one metric for all axes."""
    return np.asarray(np.kron(metric.dual, np.eye(_AXES)), dtype=np.float64)


def _region(thrust: float) -> dict[str, tuple[float, float]]:
    # For all states: W_bar is constant and A depends on heading and thrust alone. The other
    # intervals only give whoever samples something finite to sample.
    wide = (-1e3, 1e3)
    turn = (-math.pi, math.pi)
    return {
        **dict.fromkeys(("x", "y"), wide),
        "heading": turn,
        **dict.fromkeys(("vx", "vy", "spin"), wide),
        "u_d": (0.0, thrust),
    }


def _of_the_metric(
    plane: AxisMetric, bound: float, radius: float, contracts: bool
) -> list[Statement]:
    """Return Theorem 1 and the held u*; `contracts` says whether (14) was shown."""
    watch = Stopwatch()
    reach = position_tube(plane, bound).steady_radius * (1.0 + 2.0 * _ROUNDING)
    first = Statement(
        f"Theorem 1, control at will: ||e|| of the plane's four states tends to at most "
        f"{at_most(radius)}, its position error to {at_most(reach)} m, for d_bar = {bound:g} "
        "and u* itself",
        "proved",
        contracts and _radii_hold(plane, bound, radius, reach),
        watch.lap(),
    )
    margin = certified_margin(plane, bound)
    second = Statement(
        f"least-norm u* held for {plane.period:g} s, e(0) = 0: the position error never exceeds "
        f"{at_most(margin)} m under d_bar = {bound:g}, at and between the instants (of a wrench "
        "that keeps its direction while the body turns)",
        "proved",
        prove_axis(plane).holds,
        watch.lap(),
    )
    return [first, second]


def _radii_hold(plane: AxisMetric, push: float, radius: float, reach: float) -> bool:
    """Return whether both radii are no less than Theorem 1's at the certificate's alpha, exactly.

    Those are sqrt(chi) d_bar / alpha, and d_bar / (alpha sqrt(lambda_min(W))) for the position.
    """
    condition = prove_axis(plane).condition
    if not (math.isfinite(condition) and reach > 0.0):
        return False
    steady = (Fraction(push) / Fraction(plane.rate * (1.0 - _ROUNDING))) ** 2
    # W = [[1, q], [q, s]] is below its trace.
    least, largest = steady / Fraction(reach) ** 2, 1 + Fraction(plane.stiffness)
    return Fraction(radius) ** 2 >= Fraction(condition) * steady and lies_between(
        plane.dual, least, largest
    )
