"""Episode scores for calibrated bounds: the learning error and the tube, one number per episode.

The episodes belong to namespaces of their own, one for the calibration and one for its check, so
that no figure comes from an episode on which a policy was trained or is judged.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import lagros_policies
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    Flights,
    draw_episodes,
    fly,
    law_of,
    random_pushes,
)
from lagros_benchmarks.worst_case.goals import profile
from lagros_benchmarks.worst_case.seeds import CALIBRATION
from lagros_envs.arrays import FloatArray
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Task
from lagros_policies.contraction.conformal import bound_statement, conformal_bound
from lagros_policies.contraction.statement import Statement
from lagros_policies.expert import Expert

# Episodes that fly in one batch.
_CHUNK = 500
# Hexadecimal digits of a hash in the name of a file.
_DIGITS = 12


@dataclass(frozen=True)
class Score:
    """What is bounded per episode.

    Attributes:
        name: Key of the score in results.
        what: In words, for a certificate.
        unit: Unit; "" for none.
    """

    name: str
    what: str
    unit: str


TUBE = Score("tube", "the largest ||x - x_d|| of an episode", "(norm of the state)")
TUBE_SHARE = Score(
    "tube_share", "the largest ||x - x_d|| / r(t), r the published tube, of an episode", ""
)
POSITION = Score("position_error", "the largest ||p - p_d|| of an episode", "m")


@dataclass(frozen=True)
class EpisodeScores:
    """Scores of a run of episodes; inf in one that fell, collided, had no plan or raised.

    Attributes:
        values: One array (n,) per score, by name.
        failed: How many episodes have no finite score.
        seconds: Time that they took [s].
    """

    values: dict[str, FloatArray]
    failed: int
    seconds: float


def pretrained_hash(task: str, *settings: object, folder: Path | None = None) -> str:
    """Return a short hash of the weights and metrics of a task, for the names of kept flights.

    Whoever trains a network or designs a metric anew gets flights of the new one: nothing that was
    flown with the old one is found under the new name. All networks of the task count, shipped or
    in a folder, and the settings, each with a `repr` that says all of it.
    """
    folder = folder or Path(lagros_policies.__file__).parent / "pretrained"
    networks = folder.glob(f"{task}_*.safetensors")
    files = sorted([*networks, *folder.glob(f"{task}_*metric.json")])
    digest = hashlib.sha256(repr(settings).encode())
    for file in files:
        digest.update(f"{file.name}\0".encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:_DIGITS]


def scores_of(task: Task, policy: str = "lagros") -> tuple[Score, ...]:
    """Return what is bounded of the episodes of a task; only (c) has a learning error."""
    error = Score("learning_error", "the largest ||u_L - u*|| of an episode", task.control_unit)
    share = (TUBE_SHARE,) if task.tube_radius(0.0) is not None else ()
    learned = (error,) if policy == "lagros" else ()
    return (*learned, TUBE, *share, *((POSITION,) if task.position else ()))


def single_scores(
    task: Task,
    policy: str = "lagros",
    count: int = 1000,
    namespace: int = CALIBRATION,
    seed: int = 0,
    kind: str = "uniform",
    bound: float | None = None,
) -> EpisodeScores:
    """Fly episodes of one body and return their `scores_of`.

    Args:
        task: The task.
        policy: A policy that keeps no memory, or "tube-mpc".
        count: Episodes.
        namespace: Of the seeds.
        seed: Seed of the run.
        kind: Kind of the disturbance.
        bound: d_bar, in units of the state per second; None for that of the task's commands.
    """
    begun = perf_counter()
    expert = Expert(task)
    level = task.defaults.bound if bound is None else bound
    seeds = episode_seeds(seed, count, namespace)
    parts = [
        _chunk(policy, seeds[at : at + _CHUNK], kind, level, expert)
        for at in range(0, count, _CHUNK)
    ]
    values = {
        one.name: np.concatenate([part[one.name] for part in parts])
        for one in scores_of(task, policy)
    }
    failed = int(np.count_nonzero(np.isinf(values[TUBE.name])))
    return EpisodeScores(values, failed, perf_counter() - begun)


def _chunk(
    policy: str, seeds: Sequence[int], kind: str, bound: float, expert: Any
) -> dict[str, FloatArray]:
    episodes = draw_episodes(expert, seeds)
    task, every = episodes.settings, np.arange(len(episodes.seeds))
    law = law_of(policy, episodes)
    flights = fly(episodes, law, every, random_pushes(episodes, kind, bound))
    error = flights.states - episodes.plans
    found = {
        TUBE.name: np.linalg.norm(error, axis=-1).max(axis=1),
        TUBE_SHARE.name: profile(episodes, "tube", every, flights.states).max(axis=1),
        POSITION.name: np.linalg.norm(error[..., list(task.position)], axis=-1).max(axis=1),
    }
    if policy == "lagros":
        found["learning_error"] = learning_errors(expert, episodes, flights)
    # Whoever fell, collided or had no plan is infinitely far away.
    without = np.full(len(episodes.unplanned), np.inf)
    return {
        one.name: np.concatenate([np.where(flights.lost, np.inf, found[one.name]), without])
        for one in scores_of(task, policy)
    }


def learning_errors(expert: Any, episodes: Episodes, flights: Flights) -> FloatArray:
    """Return the largest ||u - u*|| along each flight, one of each episode, shape (e,)."""
    tracked = expert.track(episodes.plans, episodes.controls)
    count, steps = flights.controls.shape[:2]
    wanted = expert.control(
        tracked,
        np.repeat(np.arange(count), steps),
        np.tile(np.arange(steps), count),
        flights.states[:, :-1].reshape(count * steps, -1),
    )
    off = flights.controls - wanted.reshape(flights.controls.shape)
    return np.asarray(np.linalg.norm(off, axis=-1).max(axis=1))


def single_statements(
    task: Task,
    level: float = 0.95,
    episodes: int = 1000,
    policy: str = "lagros",
    kind: str = "uniform",
    bound: float | None = None,
) -> list[Statement]:
    """Return the calibrated lines of a certificate of one body: learning error and tube.

    Each bound has the probability `level`; for the others see `single_scores`.

    Raises:
        ValueError: There are too few episodes for the level.
    """
    flown = task.defaults.bound if bound is None else bound
    scores = single_scores(task, policy, episodes, kind=kind, bound=flown)
    where = f"{policy}, {conditions(kind, flown)}"
    return calibrated(scores_of(task, policy), scores, level, where)


def calibrated(
    kinds: Sequence[Score], scores: EpisodeScores, level: float, where: str
) -> list[Statement]:
    """Return a calibrated line, of probability `level`, for each score of what was flown.

    Raises:
        ValueError: There are too few episodes for the level.
    """
    bounds = [(one, conformal_bound(scores.values[one.name], level)) for one in kinds]
    # All bounds are of the same flights: each line carries its share of their time.
    share = scores.seconds / len(bounds)
    return [bound_statement(one.what, one.unit, bound, where, share) for one, bound in bounds]


def conditions(kind: str, bound: float) -> str:
    """Return a disturbance in words."""
    return f"{kind} disturbance, d_bar = {bound:g}"
