"""The spacecraft's certificate: what is proved of the worlds of `centralized`, and what is not.

`lagros` is a policy learned from re-planned labels. It follows no plan that a tube could surround
and errs from what it imitates by more than any bound could use, so that what is said of it is
calibrated or observed.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from lagros_benchmarks.evidence.calibration import calibrated, conditions
from lagros_benchmarks.evidence.single import KINDS, LEAST, LEVEL, Question, UnservedError
from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.tasks.spacecraft import guaranteed
from lagros_benchmarks.tasks.spacecraft.calibration import (
    POSITION_ERROR,
    spacecraft_scores,
)
from lagros_benchmarks.tasks.spacecraft.episodes import fly_chunk, make_worlds
from lagros_benchmarks.worst_case.seeds import CALIBRATION
from lagros_envs.reading import MOST_TEXT, Record, named, parse_json, read_bytes
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.contraction.certificate import Certificate
from lagros_policies.contraction.double_integrator import AxisMetric, design_axis
from lagros_policies.contraction.metric_files import naming
from lagros_policies.contraction.statement import Statement, at_least
from lagros_policies.policy import make
from lagros_policies.room import found_file
from lagros_policies.tasks.spacecraft.certificate import spacecraft_certificate

AXIS_FORMAT = "lagros-axis-metric-1"
# alpha of the spacecraft's policies, in the plane and of the heading [1/s].
_PLANE_RATE, _TURNING_RATE = 2.0, 0.3
_AGENTS, _PRESET = 6, "paper"
# Worlds that fly in one batch.
_WORLDS = 25


def certify(task: SpacecraftSettings, question: Question, tell: Progress = untold) -> Certificate:
    """Return the spacecraft's certificate; what is proved of its law takes milliseconds.

    Raises:
        UnservedError: `largest` is asked for.
        ValueError: The file is no such metric.
        FileNotFoundError: There is no such file.
    """
    if question.largest:
        raise UnservedError(f"--largest: the proof of {task.name} is for all states already")
    if question.metric is not None:
        return _of_a_metric(task, question, question.metric)
    if question.policy == "lagros":
        return _of_the_network(task, question, tell)
    policy, bound, count = question.policy, question.bound, question.episodes
    flown: Any = make(policy, make_worlds(1, _AGENTS, _PRESET, "none", bound))
    law = flown.tracking
    found = spacecraft_certificate(
        law.plane.metric,
        law.turning.metric,
        task.system,
        disturbance_bound=bound,
        paper_radius=task.tube.steady_radius,
        thrust=task.thrust_scale,
        policy=policy,
        law=law,
    )
    if count == 0:
        return found
    seeds = episode_seeds(1, count, EVALUATION)
    evidence = guaranteed.world_evidence(policy, bound, seeds, tell=tell)
    assert evidence is not None  # the policies of the question track with a gain
    lines = guaranteed.lines(evidence, bound)
    if count >= LEAST:
        scores = spacecraft_scores(count, kind=KINDS[0], bound=bound, policy=policy, tell=tell)
        lines += calibrated((POSITION_ERROR,), scores, LEVEL, conditions(KINDS[0], bound))
    found = replace(
        found,
        headline=guaranteed.headline(evidence, bound),
        guarantee=guaranteed.as_json(evidence),
    )
    return found.with_evidence(lines, float(evidence.error.max(initial=0.0)))


def _of_a_metric(task: SpacecraftSettings, question: Question, path: Path) -> Certificate:
    """Return what is proved of a metric of the user's, which nobody flies."""
    period = task.control_period
    return spacecraft_certificate(
        load_axis_metric(path, _PLANE_RATE, period),
        load_axis_metric(None, _TURNING_RATE, period),
        task.system,
        disturbance_bound=question.bound,
        paper_radius=task.tube.steady_radius,
        thrust=task.thrust_scale,
        policy=question.policy,
    )


