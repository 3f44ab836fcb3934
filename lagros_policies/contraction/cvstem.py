"""CV-STEM: the contraction metric with the least steady-state tube, as one semidefinite program.

Theorem 2, equations (14)-(16): over W_bar(theta) = sum_i W_i cos(theta)^i, nu and chi,

    min chi + lambda nu
    s.t. -dW_bar/dt + 2 sym(A W_bar) - 2 nu B B' <= -2 (alpha + margin) W_bar   at every sample
         I <= W_bar <= chi I                                                    at every angle

with one (nu, chi) for all samples, in scaled states z = S x. cvxpy states the same problem in the
tests; here the matrices go to Clarabel directly, which spares the compilation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from lagros_envs.checks import check_fields, check_not_negative, check_positive, check_whole
from lagros_envs.dynamics import System
from lagros_envs.dynamics.cartpole import ANGLE, ANGULAR_RATE
from lagros_policies.contraction.condition import Samples, condition_terms, contraction_residual
from lagros_policies.contraction.metric import Metric, Region, basis, basis_rate
from lagros_policies.contraction.semidefinite import (
    ConeProgram,
    cone_rows,
    solve_cones,
    svec,
    symmetric_basis,
)
from lagros_policies.contraction.systems import check_angle, check_sizes

FloatArray = NDArray[np.float64]

# Angles at which I <= W_bar(theta) <= chi I is imposed.
_BOUND_ANGLES = 25
_CHECK_ANGLES = 1001


class InfeasibleError(ValueError):
    """The condition has no solution for the asked rate and region."""


@dataclass(frozen=True)
class CvStemSettings:
    """What to design.

    Attributes:
        contraction_rate: alpha [1/s].
        degree: Degree of W_bar in cos(theta); 0 is a constant metric.
        control_penalty: lambda, the weight of nu; zero is ill-posed.
        margin: Added to alpha at the samples, so that the condition holds between them [1/s].
        scaling: Diagonal of S, the units in which chi is measured, one per state.

    Raises:
        ValueError: A value is out of range.
    """

    contraction_rate: float = 0.3
    degree: int = 4
    control_penalty: float = 0.1
    margin: float = 0.05
    scaling: tuple[float, ...] = (1.0, 12.0, 1.0, 1.5)

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        check_positive("contraction_rate", self.contraction_rate)
        check_whole("degree", self.degree, 0)
        if not self.control_penalty > 0.0:
            raise ValueError(
                f"control_penalty={self.control_penalty!r} must be > 0: without it nu is unbounded"
            )
        check_not_negative("margin", self.margin)
        for value in self.scaling:
            check_positive("scaling", value)


def design_metric(
    system: System, samples: Samples, region: Region, settings: CvStemSettings
) -> Metric:
    """Solve the joint CV-STEM program over samples.

    Args:
        system: The system.
        samples: Where the condition is imposed.
        region: The region that the samples cover, stored with the metric.
        settings: What to design.

    Returns:
        The metric, not yet verified.

    Raises:
        InfeasibleError: No metric exists for this alpha, region and degree.
        RuntimeError: The solver stopped for another reason.
        ValueError: Samples or scaling are not those of the system, or the degree is not 0 and state
            1 of the system does not move at the rate of state 3.
    """
    problem = _assemble(system, samples, region, settings)
    values, status = solve_cones(problem)
    if status in ("PrimalInfeasible", "AlmostPrimalInfeasible"):
        raise InfeasibleError(
            f"no contraction metric of degree {settings.degree} with "
            f"alpha={settings.contraction_rate} (margin {settings.margin}) exists on {region}: "
            "lower alpha or the margin, raise the degree, or shrink the region"
        )
    if values is None:
        raise RuntimeError(
            f"CV-STEM stopped with status {status} for alpha={settings.contraction_rate} on "
            f"{region}; try another control_penalty or scaling"
        )
    scale = 1.0 / np.asarray(settings.scaling)
    scaled = np.einsum(
        "ij,jkl->ikl", values[:-2].reshape(settings.degree + 1, -1), problem.symmetric
    )
    # Between the angles at which the bounds were imposed they hold but for a little: chi is what a
    # finer grid shows, with W_bar and nu scaled so that the least eigenvalue there is one.
    angles = np.linspace(0.0, region.angle, _CHECK_ANGLES)
    eigenvalues = np.linalg.eigvalsh(
        np.einsum("ai,ijk->ajk", basis(angles, settings.degree), scaled)
    )
    least = float(eigenvalues.min())
    if least <= 0.0:
        raise RuntimeError(
            f"CV-STEM gave a W_bar that is not positive between the angles of its grid (status "
            f"{status}); try another degree or scaling"
        )
    return Metric(
        coefficients=scaled * scale[:, None] * scale[None, :] / least,
        contraction_rate=settings.contraction_rate,
        condition_bound=float(eigenvalues.max()) / least,
        control_weight=float(values[-2]) / least,
        scaling=np.asarray(settings.scaling),
        region=region,
    )


def design_on_pool(
    system: System,
    pool: Samples,
    region: Region,
    settings: CvStemSettings,
    first: int = 60,
    rounds: int = 20,
) -> Metric:
    """Design a metric whose condition holds on a whole pool, imposing it where it binds.

    A program over thousands of samples is slow and almost all of its cones are slack. Start from
    the first few, then add the samples of the pool that the metric violates most, and repeat.

    Args:
        system: The system.
        pool: Samples that the metric must satisfy.
        region: The region that the pool covers.
        settings: What to design; the condition must hold on the pool for alpha itself, the margin
            is imposed on the active samples.
        first: Samples to begin with.
        rounds: Programs at most.

    Returns:
        The metric; it satisfies the condition on the pool.

    Raises:
        InfeasibleError: No metric exists for this alpha, region and degree.
        RuntimeError: The pool was not satisfied within the rounds.
    """
    active = np.arange(min(first, len(pool.state)))
    worst = math.inf
    for _ in range(rounds):
        metric = design_metric(system, pool.take(active), region, settings)
        residual = contraction_residual(system, metric, pool)
        worst = float(residual.max())
        if worst <= 0.0:
            return metric
        order = np.argsort(residual)[::-1]
        active = np.union1d(active, order[: min(first, int(np.sum(residual > 0.0)))])
    raise RuntimeError(
        f"after {rounds} programs the condition still fails by {worst:.2e} 1/s on the pool: raise "
        "the margin, which closes the gaps between samples"
    )


def search_rate(
    system: System,
    samples: Samples,
    region: Region,
    settings: CvStemSettings,
    rates: Sequence[float],
) -> tuple[Metric, list[tuple[float, float]]]:
    """Line search over alpha for the least steady-state tube per unit of disturbance.

    Args:
        system: The system.
        samples: Where the condition is imposed.
        region: The region that the samples cover.
        settings: What to design; its rate is replaced.
        rates: Values of alpha to try [1/s].

    Returns:
        The best metric and the curve of (alpha, sqrt(chi)/alpha); infinite where infeasible.

    Raises:
        InfeasibleError: Every rate is infeasible.
    """
    best: Metric | None = None
    curve: list[tuple[float, float]] = []
    least = math.inf
    for rate in rates:
        try:
            metric = design_metric(
                system, samples, region, replace(settings, contraction_rate=rate)
            )
        except InfeasibleError:
            curve.append((rate, math.inf))
            continue
        radius = math.sqrt(metric.condition_bound) / rate
        curve.append((rate, radius))
        if radius < least:
            best, least = metric, radius
    if best is None:
        raise InfeasibleError(
            f"no alpha of {list(rates)} is feasible on {region}: shrink the region or lower alpha"
        )
    return best, curve


def _powers(state: FloatArray, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return the basis at states (s, n) and its rate, both (s, degree + 1)."""
    if degree == 0:
        return np.ones((len(state), 1)), np.zeros((len(state), 1))
    angle, rate = state[:, ANGLE], state[:, ANGULAR_RATE]
    return basis(angle, degree), basis_rate(angle, rate, degree)


