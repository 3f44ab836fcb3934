"""CV-STEM: Clarabel called directly against the same program stated in cvxpy; u* of a batch."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import System, control_matrix, state_dependent_coefficient
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE
from lagros_policies.contraction import (
    CvStemSettings,
    HeldControl,
    Metric,
    Samples,
    design_metric,
    robust_control,
)
from lagros_policies.contraction.basis import cosine_powers, cosine_rates
from lagros_policies.expert import metric_of
from lagros_policies.tasks.cartpole.metric_design import MetricDesignSettings, tube_samples
from lagros_policies.tasks.cartpole.region import Region
from speed.report import Row, Section, Target, timed_row
from speed.timing import Scale, interleave

FloatArray = NDArray[np.float64]

# Samples of these benchmarks, apart from those of the shipped metric.
_NAMESPACE = 0x736470
_PLANS = 20
_DEGREES = (0, 4)
_SAMPLES = 200
# Seconds that the program of each degree may take with so many samples.
_LIMITS = {0: 1.0, 4: 4.0}
_BATCH = 10_000
_BATCH_LIMIT = 0.2
# Where I <= W_bar <= chi I is imposed, as in `design_metric`.
_BOUND_ANGLES = 25


@dataclass(frozen=True)
class _Stated:
    """W_bar and nu in scaled states as cvxpy found them, and Clarabel's own time [s]."""

    coefficients: FloatArray
    control_weight: float
    solver_s: float


def sections(scale: Scale) -> list[Section]:
    """Measure and return the table."""
    system = task.CartPoleSettings().system
    drawn = tube_samples(
        MetricDesignSettings(plans=_PLANS), task.CartPoleSettings(), _NAMESPACE, _SAMPLES
    )
    rows: list[Row] = []
    gaps: list[float] = []
    targets: list[Target] = []
    for degree in _DEGREES:
        for count in scale.samples:
            pair, gap = _compare(system, drawn.take(np.arange(count)), degree, scale.designs)
            rows += pair
            gaps.append(gap)
            median = pair[0].median_s
            if count == _SAMPLES and median is not None:
                what = f"CV-STEM, degree {degree}, {count} samples"
                targets.append(Target(what, median, _LIMITS[degree], "s"))
    targets.append(Target("CV-STEM optimum against cvxpy, relative", max(gaps), 1e-3, ""))
    return [
        Section(
            "CV-STEM, one joint semidefinite program over all samples",
            rows,
            targets,
            [
                "Both end in Clarabel; cvxpy states and compiles the program anew. The ratio is to "
                "the row above, as is the gap of the optimum, χ + λν."
            ],
        ),
        _batch(system, scale.designs),
    ]


def _batch(system: System, rounds: int) -> Section:
    """Time u* of a batch of states around plans, under the hold and at will."""
    metric, settings = metric_of(task.CartPoleSettings()), task.CartPoleSettings()
    drawn = tube_samples(MetricDesignSettings(plans=_PLANS), settings, _NAMESPACE, _BATCH)
    rate, place = metric.contraction_rate, (drawn.state, drawn.nominal, drawn.nominal_control)
    held = HeldControl(system, metric, rate, settings.control_period)
    times = interleave(
        {
            "held": lambda _: held(*place),
            "continuous": lambda _: robust_control(system, metric, rate, *place),
        },
        rounds,
    )
    rows = [
        timed_row("over a hold of 0.1 s", times["held"], times["held"]),
        timed_row("at will, equation (17)", times["continuous"], times["held"]),
    ]
    what = f"u* of {_BATCH:,} states"
    return Section(what, rows, [Target(what, times["held"].median, _BATCH_LIMIT, "s")])