def _of_the_network(task: SpacecraftSettings, question: Question, tell: Progress) -> Certificate:
    """Return what is calibrated and observed of `lagros`, beside what its labels' metric is."""
    period, bound, count = task.control_period, question.bound, question.episodes
    line = _labels(task, question.policy)
    found = spacecraft_certificate(
        load_axis_metric(None, _PLANE_RATE, period),
        load_axis_metric(None, _TURNING_RATE, period),
        task.system,
        disturbance_bound=bound,
        paper_radius=task.tube.steady_radius,
        thrust=task.thrust_scale,
        policy=question.policy,
        flown=False,
    )
    found = replace(
        found,
        headline=f"nothing is guaranteed of {question.policy}: it is learned from re-planned "
        "labels, follows no plan, and what is said of it is calibrated or observed",
        not_proved=("any bound for lagros: no tube surrounds what follows no plan",),
    ).with_evidence([line])
    if not count:
        return found
    return found.with_evidence([_share_of_worlds(question.policy, bound, count, tell)])


def _labels(task: SpacecraftSettings, policy: str) -> Statement:
    """Return how the network met its re-planned labels, from its own record.

    Raises:
        FileNotFoundError: The network has no record.
        ValueError: The record holds no such figure.
    """
    path = found_file(task, f"{policy}.json")
    record = Record.load(path, "the record of a network")
    error = record.record("labels_error")
    figures = [error.number(name) for name in ("mean", "p99", "label_mean")]
    text = (
        f"{policy} is within {figures[0]:.3g} m/s^2 on average, {figures[1]:.3g} in 99 of 100, of "
        f"the re-planned labels that it is learned from, of {figures[2]:.3g} on average, on "
        "held-out worlds (its record): not u* of one plan, so that no bound rests on it"
    )
    return Statement(text, "observed", True, 0.0)


def _share_of_worlds(policy: str, bound: float, count: int, tell: Progress) -> Statement:
    """Fly worlds, and bound the share of fresh ones in which all arrive and nobody collides."""
    from scipy.stats import beta

    begun = time.monotonic()
    seeds = episode_seeds(1, count, CALIBRATION)
    flown = make(policy, make_worlds(1, _AGENTS, _PRESET, KINDS[0], bound))
    whole = 0
    for at in range(0, count, _WORLDS):
        tell("worlds", at, count)
        flight = fly_chunk(
            lambda number: make_worlds(number, _AGENTS, _PRESET, KINDS[0], bound),
            flown,
            seeds[at : at + _WORLDS],
        )
        whole += sum(
            world.error is None and all(one.success and not one.collided for one in world.agents)
            for world in flight.worlds
        )
    tell("worlds", count, count)
    least = float(beta.ppf(1.0 - LEVEL, whole, count - whole + 1)) if whole else 0.0
    text = (
        f"{policy}, {conditions(KINDS[0], bound)}: all agents arrive and none collides in {whole} "
        f"of {count} worlds; with a confidence of {LEVEL:g} that is so in at least "
        f"{at_least(100.0 * least, 3)} % of fresh ones (Clopper and Pearson)"
    )
    return Statement(text, "calibrated", True, time.monotonic() - begun)


def load_axis_metric(path: Path | None, rate: float, period: float) -> AxisMetric:
    """Read a metric of the spacecraft's axes, or design the one that the policies use.

    Args:
        path: JSON with `format`, `rate` [1/s], `stiffness` [1/s^2] and `period` [s]; None to
            design.
        rate: alpha of the design [1/s].
        period: Hold of the design [s].

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no such metric, or W would not be positive definite.
    """
    if path is None:
        return design_axis(rate, period)
    data = read_bytes(path, MOST_TEXT)
    try:
        data.decode()
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{named(path)} is no JSON: the spacecraft's metric is one of its axes, a file with "
            f"format {AXIS_FORMAT!r}, rate, stiffness and period; a network is not proved"
        ) from error
    parsed = parse_json(data, named(path), "a metric of the spacecraft's axes")
    record = Record(parsed, named(path))
    record.must("format", AXIS_FORMAT)
    names = ("rate", "stiffness", "period")
    record.only(("format", *names))
    with naming(path):
        return AxisMetric(**{name: record.number(name) for name in names})
