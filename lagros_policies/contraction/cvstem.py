"""CV-STEM: the contraction metric with the least steady-state tube, by semidefinite programs.

The program of `cvstem_program` imposes the condition at samples and the bounds of W_bar at places.
A thousand samples make it slow, and almost all of them are slack; so it begins with few, and is
solved again with those that were broken. The bounds are imposed on a grid of the coordinate in
which a region is even, and for any other basis where a search of the region finds them broken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray, IntArray
from lagros_envs.checks import check_whole
from lagros_envs.dynamics import System
from lagros_policies.contraction.basis import Basis
from lagros_policies.contraction.condition import Samples, contraction_residual, search_violation
from lagros_policies.contraction.cvstem_program import (
    CvStemSettings,
    InfeasibleError,
    condition_rows,
    resolved,
    solve_program,
)
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.places import Point, extreme_places, is_on_grid, places_of
from lagros_policies.contraction.regions import MetricRegion, joined

__all__ = [
    "CvStemSettings",
    "InfeasibleError",
    "design_metric",
    "design_on_pool",
    "design_on_region",
    "least_condition",
    "search_rate",
]

# Angles at which I <= W_bar <= chi I is imposed, and looked at afterwards; and states of a region
# at which it is imposed first.
_BOUND_ANGLES = 25
_CHECK_ANGLES = 1001
_BOUND_STATES = 40
# By how much the bounds may be exceeded before they are imposed there too, and the least eigenvalue
# with which W_bar is looked at further.
_BOUND_SLACK = 0.01
# A bound further from binding than this leaves the program of a region.
_BOUND_NEAR = 0.1
_LEAST = 0.1
_BOUND_ROUNDS = 20
# How near to binding a sample stays in the program of a region [1/s].
_NEAR = 0.1
# How many of the worst are added, wherever they are.
_WORST = 8
# How many searches of a region must find nothing, once its pool is satisfied; before, there is one.
_SEEDS = 5


def design_metric(
    system: System, samples: Samples, region: MetricRegion, settings: CvStemSettings
) -> Metric:
    """Solve the joint CV-STEM program over samples.

    Args:
        system: The system.
        samples: Where the condition is imposed.
        region: The region that the samples cover, over which the bounds hold; stored with the
            metric.
        settings: What to design.

    Returns:
        The metric, not yet verified.

    Raises:
        InfeasibleError: No metric exists for this alpha, region and basis.
        RuntimeError: The solver stopped for another reason.
        ValueError: Samples, scaling or region are not those of the system, or a control moves a
            basis of x.
    """
    every = np.arange(len(samples.state))
    return _design(system, samples, every, region, settings, _Effort(0, _BOUND_ROUNDS))


def least_condition(
    system: System, samples: Samples, region: MetricRegion, settings: CvStemSettings
) -> float:
    """Return chi of the program over samples alone, solved once and searched for nothing.

    Where this finds no metric there is none, which is said within seconds.

    Args:
        system: The system.
        samples: Where the condition is imposed.
        region: Where the bounds are, at a few places.
        settings: What to design.

    Raises:
        InfeasibleError: No metric exists for this alpha, region and basis.
        RuntimeError: The solver stopped for another reason.
        ValueError: As of `design_metric`.
    """
    settings = resolved(system, region, settings)
    where = region, settings.phi, settings.point, system.state_dim
    places = places_of(*where, _BOUND_ANGLES, _BOUND_STATES)
    conditions = condition_rows(system, samples, settings)
    return solve_program(conditions, places, region, settings)[2]


def design_on_pool(
    system: System,
    pool: Samples,
    region: MetricRegion,
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
        The metric; it satisfies the condition on the pool, and its bounds as far as a search of the
        region finds.

    Raises:
        InfeasibleError: No metric exists for this alpha, region and basis.
        RuntimeError: The pool was not satisfied within the rounds.
        ValueError: A number is not positive, or as for `design_metric`.
    """
    _check_numbers(first=first, rounds=rounds)
    active = np.arange(min(first, len(pool.state)))
    return _design(system, pool, active, region, settings, _Effort(first, rounds))


def design_on_region(
    system: System,
    region: MetricRegion,
    settings: CvStemSettings,
    pool: int = 20_000,
    first: int = 60,
    rounds: int = 40,
    seed: int = 0,
) -> Metric:
    """Design a metric on triples drawn from its region, and where a search of it finds it broken.

    Args:
        system: The system.
        region: Where the metric must contract; all of it: one of which plans use but a part is
            rather designed on their pool.
        settings: What to design.
        pool: Triples to draw.
        first: Triples to begin with, and about as many as are added at most each time.
        rounds: Programs at most.
        seed: Seed of the triples.

    Returns:
        The metric; condition and bounds hold as far as triples and search find (observed).

    Raises:
        InfeasibleError: No metric exists for this alpha, region and basis.
        RuntimeError: Condition and bounds were not met within the rounds.
        ValueError: A number is not positive, or as for `design_metric`.
    """
    _check_numbers(pool=pool, first=first, rounds=rounds)
    drawn = region.sample(np.random.default_rng(seed), pool)
    active, effort = np.arange(min(first, pool)), _Effort(first, rounds, searched=True)
    return _design(system, drawn, active, region, settings, effort)


@dataclass(frozen=True)
class _Effort:
    """How a design looks for constraints that are broken.

    Attributes:
        first: Samples of the pool that are added at most each time; 0 if it is not looked at.
        rounds: Programs at most.
        searched: Whether the region is searched for samples that the pool does not have.
    """

    first: int
    rounds: int
    searched: bool = False