def _compare(system: System, samples: Samples, degree: int, rounds: int) -> tuple[list[Row], float]:
    region, settings = Region(), CvStemSettings(degree=degree, scaling=Region.scaling)
    times = interleave(
        {
            "direct": lambda _: design_metric(system, samples, region, settings),
            "cvxpy": lambda _: _state_and_solve(system, samples, region, settings),
        },
        rounds,
    )
    ours: Metric = times["direct"].results[-1]
    theirs: list[_Stated] = times["cvxpy"].results
    units = ours.scaling[:, None] * ours.scaling[None, :]
    cost = _cost(ours.coefficients * units, ours.control_weight, region, settings)
    stated = _cost(theirs[-1].coefficients, theirs[-1].control_weight, region, settings)
    gap = abs(cost / stated - 1.0)
    inner = float(np.median([answer.solver_s for answer in theirs]))
    what = f"degree {degree}, {len(samples.state)} samples"
    remark = f"Clarabel {1e3 * inner:.0f} ms of it, ±{gap:.0e}"
    rows = [
        timed_row(
            f"direct, {what}", times["direct"], times["direct"], f"χ = {ours.condition_bound:.4g}"
        ),
        timed_row(
            f"cvxpy, {what}", times["cvxpy"], times["direct"], remark, solver_s=inner, cost_gap=gap
        ),
    ]
    return rows, gap


def _state_and_solve(
    system: System, samples: Samples, region: Region, settings: CvStemSettings
) -> _Stated:
    """State Theorem 2, equations (14)-(16), sample by sample."""
    scale = np.asarray(settings.scaling)
    n = scale.size
    slopes = state_dependent_coefficient(
        system, samples.state, samples.nominal, samples.nominal_control
    )
    slopes = slopes * scale[:, None] / scale[None, :]
    gains = control_matrix(system, samples.state) * scale[:, None]
    powers = cosine_powers(samples.state[:, ANGLE], settings.degree)
    rates = cosine_rates(samples.state[:, ANGLE], samples.state[:, ANGULAR_RATE], settings.degree)
    coefficients = [cp.Variable((n, n), symmetric=True) for _ in range(settings.degree + 1)]
    weight, condition = cp.Variable(), cp.Variable()
    decay = 2.0 * (settings.contraction_rate + settings.margin)

    def combined(factors: FloatArray) -> cp.Expression:
        return sum(c * w for c, w in zip(factors, coefficients, strict=True))

    constraints = []
    for slope, gain, power, rate in zip(slopes, gains, powers, rates, strict=True):
        dual = combined(power)
        product = slope @ dual
        left = product + product.T - combined(rate) + decay * dual
        constraints.append(left - 2.0 * weight * (gain @ gain.T) << 0)
    for power in cosine_powers(_bound_angles(region, settings), settings.degree):
        dual = combined(power)
        constraints += [dual >> np.eye(n), dual << condition * np.eye(n)]
    problem = cp.Problem(cp.Minimize(condition + settings.control_penalty * weight), constraints)
    with warnings.catch_warnings():
        # "Solution may be inaccurate": Clarabel stops a little short of its tolerance here, as it
        # does when it is called directly.
        warnings.simplefilter("ignore", UserWarning)
        problem.solve(solver=cp.CLARABEL, max_threads=1)
    return _Stated(
        np.stack([coefficient.value for coefficient in coefficients]),
        float(weight.value),
        float(problem.solver_stats.solve_time),
    )


def _cost(
    coefficients: FloatArray, weight: float, region: Region, settings: CvStemSettings
) -> float:
    """Return chi + lambda nu of W_bar in scaled states and nu, whatever their common scale."""
    powers = cosine_powers(_bound_angles(region, settings), settings.degree)
    eigenvalues = np.linalg.eigvalsh(np.einsum("ai,ijk->ajk", powers, coefficients))
    least = float(eigenvalues.min())
    return float(eigenvalues.max()) / least + settings.control_penalty * weight / least


def _bound_angles(region: Region, settings: CvStemSettings) -> FloatArray:
    return np.linspace(0.0, region.angle, _BOUND_ANGLES if settings.degree else 1)
