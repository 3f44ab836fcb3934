"""The spacecraft's certificate: for all states, by exact arithmetic and a Schur complement."""

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
from lagros_policies.contraction.tube import diverging_bound
from lagros_policies.tasks.spacecraft.ellipsoid_axis import (
    design_axis_ellipsoid,
    prove_axis_ellipsoid,
)
from lagros_policies.tasks.spacecraft.proof import (
    contracts_at_will,
    control_square,
    lies_between,
    prove_axis,
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
    learning_error: float,
    paper_radius: float,
    thrust: float = 1.0,
    policy: str = "lagros",
) -> Certificate:
    """Return the certificate of a metric of the plane, taken for all three axes.

    Args:
        plane: Metric of x and y, with the period of the hold; it serves the heading here too.
        turning: Metric that the tracking law has for the heading.
        body: The spacecraft, of any mass and arms; its thrusters push as those of `Spacecraft`.
        disturbance_bound: d_bar, in units of the state per second.
        learning_error: eps_l, as an acceleration in the plane [m/s^2].
        paper_radius: What the published tube tends to.
        thrust: Largest force of a thruster in u_d [N], which bounds the terms of the heading in A.
        policy: Whose learning error that is.

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
    tube = state_tube(plane, disturbance_bound + learning_error)
    radius = tube.steady_radius * (1.0 + 2.0 * _ROUNDING)
    position = position_tube(plane, disturbance_bound + learning_error)
    pushed = max(1.0, push)
    return Certificate(
        task="spacecraft",
        policy=policy,
        region=_region(thrust),
        alpha=rate,
        chi=chi,
        nu=nu,
        b_bar=gain,
        epsilon_l=learning_error / gain,
        d_bar=disturbance_bound,
        channels="all",
        basis="1 (W_bar is constant); the state is [x, y, heading, vx, vy, spin]",
        coefficients=coefficients[None],
        tube=TubeSizes(paper_radius, radius),
        statements=(
            *statements,
            Statement(
                f"equation (14) for the six states and a control at will, with the nu of this "
                f"certificate, for every u_d of thrusters up to {thrust:g} N: Schur complement",
                "proved",
                shown,
                watch.lap(),
            ),
            *_tubes(plane, disturbance_bound, learning_error, radius, shown),
            _lemma(pushed, disturbance_bound, learning_error),
        ),
        verdict_radius=certified_margin(plane, disturbance_bound),
        reach="u*, held for 0.1 s and without learning error, is proved to stay on its plan to",
        unit="m",
        everywhere=True,
        details={
            "tubes": {
                "position": position.steady_radius,
                "position_held_without_learning_error": certified_margin(plane, disturbance_bound),
            },
            "lipschitz": pushed,
            "ellipsoid": _ellipsoid_record(plane.period),
        },
    )


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


def _tubes(
    plane: AxisMetric, bound: float, learning_error: float, radius: float, contracts: bool
) -> list[Statement]:
    """Return the tubes; `contracts` says whether (14) was shown, which Theorem 1 stands on."""
    watch = Stopwatch()
    whole = bound + learning_error
    reach = position_tube(plane, whole).steady_radius * (1.0 + 2.0 * _ROUNDING)
    first = Statement(
        f"Theorem 1, control at will: ||e|| of the plane's four states tends to at most "
        f"{at_most(radius)}, its position error to {at_most(reach)} m, for d_bar = {bound:g} and "
        f"||u_L - u*|| <= {at_most(learning_error)} m/s^2",
        "proved",
        contracts and _radii_hold(plane, whole, radius, reach),
        watch.lap(),
    )
    margin = certified_margin(plane, bound)
    second = Statement(
        f"u* held for {plane.period:g} s, without learning error, e(0) = 0: the position error "
        f"never exceeds {at_most(margin)} m under d_bar = {bound:g}, at and between the instants "
        "(of a wrench that keeps its direction while the body turns)",
        "proved",
        prove_axis(plane).holds,
        watch.lap(),
    )
    ellipsoid = design_axis_ellipsoid(plane.period, "state")
    widest = at_most(ellipsoid.position * bound * (1.0 + _ROUNDING))
    third = Statement(
        f"invariant ellipsoid, v = K e held for {plane.period:g} s with K = "
        f"{ellipsoid.gain.round(4).tolist()} (rounded), without learning error, e(0) = 0: the "
        f"position error never exceeds {widest} m under d_bar = {bound:g} (likewise)",
        "proved",
        prove_axis_ellipsoid(ellipsoid),
        watch.lap(),
    )
    return [first, second, third]


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


def _ellipsoid_record(period: float) -> dict[str, object]:
    """Return the ellipsoid as what JSON can hold; `position` is per unit of d_bar."""
    found = design_axis_ellipsoid(period, "state")
    return {
        "W": found.dual.tolist(),
        "K": found.gain.tolist(),
        "tau": found.share,
        "hold": found.period,
        "position": found.position * (1.0 + _ROUNDING),
    }


def _lemma(lipschitz: float, bound: float, learning_error: float) -> Statement:
    watch = Stopwatch()
    at = diverging_bound(np.array([1.0, 10.0]), lipschitz, bound + learning_error)
    return Statement(
        f"Lemma 1, e(0) = 0: L_f <= {at_most(lipschitz)} 1/s for all states, so that without "
        f"feedback ||e|| is bounded by {at_most(at[0], 3)} after 1 s and by {at_most(at[1], 3)} "
        "after 10 s only",
        "proved",
        True,
        watch.lap(),
    )
