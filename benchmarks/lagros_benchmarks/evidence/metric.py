"""What is proved and observed of a contraction metric, whatever flies by it.

Asked for is the condition on the box of the metric's design, by interval arithmetic; where that is
not shown in time, the certificate says so, and counts it at states that were drawn. Theorem 1 is of
u* of that metric, answering at every instant; no flight of ours is one.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from lagros_benchmarks.evidence.guaranteed import coordinates
from lagros_benchmarks.evidence.single import Question, UnservedError
from lagros_benchmarks.run.workers import Progress, untold
from lagros_envs.dynamics import control_matrix
from lagros_envs.task import Task
from lagros_policies.contraction import BoxRegion, contraction_residual, load_metric
from lagros_policies.contraction.certificate import Certificate, TubeSizes
from lagros_policies.contraction.metric import extreme_eigenvalues
from lagros_policies.contraction.statement import Statement, at_least, at_most
from lagros_policies.contraction.theorems import feasibility_residual
from lagros_policies.expert import metric_of
from lagros_policies.proof.bounds import ProvedBounds
from lagros_policies.proof.condition import prove

# Whose control the theorems speak of.
IDEAL = "u*"
# States at which the feasibility of u* is checked.
_CHECKS = 10_000


def certify_metric(task: Task, question: Question, tell: Progress = untold) -> Certificate:
    """Return the certificate of a metric of a task of one body: a user's, or the task's own.

    Raises:
        UnservedError: The task has no metric, or `largest` is asked for.
        ValueError: The file is none of its states.
        FileNotFoundError: There is no such file.
    """
    if question.largest:
        raise UnservedError(f"--largest: there is no proof for {task.name} whose region could grow")
    metric = _metric(task, question)
    tell("proof", 0, 1)
    proved, bounds, missing = _proofs(task, metric, question.seconds)
    tell("proof", 1, 1)
    # Those of W_bar are the inverses of those of M.
    most, least = (1.0 / value for value in extreme_eigenvalues(metric))
    gain = _sampled_gain(task, metric) if bounds is None else bounds.control_gain
    radius = task.tube_radius(task.time_limit)
    return Certificate(
        task=task.name,
        policy=IDEAL,
        region=region_of(task, metric.region),
        alpha=metric.contraction_rate,
        chi=most / least,
        nu=metric.control_weight / least,
        b_bar=gain,
        epsilon_l=0.0,
        d_bar=question.bound,
        channels="all",
        basis=", ".join(metric.phi.terms) + f" of the {metric.point}",
        coefficients=metric.coefficients / least,
        tube=TubeSizes(None if radius is None else float(radius), None),
        statements=(*proved, _condition(task, metric), _feasible(task, metric)),
        not_proved=missing,
    )


def _metric(task: Task, question: Question) -> Any:
    if question.metric is not None:
        return load_metric(question.metric, task.system.state_dim)
    try:
        return metric_of(task)
    except ValueError as error:
        raise UnservedError(str(error)) from error


def region_of(task: Task, region: Any) -> dict[str, tuple[float, float]]:
    """Return the bounds of x_d in the region of the metric, by the names of the coordinates."""
    if not isinstance(region, BoxRegion):
        return {}
    ends = zip(region.low, region.high, strict=True)
    return dict(zip(coordinates(task), ends, strict=True))


def _proofs(
    task: Task, metric: Any, most_seconds: float
) -> tuple[list[Statement], ProvedBounds | None, tuple[str, ...]]:
    """Return what was proved, or refuted, of the metric on the box of its design; what was not."""
    missing = "no tube of flights: they hold their control, and all states are disturbed"
    begun = time.monotonic()
    try:
        if not isinstance(metric.region, BoxRegion):
            raise ValueError("its metric was not designed on a box")
        made = prove(task.system, metric, metric.region, most_seconds=most_seconds)
    except (TypeError, ValueError) as error:
        return [], None, (f"no proof for {task.name}: {error}", missing)
    first, bounds = made.statements[0], made.bounds
    lines = [first] if first.holds or first.refuted else []
    if bounds is None:
        missing = f"no proof for {task.name} that W_bar is a metric on the box; {missing}"
    else:
        text = (
            f"{at_least(bounds.least, 6)} I <= W_bar <= {at_most(bounds.largest, 6)} I and "
            f"||B|| <= {at_most(bounds.control_gain, 6)} on the box, in the units of the scaling"
        )
        lines.append(Statement(text, "proved", True, time.monotonic() - begun - first.seconds))
    undecided = () if lines[:1] == [first] else (f"no proof for {task.name} of {first.text}",)
    return lines, bounds, (*undecided, missing)


def _condition(task: Task, metric: Any) -> Statement:
    begun = time.monotonic()
    # Not the check in the metric's file: that may be of another system.
    samples = metric.region.sample(np.random.default_rng(1), _CHECKS)
    left = contraction_residual(task.system, metric, samples)
    failed = int(np.count_nonzero(left >= 0.0))
    text = (
        f"equation (14), alpha = {metric.contraction_rate:g} 1/s, continuous control, at "
        f"{_CHECKS - failed} of {_CHECKS} states drawn from the region (worst "
        f"{float(left.max()):.3g} 1/s; negative holds)"
    )
    return Statement(text, "observed", failed == 0, time.monotonic() - begun)


def _feasible(task: Task, metric: Any) -> Statement:
    begun = time.monotonic()
    samples = metric.region.sample(np.random.default_rng(0), _CHECKS)
    worst = float(feasibility_residual(task.system, metric, samples).max())
    text = (
        f"Theorem 2: the program for u* is feasible, by u_d - nu B'W_bar^-1 e, at all "
        f"{_CHECKS} states drawn from the region (worst {worst:.3g} 1/s; negative is feasible)"
    )
    return Statement(text, "observed", worst <= 0.0, time.monotonic() - begun)


def _sampled_gain(task: Task, metric: Any) -> float:
    """Return b_bar, the largest ||B(x)|| over states drawn from the metric's region (observed)."""
    drawn = metric.region.sample(np.random.default_rng(0), _CHECKS)
    matrices = control_matrix(task.system, drawn.state)
    return float(np.linalg.norm(matrices, ord=2, axis=(1, 2)).max())
