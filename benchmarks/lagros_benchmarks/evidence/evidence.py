"""What `lagros certify` asks of others: proofs, recorded errors, and flights."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import lagros_policies
from lagros_envs.dynamics import System
from lagros_envs.reading import MOST_TEXT, Record, named, parse_json, read_bytes
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY, CartPole
from lagros_policies.contraction import Metric, Samples
from lagros_policies.contraction.certificate import Certificate
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.double_integrator import AxisMetric
from lagros_policies.contraction.held_design import HeldDesign, HeldTube, design_held_contained
from lagros_policies.contraction.metric_files import naming
from lagros_policies.contraction.statement import Statement
from lagros_policies.contraction.theorems import contraction_distance
from lagros_policies.contraction.tube_design import (
    ConstantTube,
    PlanBox,
    TubeDesign,
    design_contained,
)
from lagros_policies.proof.box import ProofBox

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

AXIS_FORMAT = "lagros-axis-metric-1"
# The bound that the paper's radius of 3.15 belongs to, by the formula it is computed with.
PAPER_BOUND = 0.075
_ANGLE = (0.0, 1.0, 0.0, 0.0)
# Every plan of the task is in this box from 0.8 s on.
_SETTLED = PlanBox(angle=0.4, velocity=7.5, angular_rate=1.2, force=3.0)
_UPRIGHT = PlanBox(angle=0.05, velocity=0.5, angular_rate=0.1, force=0.5)
_KINDS = ("uniform", "sphere", "gust")
PROVED_FILE = "cartpole_proved_metric.json"
# What is claimed of a metric that was not designed to be proved on a large box.
SMALL_BOX = ProofBox(0.1, 0.5, 0.5, 0.5, angle_error=0.05, angular_rate_error=0.2)
_LEVEL = 0.95


def recorded_error(task: str, policy: str) -> float:
    """Return the largest ||u_L - u*|| of the held-out samples, from the network's own record.

    Args:
        task: "cartpole" [N] or "spacecraft" [m/s^2].
        policy: Name of the network.

    Raises:
        FileNotFoundError: The network has no record.
        ValueError: The record holds no such figure.
    """
    path = Path(lagros_policies.__file__).parent / "pretrained" / f"{task}_{policy}.json"
    try:
        return float(json.loads(path.read_text())["learning_error"]["maximum"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} holds no learning_error: {error}") from error


def recorded_statement(task: str, policy: str, unit: str) -> Statement:
    """Return the recorded learning error as a line of a certificate."""
    error = recorded_error(task, policy)
    text = (
        f"||u_L - u*|| <= {error:.4g} {unit} on the held-out samples of the training of {policy}, "
        "for the u* that it imitates (its record); no bound for other states"
    )
    return Statement(text, "observed", True, 0.0)


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
    from lagros_policies.contraction.double_integrator import design_axis

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


def cartpole_tubes(system: CartPole, bound: float) -> list[ConstantTube]:
    """Design the ellipsoids of the certificate: near the upright, and for all settled plans.

    Where a bound is too large for a tube to keep itself in its box, there is none, and no claim.

    Args:
        system: The cart-pole.
        bound: d_bar of the first; the second is for `PAPER_BOUND`.
    """
    wanted = [
        (
            _UPRIGHT,
            TubeDesign(
                rate=0.4,
                output=_ANGLE,
                disturbance_bound=bound,
                control_penalty=1e-3,
                floor=0.01,
                margin=0.03,
            ),
        ),
        (_SETTLED, TubeDesign(rate=0.6, output=_ANGLE, disturbance_bound=PAPER_BOUND)),
    ]
    tubes = []
    for plan, design in wanted:
        try:
            tubes.append(design_contained(system, plan, design))
        except (InfeasibleError, RuntimeError):
            continue
    return tubes


def cartpole_held_tubes(system: CartPole, bound: float) -> list[HeldTube]:
    """Design the tubes of a held control: near the upright, and for all settled plans.

    Where there is none that keeps itself in its box, there is no claim.

    Args:
        system: The cart-pole.
        bound: d_bar of the first, whose control is held for 20 ms; the second is for `PAPER_BOUND`,
            held for the 0.1 s of the task.
    """
    wanted = [
        (_UPRIGHT, HeldDesign(0.02, 0.4, _ANGLE, disturbance_bound=bound, degree=3)),
        (_SETTLED, HeldDesign(0.1, 0.5, _ANGLE, disturbance_bound=PAPER_BOUND, degree=5)),
    ]
    tubes = []
    for plan, design in wanted:
        try:
            tubes.append(design_held_contained(system, plan, design))
        except (InfeasibleError, RuntimeError):
            continue
    return tubes


@dataclass(frozen=True)
class CartPoleFlights:
    """Episodes of the cart-pole, one row each.

    Attributes:
        states: x at the control instants, shape (e, steps + 1, 4).
        plans: x_d, likewise.
        nominal: u_d, shape (e, steps, 1) [N].
        forces: u, likewise.
        fallen: Which of them fell, shape (e,).
        unplanned: Starts without a plan, which were not flown.
        period: Control period [s].
        seconds: Time taken [s].
    """

    states: FloatArray
    plans: FloatArray
    nominal: FloatArray
    forces: FloatArray
    fallen: BoolArray
    unplanned: int
    period: float
    seconds: float


def fly_cartpole(policy: str, bound: float, count: int) -> CartPoleFlights:
    """Fly episodes of the cart-pole under several kinds of disturbance.

    Args:
        policy: "lagros" or "tube-mpc".
        bound: d_bar, in units of the state per second.
        count: Episodes of each kind.
    """
    from lagros_benchmarks.tasks.cartpole.worst_case import (
        draw_episodes,
        fly,
        policy_law,
        random_pushes,
        tracking_law,
    )
    from lagros_benchmarks.worst_case.seeds import CALIBRATION
    from lagros_envs.seeding import episode_seeds
    from lagros_policies.lagros import LagrosPolicy
    from lagros_policies.tasks.cartpole.expert import CartPoleExpert

    begun = time.monotonic()
    expert = CartPoleExpert()
    episodes = draw_episodes(expert, episode_seeds(1, count, CALIBRATION))
    every = np.arange(len(episodes.seeds))
    tracked = policy == "tube-mpc"
    law = tracking_law(expert, episodes) if tracked else policy_law(LagrosPolicy(), episodes)
    flown = [fly(episodes, law, every, random_pushes(episodes, kind, bound)) for kind in _KINDS]
    return CartPoleFlights(
        states=np.concatenate([flight.states for flight in flown]),
        plans=np.tile(episodes.plans, (len(flown), 1, 1)),
        nominal=np.tile(episodes.controls, (len(flown), 1, 1)),
        forces=np.concatenate([flight.forces for flight in flown]),
        fallen=np.concatenate([flight.fallen for flight in flown]),
        unplanned=len(episodes.unplanned),
        period=episodes.settings.control_period,
        seconds=time.monotonic() - begun,
    )


def met_error(
    flights: CartPoleFlights, system: System, metric: Metric, box: ProofBox
) -> tuple[float, Statement]:
    """Return how far the controls of flights were from contracting ones, in the box.

    Args:
        flights: The flights.
        system: The cart-pole.
        metric: The metric in which a control is to contract.
        box: Where x, x_d and u_d count.

    Returns:
        The largest distance [N], and the line of the certificate.
    """
    begun = time.monotonic()
    state, nominal = flights.states[:, :-1], flights.plans[:, :-1]
    inside = (~flights.fallen)[:, None] & (np.abs(flights.nominal[..., 0]) <= box.force)
    limits = {ANGLE: box.angle, VELOCITY: box.velocity, ANGULAR_RATE: box.angular_rate}
    for place, limit in limits.items():
        inside &= (np.abs(state[..., place]) <= limit) & (np.abs(nominal[..., place]) <= limit)
    error = np.abs(state - nominal)
    inside &= error[..., ANGLE] <= box.angle_error
    inside &= error[..., ANGULAR_RATE] <= box.angular_rate_error
    # At e = 0 nothing is asked of the control.
    inside &= error.max(axis=-1) > 0.0
    samples = Samples(state[inside], nominal[inside], flights.nominal[inside])
    distance = contraction_distance(system, metric, samples, flights.forces[inside])
    largest = float(distance.max(initial=0.0))
    text = (
        f"at the {len(distance)} instants of {len(state)} episodes that lay in the region, the "
        f"control was within {largest:.4g} N of one that contracts in this metric"
    )
    holds = bool(np.isfinite(largest)) and len(distance) > 0
    return largest, Statement(text, "observed", holds, time.monotonic() - begun)


def tube_line(flights: CartPoleFlights, policy: str, bound: float) -> tuple[Statement, float]:
    """Return what flights were observed to do around x_d, and the largest ||x - x_d||.

    Nothing certified is counted against them: their control is held and all states are disturbed.
    """
    begun = time.monotonic()
    up = ~flights.fallen
    error = np.linalg.norm(flights.states - flights.plans, axis=-1)[up]
    largest = float(error.max(initial=0.0))
    fallen = int(np.count_nonzero(flights.fallen))
    text = (
        f"{policy}, held {flights.period:g} s, d_bar = {bound:g} ({', '.join(_KINDS)}): the "
        f"largest ||x - x_d|| of {len(up)} episodes is {largest:.4g}; {fallen} fell, "
        f"{flights.unplanned} starts had no plan"
    )
    seconds = flights.seconds + time.monotonic() - begun
    return Statement(text, "observed", True, seconds), largest


def calibrated_cartpole(policy: str, bound: float, count: int) -> Sequence[Statement]:
    """Return the calibrated bounds of learning error and tube, for the uniform disturbance."""
    from lagros_benchmarks.evidence.calibration import cartpole_statements

    return cartpole_statements(_LEVEL, count, policy, "uniform", bound)


def fly_spacecraft(
    found: Certificate, policy: str, bound: float, worlds: int
) -> tuple[list[Statement], float]:
    """Fly worlds of the centralised policy, which tracks with u*, against the certified margin.

    Args:
        found: The certificate, with its `position_held_without_learning_error`.
        policy: Whose certificate it is; a network shows no x_d to hold it against.
        bound: d_bar, in units of the state per second.
        worlds: Worlds of six agents.

    Returns:
        The statement, and the largest position error [m].
    """
    from lagros_benchmarks.evidence.calibration import POSITION_ERROR, spacecraft_scores
    from lagros_benchmarks.worst_case.seeds import CALIBRATION

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


def calibrated_spacecraft(bound: float, worlds: int) -> Sequence[Statement]:
    """Return the calibrated bound of the position's tube, for the uniform disturbance."""
    from lagros_benchmarks.evidence.calibration import spacecraft_statements

    return spacecraft_statements(_LEVEL, worlds, "uniform", bound)


def metric_to_prove(path: Path | None) -> tuple[Path | None, bool]:
    """Return which metric to load, and whether the large box is claimed for it.

    Args:
        path: The user's file, which is asked for what ours is; None for ours.
    """
    folder = Path(lagros_policies.__file__).parent / "pretrained"
    ours = folder / PROVED_FILE
    if path is not None:
        return path, ours.exists()
    return (ours, True) if ours.exists() else (None, False)


def cartpole_proofs(
    metric: Metric, most_seconds: float, large: bool
) -> tuple[ProofBox, Sequence[Statement] | None]:
    """Prove (14) and the condition over a hold on the boxes of the shipped metric.

    Args:
        metric: The metric.
        most_seconds: Time for each search [s].
        large: Whether the large boxes are claimed; otherwise the small one, whose proof is left to
            the certificate.

    Returns:
        The box of x, x_d and u_d, and the statements, or None if they are still to be made.
    """
    from lagros_benchmarks.tasks.cartpole.certified_box import merged, prove_multiple

    if not large:
        return SMALL_BOX, None
    box, first, second = prove_multiple(metric, 1.0, most_seconds)
    return box, merged(first, second)