def search_rate(
    system: System,
    samples: Samples,
    region: MetricRegion,
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


def _design(
    system: System,
    pool: Samples,
    active: IntArray,
    region: MetricRegion,
    settings: CvStemSettings,
    effort: _Effort,
) -> Metric:
    """Solve the program, and again with the constraints that were broken, until none is.

    Args:
        system: The system.
        pool: Where the condition must hold.
        active: Samples of the pool to begin with.
        region: Where the bounds must hold.
        settings: What to design.
        effort: How to look for what is broken.
    """
    named, settings = settings.basis, resolved(system, region, settings)
    where = region, settings.phi, settings.point, system.state_dim
    places = places_of(*where, _BOUND_ANGLES, _BOUND_STATES)
    worst = math.inf
    for turn in range(effort.rounds):
        conditions = condition_rows(system, pool.take(active), settings)
        scaled, weight, bound = solve_program(conditions, places, region, settings)
        least, largest, outside, near = _bounds(scaled, bound, places, *where)
        places = np.concatenate([places[near], outside])
        if len(outside) and least <= _LEAST:
            continue
        metric = _scaled_metric(scaled, weight, (least, largest), region, settings, named)
        pool, residual = _residual(system, metric, pool, effort, turn)
        worst = float(residual.max())
        if worst <= 0.0 and len(outside) == 0:
            return metric
        if effort.searched:
            # What is far from binding decides nothing: the program stays small without it.
            active = active[residual[active] > -2.0 * settings.margin - _NEAR]
        active = np.union1d(active, _broken(residual, effort))
    after = f"after {effort.rounds} programs"
    if not 0.0 < worst < math.inf:
        raise RuntimeError(
            f"{after} the bounds of W_bar still fail on {region}: take a basis of fewer functions, "
            "or a smaller region"
        )
    raise RuntimeError(
        f"{after} the condition still fails by {worst:.2e} 1/s on the pool: raise the margin, "
        "which closes the gaps between samples"
    )


def _check_numbers(**numbers: int) -> None:
    for name, value in numbers.items():
        check_whole(name, value)


def _bounds(
    scaled: FloatArray,
    bound: float,
    places: FloatArray,
    region: MetricRegion,
    phi: Basis,
    point: Point,
    n: int,
) -> tuple[float, float, FloatArray, BoolArray]:
    """Return the extreme eigenvalues of the scaled W_bar, and where to bound it next.

    Returns:
        The least and the largest; places to bound it at as well; and which of the present ones are
        near to binding, without which the program has another optimum.

    Raises:
        RuntimeError: It is not positive between the points of a grid, which no place is added to.
    """

    def dual(place: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("ai,ijk->ajk", phi.at(place), scaled), dtype=np.float64)

    grid = is_on_grid(region, phi)
    ends = places_of(region, phi, point, n, _CHECK_ANGLES, 1)
    if not grid:
        ends = np.concatenate(extreme_places(region, dual, point))
    eigenvalues = np.linalg.eigvalsh(dual(ends))
    least, largest = float(eigenvalues.min()), float(eigenvalues.max())
    if grid and least <= 0.0:
        raise RuntimeError(
            "CV-STEM gave a W_bar that is not positive between the points of its grid; try another "
            "degree or scaling"
        )
    kept = least >= 1.0 - _BOUND_SLACK and largest <= bound * (1.0 + _BOUND_SLACK)
    if grid or kept:
        return least, largest, ends[:0], np.ones(len(places), np.bool_)
    present = np.linalg.eigvalsh(dual(places))
    near = (present[:, 0] <= 1.0 + _BOUND_NEAR) | (present[:, -1] >= bound * (1.0 - _BOUND_NEAR))
    return least, largest, ends, near


def _residual(
    system: System, metric: Metric, pool: Samples, effort: _Effort, turn: int
) -> tuple[Samples, FloatArray]:
    """Return the pool, with what searches of the region found, and by how much the metric fails."""
    if not effort.first:
        return pool, np.full(1, -math.inf)
    residual = contraction_residual(system, metric, pool)
    if effort.searched:
        count = _SEEDS if residual.max() <= 0.0 else 1
        seeds = range(_SEEDS * turn, _SEEDS * turn + count)
        found = joined(*(search_violation(system, metric, seed)[0] for seed in seeds))
        pool = joined(pool, found)
        residual = np.concatenate([residual, contraction_residual(system, metric, found)])
    return pool, residual


def _broken(residual: FloatArray, effort: _Effort) -> IntArray:
    """Return the samples to add: the worst, or the worst of each part of a pool in random order."""
    order = np.argsort(residual)[::-1]
    worst = order[: min(effort.first, int(np.sum(residual > 0.0)))]
    if not effort.searched:
        return worst
    parts = np.array_split(np.arange(len(residual)), effort.first)
    each = np.array([part[np.argmax(residual[part])] for part in parts if len(part)])
    return np.union1d(each[residual[each] > 0.0], worst[:_WORST])


def _scaled_metric(
    scaled: FloatArray,
    weight: float,
    ends: tuple[float, float],
    region: MetricRegion,
    settings: CvStemSettings,
    named: Basis | None,
) -> Metric:
    """Return the metric in the units of the state.

    Between the places at which the bounds were imposed they hold but for a little: chi is what a
    finer look shows, with W_bar and nu scaled so that the least eigenvalue there is one.
    """
    least, largest = ends
    scale = 1.0 / np.asarray(settings.scaling)
    return Metric(
        coefficients=scaled * scale[:, None] * scale[None, :] / least,
        contraction_rate=settings.contraction_rate,
        condition_bound=largest / least,
        control_weight=weight / least,
        scaling=np.asarray(settings.scaling),
        region=region,
        basis=named,
        point=settings.point,
    )