def _assemble(
    system: System, samples: Samples, region: Region, settings: CvStemSettings
) -> ConeProgram:
    scale = np.asarray(settings.scaling)
    n = system.state_dim
    check_sizes(system, scaling=(scale, (n,)))
    slope, gain, motion = condition_terms(system, samples)
    if settings.degree > 0:
        check_angle(system, samples.state, motion, gain)
    slope = slope * scale[:, None] / scale[None, :]
    gain = gain * scale[:, None]
    symmetric = symmetric_basis(n)
    powers, power_rates = _powers(samples.state, settings.degree)
    # d/dW_ij of the condition's left side, (s, degree + 1, basis, n, n).
    product = np.einsum("sab,jbc->sjac", slope, symmetric)
    both = product + np.swapaxes(product, -1, -2)
    decay = 2.0 * (settings.contraction_rate + settings.margin)
    by_dual = powers[:, :, None, None, None] * (both + decay * symmetric)[:, None]
    by_dual -= power_rates[:, :, None, None, None] * symmetric
    by_weight = -2.0 * gain @ np.swapaxes(gain, -1, -2)
    blocks = [cone_rows(by_dual, by_weight, None)]
    rights = [np.zeros(blocks[0].shape[0])]
    # The bounds depend on the angle alone, which a grid covers; a constant metric needs one point.
    grid = np.linspace(0.0, region.angle, _BOUND_ANGLES if settings.degree else 1)
    bound_powers = basis(grid, settings.degree)
    spread = bound_powers[:, :, None, None, None] * symmetric
    unit = np.broadcast_to(np.eye(n), (len(bound_powers), n, n))
    blocks.append(cone_rows(-spread, None, None))
    rights.append(-svec(unit).ravel())
    blocks.append(cone_rows(spread, None, -unit))
    rights.append(np.zeros(blocks[-1].shape[0]))
    cost = np.zeros(by_dual.shape[1] * by_dual.shape[2] + 2)
    cost[-2:] = settings.control_penalty, 1.0
    rows = sparse.csc_matrix(np.vstack(blocks))
    cones = len(samples.state) + 2 * len(bound_powers)
    return ConeProgram(cost, rows, np.concatenate(rights), cones, n, symmetric)
