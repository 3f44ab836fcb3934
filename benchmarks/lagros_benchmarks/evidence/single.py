"""The certificate of one body: what is proved, calibrated and observed, and what is not proved.

Asked for is the condition on the box of the metric's design, by interval arithmetic; where that is
not shown in time, the certificate says so, and counts it at states that were drawn.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from lagros_benchmarks.evidence.calibration import single_statements
from lagros_benchmarks.evidence.records import recorded
from lagros_benchmarks.worst_case.flights import (
    Flights,
    draw_episodes,
    expert_of,
    fly,
    law_of,
    random_pushes,
)
from lagros_benchmarks.worst_case.seeds import CALIBRATION
from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.dynamics import control_matrix
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Task
from lagros_policies.contraction import BoxRegion, Samples, contraction_residual, load_metric
from lagros_policies.contraction.certificate import Certificate, TubeSizes
from lagros_policies.contraction.metric import extreme_eigenvalues
from lagros_policies.contraction.statement import Statement, at_least, at_most
from lagros_policies.contraction.theorems import contraction_distance, feasibility_residual
from lagros_policies.proof.bounds import ProvedBounds
from lagros_policies.proof.condition import prove

# Kinds of disturbance of the flights; the calibrated bounds are of the first.
KINDS = ("uniform", "sphere", "gust")
LEVEL = 0.95
# Episodes that a bound of probability 0.95 needs.
LEAST = 19
# States at which the feasibility of u* is checked.
_CHECKS = 10_000


class UnservedError(ValueError):
    """What is asked for does not exist for the task."""


@dataclass(frozen=True)
class Question:
    """What a certificate is asked for.

    Attributes:
        policy: One of the task's `certify_policies`.
        bound: d_bar, in units of the state per second.
        episodes: Episodes of each kind of disturbance (worlds); 0 for none.
        metric: A file of the user's own; None for ours.
        seconds: Time for each search for a proof [s].
        largest: Whether the largest multiple of the region is claimed that is proved.
    """

    policy: str
    bound: float
    episodes: int
    metric: Path | None = None
    seconds: float = 60.0
    largest: bool = False


@dataclass(frozen=True)
class SingleFlights(Flights):
    """Episodes of one body, one row each; attributes as in `Flights`, and these.

    Attributes:
        plans: x_d at the control instants, shape (e, steps + 1, n).
        nominal: u_d, shape (e, steps, m).
        unplanned: Starts without a plan, which were not flown.
        period: Control period [s].
        seconds: Time taken [s].
    """

    plans: FloatArray
    nominal: FloatArray
    unplanned: int
    period: float
    seconds: float


def certify(task: Task, question: Question) -> Certificate:
    """Return the certificate of a task of one body.

    Raises:
        UnservedError: The task has no metric, or `largest` is asked for.
        ValueError: The file is none of its states.
        FileNotFoundError: There is no such file.
    """
    if question.largest:
        raise UnservedError(f"--largest: there is no proof for {task.name} whose region could grow")
    own = question.metric
    flown = None if own is not None and not question.episodes else expert_of(task).metric
    metric: Any = flown if own is None else load_metric(own, task.system.state_dim)
    if metric is None or (flown is None and question.episodes):
        raise UnservedError(
            f"{task.name} has no metric of its own, which a certificate is about and by which u* "
            "flies: give the task a MetricDesign, or --metric a file and --episodes 0"
        )
    proved, bounds, missing = _proofs(task, metric, question.seconds)
    lines = [*proved, _condition(task, metric), _feasible(task, metric)]
    error, record = recorded(task, question.policy, task.control_unit)
    lines += record
    observed = None
    if question.episodes:
        flights = fly_kinds(task, question.policy, question.bound, question.episodes)
        lines.append(met_error(task, flights, metric)[1])
        line, observed = tube_line(flights, question.policy, question.bound)
        lines += [line, *calibrated_lines(task, question)]
    # Those of W_bar are the inverses of those of M.
    most, least = (1.0 / value for value in extreme_eigenvalues(metric))
    gain = _sampled_gain(task, metric) if bounds is None else bounds.control_gain
    radius = task.tube_radius(task.time_limit)
    return Certificate(
        task=task.name,
        policy=question.policy,
        region=region_of(task, metric.region),
        alpha=metric.contraction_rate,
        chi=most / least,
        nu=metric.control_weight / least,
        b_bar=gain,
        epsilon_l=error,
        d_bar=question.bound,
        channels="all",
        basis=", ".join(metric.phi.terms) + f" of the {metric.point}",
        coefficients=metric.coefficients / least,
        tube=TubeSizes(None if radius is None else float(radius), None, observed),
        statements=tuple(lines),
        not_proved=missing,
    )


def region_of(task: Task, region: Any) -> dict[str, tuple[float, float]]:
    """Return the bounds of x_d in the region of the metric, by the names of the coordinates."""
    if not isinstance(region, BoxRegion):
        return {}
    names = task.state_names or tuple(f"x{index}" for index in range(task.system.state_dim))
    ends = zip(region.low, region.high, strict=True)
    return dict(zip((name.partition(" ")[0] for name in names), ends, strict=True))


def _proofs(
    task: Task, metric: Any, most_seconds: float
) -> tuple[list[Statement], ProvedBounds | None, tuple[str, ...]]:
    """Return what was proved, or refuted, of the metric on the box of its design; what was not."""
    missing = f"no tube is certified for {task.name}: its control is held, all states disturbed"
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


def fly_kinds(task: Task, policy: str, bound: float, count: int) -> SingleFlights:
    """Fly so many episodes of one body under each of `KINDS`; see `single_scores`."""
    begun = time.monotonic()
    expert = expert_of(task)
    episodes = draw_episodes(expert, episode_seeds(1, count, CALIBRATION))
    every = np.arange(len(episodes.seeds))
    law = law_of(policy, expert, episodes)
    flown = [fly(episodes, law, every, random_pushes(episodes, kind, bound)) for kind in KINDS]
    return SingleFlights(
        **{
            one.name: np.concatenate([getattr(flight, one.name) for flight in flown])
            for one in fields(Flights)
        },
        plans=np.tile(episodes.plans, (len(flown), 1, 1)),
        nominal=np.tile(episodes.controls, (len(flown), 1, 1)),
        unplanned=len(episodes.unplanned),
        period=task.control_period,
        seconds=time.monotonic() - begun,
    )


def met_error(
    task: Task, flights: SingleFlights, metric: Any, inside: BoolArray | None = None
) -> tuple[float, Statement]:
    """Return how far the controls of flights were from ones that contract in a metric.

    Counted are the instants that are `inside`, shape (e, steps); if None, those in its region.

    Returns:
        The largest distance, in the units of the control, and the line of the certificate.
    """
    begun = time.monotonic()
    state, nominal = flights.states[:, :-1], flights.plans[:, :-1]
    if inside is None:
        inside = np.asarray(metric.region.contains(state, nominal, flights.nominal))
    counted = inside & ~flights.lost[:, None]
    # At e = 0 nothing is asked of the control.
    counted &= np.abs(state - nominal).max(axis=-1) > 0.0
    samples = Samples(state[counted], nominal[counted], flights.nominal[counted])
    distance = contraction_distance(task.system, metric, samples, flights.controls[counted])
    largest = float(distance.max(initial=0.0))
    within = " ".join(part for part in (f"{largest:.4g}", task.control_unit) if part)
    text = (
        f"at the {len(distance)} instants of {len(state)} episodes that lay in the region, the "
        f"control was within {within} of one that contracts in this metric"
    )
    holds = bool(np.isfinite(largest)) and len(distance) > 0
    return largest, Statement(text, "observed", holds, time.monotonic() - begun)


def tube_line(flights: SingleFlights, policy: str, bound: float) -> tuple[Statement, float]:
    """Return what flights were observed to do around x_d, and the largest ||x - x_d||.

    Nothing certified is counted against them: their control is held and all states are disturbed.
    """
    begun = time.monotonic()
    error = np.linalg.norm(flights.states - flights.plans, axis=-1)[~flights.lost]
    largest = float(error.max(initial=0.0))
    collided = int(np.count_nonzero(flights.collided))
    text = (
        f"{policy}, held {flights.period:g} s, d_bar = {bound:g} ({', '.join(KINDS)}): the "
        f"largest ||x - x_d|| of {len(flights.lost)} episodes is {largest:.4g}; "
        f"{int(np.count_nonzero(flights.fallen))} fell, "
        + (f"{collided} collided, " if collided else "")
        + f"{flights.unplanned} starts had no plan"
    )
    seconds = flights.seconds + time.monotonic() - begun
    return Statement(text, "observed", True, seconds), largest


def calibrated_lines(task: Task, question: Question) -> Sequence[Statement]:
    """Return the calibrated bounds, where there are enough episodes for them."""
    if question.episodes < LEAST:
        return []
    return single_statements(
        task, LEVEL, question.episodes, question.policy, KINDS[0], question.bound
    )


def _sampled_gain(task: Task, metric: Any) -> float:
    """Return b_bar, the largest ||B(x)|| over states drawn from the metric's region (observed)."""
    drawn = metric.region.sample(np.random.default_rng(0), _CHECKS)
    matrices = control_matrix(task.system, drawn.state)
    return float(np.linalg.norm(matrices, ord=2, axis=(1, 2)).max())
