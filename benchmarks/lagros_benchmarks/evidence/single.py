"""The certificate of one body: what is guaranteed of its flights, and what that rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lagros_benchmarks.evidence.calibration import single_statements
from lagros_benchmarks.evidence.guaranteed import Evidence, as_json, errors_of, evidence_of
from lagros_benchmarks.evidence.loops import Loop, loop_named
from lagros_benchmarks.evidence.predicted import prediction_of
from lagros_benchmarks.evidence.records import recorded
from lagros_benchmarks.evidence.words import headline, proved_lines, search_line
from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.worst_case.seeds import CALIBRATION
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Task
from lagros_policies.contraction.certificate import Certificate, TubeSizes
from lagros_policies.contraction.statement import Statement

# Kinds of disturbance of the flights; the calibrated bounds are of the first.
KINDS = ("uniform", "sphere", "gust")
LEVEL = 0.95
# Episodes that a bound of probability 0.95 needs.
LEAST = 19
_THEOREM_ONE = (
    "Theorem 1 gives no tube of these flights: it asks for a control that answers at every "
    "instant, and theirs is held"
)


class UnservedError(ValueError):
    """What is asked for does not exist for the task."""


@dataclass(frozen=True)
class Question:
    """What a certificate is asked for.

    Attributes:
        policy: A policy of the task.
        bound: d_bar, in units of the state per second.
        episodes: Episodes that are to be guaranteed, and of each kind of disturbance (worlds); 0
            for what is known without any.
        metric: A file of the user's own; None for ours.
        seconds: Time for each search for a proof, and for a bound at which there is one [s].
        largest: Whether the largest multiple of the region is claimed that is proved.
    """

    policy: str
    bound: float
    episodes: int
    metric: Path | None = None
    seconds: float = 60.0
    largest: bool = False


def certify(task: Task, question: Question, tell: Progress = untold) -> Certificate:
    """Return the certificate of the flights of a policy on a task of one body.

    Args:
        task: The task.
        question: What is asked.
        tell: Called with what is being done, how much of it is, and of how much.

    Raises:
        ValueError: The policy is unknown, or keeps a memory of its own.
        FileNotFoundError: Its weights have not been made.
        RuntimeError: No episode has a plan.
    """
    policy, bound = question.policy, question.bound
    tell("plans", 0, 1)
    loop = loop_named(policy, task, episode_seeds(1, question.episodes, CALIBRATION))
    tell("plans", 1, 1)
    found = evidence_of(loop, bound, KINDS, most_seconds=question.seconds, tell=tell)
    flown, observed = flown_line(found, loop, policy, bound)
    proved = as_json(found, task)
    lines: list[Statement] = []
    error: float | None = None
    if policy == "lagros":
        error, lines = recorded(task, policy, task.control_unit)
    radius = task.tube_radius(task.time_limit)
    return Certificate.of_flights(
        task=task.name,
        policy=policy,
        epsilon_l=error,
        d_bar=bound,
        tube=TubeSizes(
            None if radius is None else float(radius),
            None if proved is None else proved["norm_bound"],
            observed,
        ),
        statements=(
            *proved_lines(task, loop, found),
            search_line(found),
            *lines,
            flown,
            *calibrated_lines(task, question),
        ),
        not_proved=(*([loop.why] if loop.why else []), _THEOREM_ONE),
        reach="guaranteed flights are proved to stay on their plans to",
        headline=headline(task, loop, found, bound),
        guarantee=proved,
        predicted=() if loop.tubes is None else (prediction_of(loop).text,),
    )


def flown_line(found: Evidence, loop: Loop, policy: str, bound: float) -> tuple[Statement, float]:
    """Return what flights under random disturbance did, and the largest ||x - x_d|| of them."""
    flights = found.flights
    lost = np.concatenate([one.lost for one in flights])
    error = np.concatenate([errors_of(one, loop.episodes.plans) for one in flights])[~lost]
    largest = float(error.max(initial=0.0))
    fell, collided = (
        int(sum(np.count_nonzero(getattr(one, name)) for one in flights))
        for name in ("fallen", "collided")
    )
    task, unplanned = loop.episodes.settings, len(loop.episodes.unplanned)
    text = (
        f"{policy}, held {task.control_period:g} s, d_bar = {bound:g} ({', '.join(KINDS)}): the "
        f"largest ||x - x_d|| of {len(lost)} flights is {largest:.4g}; {fell} fell, "
        + (f"{collided} collided, " if collided else "")
        + f"{unplanned} starts had no plan"
    )
    return Statement(text, "observed", True, found.flight_seconds), largest


def calibrated_lines(task: Task, question: Question) -> Sequence[Statement]:
    """Return the calibrated bounds, where there are enough episodes for them."""
    if question.episodes < LEAST:
        return []
    return single_statements(
        task, LEVEL, question.episodes, question.policy, KINDS[0], question.bound
    )
