"""The program behind a metric that can be proved: CV-STEM over points of three sets.

The conditions are imposed at points of Theorem 2's (14), for x and x_d apart and in its
differential form, and of the condition over a hold (`hold`). All are linear in W_bar and
their weights nu and nu_h, so that one program finds the metric that meets them all.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev, polynomial

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.checks import check_fields
from lagros_envs.dynamics import control_matrix, jacobian, linearise_hold
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY, CartPole
from lagros_policies.contraction.basis import cosine_powers, cosine_rates
from lagros_policies.contraction.cvstem import CvStemSettings, InfeasibleError
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.regions import Samples
from lagros_policies.contraction.semidefinite import (
    cone_rows,
    solve_cones,
    svec,
    symmetric_basis,
)
from lagros_policies.proof.bounds import prove_bounds
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.proof import PROVED_BOX, angle_box
from lagros_policies.tasks.cartpole.region import Region
from lagros_policies.tasks.cartpole.systems import check_cartpole

# Angles at which I <= W_bar <= chi I is imposed.
_BOUND_ANGLES = 25
# Points that a program begins with, and that are added after each, per set.
_ADDED = 40
_PROGRAMS = 12
# The angle after a hold lies beyond the box by no more than this [rad]: rate and half acceleration.
_OVERSHOOT = 0.25
# nu_h is worth less than nu: it is larger by about the inverse of the hold's square.
_HELD_PENALTY = 1e-3


@dataclass(frozen=True)
class ProvedDesignSettings:
    """What to design and prove.

    Attributes:
        cvstem: Rate, degree and weights; the margin is what the proofs may use up.
        box: Where (14) is to hold.
        leaning: Where its differential form is to hold, and the condition over a hold.
        period: Hold [s].
        rounds: Designs and proofs at most.
        most_seconds: Processor time of each proof [s].

    Raises:
        ValueError: A number is not positive.
    """

    cvstem: CvStemSettings = field(
        default_factory=lambda: CvStemSettings(
            contraction_rate=0.5, margin=0.1, scaling=Region.scaling
        )
    )
    box: ProofBox = PROVED_BOX
    leaning: ProofBox = field(default_factory=lambda: ProofBox(0.9, 1.5, 1.5, 1.0, lean=1.0))
    period: float = 0.1
    rounds: int = 5
    most_seconds: float = 60.0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.rounds < 1 or not (self.period > 0.0 and self.most_seconds > 0.0):
            raise ValueError("rounds must be at least 1, period and most_seconds positive")

    @property
    def scaling(self) -> FloatArray:
        """Diagonal of S, shape (4,)."""
        return np.array(self.cvstem.scaling or Region.scaling)


def corners(system: CartPole, box: ProofBox, angles: int = 21, rates: int = 5) -> Samples:
    """Return points of a box: a grid of angles and rates, the ends of rate of x and force.

    Args:
        system: The cart-pole.
        box: The box.
        angles: Angles of x from 0 to the largest.
        rates: Rates of y.
    """
    check_cartpole(system, "corners")
    far = box.angle_error > 0.0
    gaps = np.linspace(-1.0, 1.0, 5 if far else 1) * min(box.angle_error, 2.0 * box.angle)
    points = []
    for angle, gap, rate in itertools.product(
        np.linspace(0.0, box.angle, angles),
        gaps if far else [0.0],
        np.linspace(-box.angular_rate, box.angular_rate, rates),
    ):
        other = float(np.clip(angle + gap, -box.angle, box.angle))
        low = max(-box.angular_rate, rate - box.angular_rate_error)
        high = min(box.angular_rate, rate + box.angular_rate_error)
        balance = box.lean * (system.cart_mass + system.pole_mass) * system.gravity * np.tan(other)
        for own, speed in itertools.product({low, high}, (-box.velocity, box.velocity)):
            ends = (min(balance, 0.0) - box.force, max(balance, 0.0) + box.force)
            # Force and speed act together: only their extreme differences matter.
            points.append((angle, own, other, rate, speed, ends[0] if speed > 0.0 else ends[1]))
    table = np.array(points)
    state, nominal = np.zeros((2, len(table), 4))
    state[:, ANGLE], state[:, ANGULAR_RATE] = table[:, 0], table[:, 1]
    nominal[:, ANGLE], nominal[:, ANGULAR_RATE] = table[:, 2], table[:, 3]
    nominal[:, VELOCITY] = state[:, VELOCITY] = table[:, 4]
    return Samples(state, nominal, table[:, 5:])


def design_on_points(
    system: CartPole, pool: Samples, held: Samples, settings: ProvedDesignSettings
) -> Metric:
    """Solve programs over the points that bind until all points are satisfied.

    Args:
        system: The cart-pole.
        pool: Where the condition on the derivative is imposed.
        held: Where the condition over a hold is imposed; y is not used.
        settings: What to design.

    Returns:
        The metric; its bounds I <= S W_bar S <= chi I are proved.

    Raises:
        InfeasibleError: No such metric exists.
        RuntimeError: The points were not satisfied, or the solver stopped.
    """
    check_cartpole(system, "design_on_points")
    active = np.arange(0, len(pool.state), max(len(pool.state) // _ADDED, 1))
    active_held = np.arange(0, len(held.state), max(len(held.state) // _ADDED, 1))
    for _ in range(_PROGRAMS):
        metric, weight = _solve(system, pool.take(active), held.take(active_held), settings)
        worst = _largest(metric, *_rate_blocks(system, pool, settings, 0.0), metric.control_weight)
        worst_held = _largest(metric, *_held_blocks(system, held, settings, 0.0), weight)
        if worst.max() <= 0.0 and worst_held.max() <= 0.0:
            return metric
        active = np.union1d(active, _failing(worst))
        active_held = np.union1d(active_held, _failing(worst_held))
    raise RuntimeError(
        f"after {_PROGRAMS} programs the pools are not satisfied: raise the margin "
        f"({settings.cvstem.margin})"
    )


def _failing(worst: FloatArray) -> IntArray:
    order = np.argsort(worst)[::-1]
    return order[: min(_ADDED, int(np.sum(worst > 0.0)))]


def _rate_blocks(
    system: CartPole, pool: Samples, settings: ProvedDesignSettings, margin: float
) -> tuple[FloatArray, FloatArray]:
    """Return the condition's derivatives by W_i's entries (s, degree + 1, 10, 4, 4) and by nu."""
    scale, symmetric = settings.scaling, symmetric_basis(4)
    slope = jacobian(system, pool.nominal, pool.nominal_control)[0] * scale[:, None] / scale
    gain = control_matrix(system, pool.state) * scale[:, None]
    powers = cosine_powers(pool.state[:, ANGLE], settings.cvstem.degree)
    moving = cosine_rates(pool.state[:, ANGLE], pool.state[:, ANGULAR_RATE], settings.cvstem.degree)
    one_sided = np.einsum("sab,jbc->sjac", slope, symmetric)
    decay = 2.0 * (settings.cvstem.contraction_rate + margin)
    both = one_sided + np.swapaxes(one_sided, -1, -2) + decay * symmetric
    by_dual = powers[:, :, None, None, None] * both[:, None]
    by_dual -= moving[:, :, None, None, None] * symmetric
    return by_dual, -2.0 * gain @ np.swapaxes(gain, -1, -2)


def _held_blocks(
    system: CartPole, pool: Samples, settings: ProvedDesignSettings, margin: float
) -> tuple[FloatArray, FloatArray]:
    """Return the same of the condition over a hold."""
    scale, symmetric = settings.scaling, symmetric_basis(4)
    following, slope, gain = linearise_hold(
        system, pool.state, pool.nominal_control, settings.period
    )
    slope, gain = slope * scale[:, None] / scale, gain * scale[:, None]
    before = cosine_powers(pool.state[:, ANGLE], settings.cvstem.degree)
    after = cosine_powers(following[:, ANGLE], settings.cvstem.degree)
    decay = np.exp(-2.0 * (settings.cvstem.contraction_rate + margin) * settings.period)
    moved = np.einsum("sab,jbc,sdc->sjad", slope, symmetric, slope, optimize=True)
    by_dual = before[:, :, None, None, None] * moved[:, None]
    by_dual -= decay * after[:, :, None, None, None] * symmetric
    return by_dual, -gain @ np.swapaxes(gain, -1, -2)


def _largest(
    metric: Metric, by_dual: FloatArray, by_weight: FloatArray, weight: float
) -> FloatArray:
    """Return the largest eigenvalue of the condition at each point, in scaled states, (s,)."""
    scaled = metric.coefficients * metric.scaling[:, None] * metric.scaling
    rows, columns = zip(*[(i, j) for j in range(4) for i in range(j + 1)], strict=True)
    entries = scaled[:, rows, columns]
    left = np.tensordot(by_dual, entries, axes=((1, 2), (0, 1))) + weight * by_weight
    return np.asarray(np.linalg.eigvalsh(left)[:, -1], dtype=np.float64)


def _solve(
    system: CartPole, pool: Samples, held: Samples, settings: ProvedDesignSettings
) -> tuple[Metric, float]:
    """Solve one program; return the metric, its bounds proved, and nu_h."""
    cvstem, symmetric = settings.cvstem, symmetric_basis(4)
    reach = min(max(settings.box.angle, settings.leaning.angle) + _OVERSHOOT, 1.5)
    change = _chebyshev(cvstem.degree, reach)
    entries = (cvstem.degree + 1) * len(symmetric)
    columns = entries + 3
    angles = np.linspace(0.0, reach, _BOUND_ANGLES)
    spread = (cosine_powers(angles, cvstem.degree) @ change.T)[:, :, None, None, None] * symmetric
    unit = np.broadcast_to(np.eye(4), (_BOUND_ANGLES, 4, 4))
    by_rate, by_nu = _rate_blocks(system, pool, settings, cvstem.margin)
    by_hold, by_held_nu = _held_blocks(system, held, settings, cvstem.margin)
    by_rate, by_hold = (np.einsum("ji,siabc->sjabc", change, part) for part in (by_rate, by_hold))
    # Columns: W_bar, then nu, chi and nu_h.
    blocks = [
        _spread_columns(cone_rows(by_rate, by_nu, None), entries, (0, 1)),
        _spread_columns(cone_rows(by_hold, by_held_nu, None), entries, (2, 1)),
        _spread_columns(cone_rows(-spread, None, None), entries, (0, 1)),
        _spread_columns(cone_rows(spread, None, -unit), entries, (0, 1)),
    ]
    rights = [np.zeros(len(block)) for block in blocks]
    rights[2] = -svec(unit).ravel()
    cost = np.zeros(columns)
    cost[-3:] = cvstem.control_penalty, 1.0, _HELD_PENALTY
    # What the tolerance leaves the proofs make up for, in fewer iterations.
    values, status = solve_cones(cost, blocks, rights, 4, 1e-5)
    if values is None and status in ("PrimalInfeasible", "AlmostPrimalInfeasible"):
        raise InfeasibleError(
            f"no metric of degree {settings.cvstem.degree} with alpha="
            f"{settings.cvstem.contraction_rate} (margin {settings.cvstem.margin}) exists on "
            f"{settings.box} and {settings.leaning}: lower the rate or shrink the boxes"
        )
    if values is None:
        raise RuntimeError(f"Clarabel stopped with status {status}: try another control_penalty")
    found = values[:entries].reshape(cvstem.degree + 1, -1)
    scaled = np.einsum("ji,jk,kab->iab", change, found, symmetric)
    return _normalised(system, scaled, values[entries:], settings)


def _normalised(
    system: CartPole, scaled: FloatArray, weights: FloatArray, settings: ProvedDesignSettings
) -> tuple[Metric, float]:
    """Scale W_bar so that I <= S W_bar S <= chi I is proved on the box, with the chi that is."""
    scale = 1.0 / settings.scaling
    angle = max(settings.box.angle, settings.leaning.angle)
    metric = Metric(
        coefficients=scaled * scale[:, None] * scale,
        contraction_rate=settings.cvstem.contraction_rate,
        condition_bound=float(weights[1]),
        control_weight=float(weights[0]),
        scaling=settings.scaling,
        region=settings.box.region,
    )
    bounds = prove_bounds(system, metric, *angle_box(angle))
    # A little room, so that rounding of the scaled coefficients breaks no bound.
    factor = (1.0 + 1e-9) / bounds.least
    metric = replace(
        metric,
        coefficients=metric.coefficients * factor,
        condition_bound=bounds.condition * (1.0 + 1e-6),
        control_weight=metric.control_weight * factor,
    )
    return metric, float(weights[2]) * factor


def _spread_columns(block: FloatArray, entries: int, places: tuple[int, int]) -> FloatArray:
    """Put the last two columns of a block at their places among nu, chi and nu_h."""
    tail = np.zeros((len(block), 3))
    tail[:, list(places)] = block[:, entries:]
    return np.hstack([block[:, :entries], tail])


def _chebyshev(degree: int, reach: float) -> FloatArray:
    """Return Chebyshev polynomials of cos(theta), |theta| <= reach, as rows of powers of it.

    Powers of a cosine near one are almost dependent, which the solver pays for in iterations.
    """
    low = float(np.cos(reach))
    inner = [-(1.0 + low) / (1.0 - low), 2.0 / (1.0 - low)]
    rows = np.zeros((degree + 1, degree + 1))
    for order in range(degree + 1):
        total: Any = np.zeros(1)
        power: Any = np.ones(1)
        for weight in chebyshev.cheb2poly(np.eye(degree + 1)[order]):
            total, power = (
                polynomial.polyadd(total, weight * power),
                polynomial.polymul(power, inner),
            )
        rows[order, : len(total[: degree + 1])] = total[: degree + 1]
    return rows
