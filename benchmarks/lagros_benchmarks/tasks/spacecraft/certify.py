"""The spacecraft's certificate: its exact proofs, and the worlds of `centralized`, which is u*."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from lagros_benchmarks.evidence.calibration import calibrated, conditions
from lagros_benchmarks.evidence.records import recorded
from lagros_benchmarks.evidence.single import KINDS, LEAST, LEVEL, Question, UnservedError
from lagros_benchmarks.tasks.spacecraft.calibration import (
    POSITION_ERROR,
    spacecraft_scores,
)
from lagros_benchmarks.worst_case.seeds import CALIBRATION
from lagros_envs.reading import MOST_TEXT, Record, named, parse_json, read_bytes
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.contraction.certificate import Certificate
from lagros_policies.contraction.double_integrator import AxisMetric, design_axis
from lagros_policies.contraction.metric_files import naming
from lagros_policies.contraction.statement import Statement
from lagros_policies.tasks.spacecraft.certificate import spacecraft_certificate

AXIS_FORMAT = "lagros-axis-metric-1"
# alpha of the spacecraft's policies, in the plane and of the heading [1/s].
_PLANE_RATE, _TURNING_RATE = 2.0, 0.3


def certify(task: SpacecraftSettings, question: Question) -> Certificate:
    """Return the spacecraft's certificate; its proofs are exact and take milliseconds.

    The metric is one of the axes; "lagros" has its recorded learning error, "centralized" is u*.

    Raises:
        UnservedError: `largest` is asked for.
        ValueError: The file is no such metric.
        FileNotFoundError: There is no such file.
    """
    if question.largest:
        raise UnservedError(f"--largest: the proof of {task.name} is for all states already")
    period, policy, bound = task.control_period, question.policy, question.bound
    error, lines = recorded(task, policy, "m/s^2")
    found = spacecraft_certificate(
        load_axis_metric(question.metric, _PLANE_RATE, period),
        load_axis_metric(None, _TURNING_RATE, period),
        task.system,
        disturbance_bound=bound,
        learning_error=error,
        paper_radius=task.tube.steady_radius,
        thrust=task.thrust_scale,
        policy=policy,
    ).with_evidence(lines)
    count = question.episodes
    if count == 0 or question.metric is not None:
        return found
    lines, largest = fly_spacecraft(found, policy, bound, count)
    if count >= LEAST:
        scores = spacecraft_scores(count, kind=KINDS[0], bound=bound)
        lines += calibrated((POSITION_ERROR,), scores, LEVEL, conditions(KINDS[0], bound))
    return found.with_evidence(lines, largest)


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


def fly_spacecraft(
    found: Certificate, policy: str, bound: float, worlds: int
) -> tuple[list[Statement], float]:
    """Fly worlds of the centralised policy, which tracks with u*, against the certified margin.

    A network, if the certificate is a network's, shows no x_d to hold it against.

    Returns:
        The statement, and the largest position error [m].
    """
    begun = time.monotonic()
    margin = float(found.details["tubes"]["position_held_without_learning_error"])
    scores = spacecraft_scores(worlds, CALIBRATION, 1, "uniform", bound).values[POSITION_ERROR.name]
    flown = scores[np.isfinite(scores)]
    largest = float(flown.max(initial=0.0))
    crossed = int(np.count_nonzero(flown > margin))
    unplanned = len(scores) - len(flown)
    text = (
        f"centralized (u*), held 0.1 s, uniform, d_bar = {bound:g}: the largest ||p - p_d|| of "
        f"{worlds} worlds of six agents is {largest:.4g} m; {unplanned} had no plan, "
        f"{crossed} of the others left the certified {margin:.4g} m"
    )
    if policy == "lagros":
        text += "; lagros follows no plan that it could be held against"
    return [Statement(text, "observed", crossed == 0, time.monotonic() - begun)], largest
