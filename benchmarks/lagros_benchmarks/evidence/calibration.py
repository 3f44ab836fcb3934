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
from numpy.typing import NDArray

import lagros_policies
from lagros_benchmarks.tasks.cartpole.worst_case import (
    Episodes,
    draw_episodes,
    fly,
    policy_law,
    profile,
    random_pushes,
    tracking_law,
)
from lagros_benchmarks.tasks.spacecraft.episodes import fly_chunk
from lagros_benchmarks.worst_case.seeds import CALIBRATION
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.contraction.conformal import bound_statement, conformal_bound
from lagros_policies.contraction.statement import Statement
from lagros_policies.policy import make
from lagros_policies.tasks.cartpole.expert import CartPoleExpert

FloatArray = NDArray[np.float64]

# Episodes that fly in one batch.
_CHUNK = 500
_WORLDS = 25
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


LEARNING_ERROR = Score("learning_error", "the largest ||u_L - u*|| of an episode", "N")
TUBE = Score("tube", "the largest ||x - x_d|| of an episode", "(norm of the state)")
TUBE_SHARE = Score(
    "tube_share", "the largest ||x - x_d|| / r(t), r the published tube, of an episode", ""
)
POSITION_ERROR = Score(
    "position_error", "the largest ||p - p_d|| of any agent of a world (centralised, u*)", "m"
)
CARTPOLE_SCORES = (LEARNING_ERROR, TUBE, TUBE_SHARE)
SPACECRAFT_SCORES = (POSITION_ERROR,)


@dataclass(frozen=True)
class EpisodeScores:
    """Scores of a run of episodes; inf in an episode that fell, had no plan or raised.

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
    flown with the old one is found under the new name.

    Args:
        task: "cartpole" or "spacecraft"; all networks of the task count, whichever of them fly.
        settings: What else the flights depend on, each with a `repr` that says all of it.
        folder: Where the files lie; that of the shipped ones if None.

    Returns:
        Twelve hexadecimal digits.
    """
    folder = folder or Path(lagros_policies.__file__).parent / "pretrained"
    networks = folder.glob(f"{task}_*.safetensors")
    files = sorted([*networks, *folder.glob(f"{task}_*metric.json")])
    digest = hashlib.sha256(repr(settings).encode())
    for file in files:
        digest.update(f"{file.name}\0".encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:_DIGITS]


def cartpole_scores(
    policy: str = "lagros",
    count: int = 1000,
    namespace: int = CALIBRATION,
    seed: int = 0,
    kind: str = "uniform",
    bound: float = 0.75,
) -> EpisodeScores:
    """Fly episodes of the cart-pole and return their scores.

    Args:
        policy: A policy that keeps no memory, or "tube-mpc".
        count: n, episodes.
        namespace: Of the seeds.
        seed: Seed of the run.
        kind: Kind of the disturbance.
        bound: d_bar, in units of the state per second.

    Returns:
        `CARTPOLE_SCORES` of every episode.
    """
    begun = perf_counter()
    expert = CartPoleExpert()
    seeds = episode_seeds(seed, count, namespace)
    parts = [
        _cartpole_chunk(policy, seeds[at : at + _CHUNK], kind, bound, expert)
        for at in range(0, count, _CHUNK)
    ]
    values = {
        one.name: np.concatenate([part[one.name] for part in parts]) for one in CARTPOLE_SCORES
    }
    failed = int(np.count_nonzero(np.isinf(values[TUBE.name])))
    return EpisodeScores(values, failed, perf_counter() - begun)


def _cartpole_chunk(
    policy: str, seeds: Sequence[int], kind: str, bound: float, expert: CartPoleExpert
) -> dict[str, FloatArray]:
    episodes = draw_episodes(expert, seeds)
    control = tracking_law(expert, episodes)
    law = control if policy == "tube-mpc" else policy_law(_built(policy, expert), episodes)
    every = np.arange(len(episodes.seeds))
    flights = fly(episodes, law, every, random_pushes(episodes, kind, bound))
    error = np.linalg.norm(flights.states - episodes.plans, axis=-1)
    found = {
        LEARNING_ERROR.name: _learning_errors(expert, episodes, flights.states, flights.forces),
        TUBE.name: error.max(axis=1),
        TUBE_SHARE.name: profile(episodes, "tube", every, flights.states).max(axis=1),
    }
    # Whoever fell, or had no plan, is infinitely far away.
    without = np.full(len(episodes.unplanned), np.inf)
    return {
        name: np.concatenate([np.where(flights.fallen, np.inf, values), without])
        for name, values in found.items()
    }


def _learning_errors(
    expert: CartPoleExpert, episodes: Episodes, states: FloatArray, forces: FloatArray
) -> FloatArray:
    """Return the largest |u - u*| along each flight, shape (e,) [N]."""
    tracked = expert.track(episodes.plans, episodes.controls)
    count, steps = forces.shape[:2]
    wanted = expert.control(
        tracked,
        np.repeat(np.arange(count), steps),
        np.tile(np.arange(steps), count),
        states[:, :-1].reshape(-1, task.STATE_DIM),
    )
    return np.asarray(np.abs(forces - wanted.reshape(forces.shape)).max(axis=(1, 2)))


def spacecraft_scores(
    count: int = 200,
    namespace: int = CALIBRATION,
    seed: int = 0,
    kind: str = "uniform",
    bound: float = 0.4,
    preset: str = "paper",
    agents: int = 6,
) -> EpisodeScores:
    """Fly worlds of the centralised policy and return the largest position error of each.

    Args:
        count: n, worlds.
        namespace: Of the seeds.
        seed: Seed of the run.
        kind: Kind of the disturbance.
        bound: d_bar, in units of the state per second.
        preset: Preset of the scenarios.
        agents: Agents of each world.

    Returns:
        `SPACECRAFT_SCORES` of every world.
    """
    begun = perf_counter()

    def worlds(number: int) -> SpacecraftVectorEnv:
        return SpacecraftVectorEnv(
            number * agents,
            agents,
            preset,
            kind,
            bound,
            compiled=False,
            autoreset_mode="disabled",
        )

    policy: Any = make("centralized", worlds(1))
    seeds = episode_seeds(seed, count, namespace)
    scores = []
    for at in range(0, count, _WORLDS):
        for world in fly_chunk(worlds, policy, seeds[at : at + _WORLDS]).worlds:
            errors = [agent.max_position_error for agent in world.agents]
            whole = world.error is None and world.planned and None not in errors
            scores.append(max(e for e in errors if e is not None) if whole else np.inf)
    values = np.array(scores)
    failed = int(np.count_nonzero(np.isinf(values)))
    return EpisodeScores({POSITION_ERROR.name: values}, failed, perf_counter() - begun)


def cartpole_statements(
    level: float = 0.95,
    episodes: int = 1000,
    policy: str = "lagros",
    kind: str = "uniform",
    bound: float = 0.75,
) -> list[Statement]:
    """Return the calibrated lines of the cart-pole's certificate: learning error and tube.

    Args:
        level: Probability of each bound.
        episodes: Calibration episodes; about 10 ms each.
        policy: As for `cartpole_scores`.
        kind: Kind of the disturbance.
        bound: d_bar, in units of the state per second.

    Raises:
        ValueError: There are too few episodes for the level.
    """
    scores = cartpole_scores(policy, episodes, kind=kind, bound=bound)
    return _statements(CARTPOLE_SCORES, scores, level, f"{policy}, {_where(kind, bound)}")


def spacecraft_statements(
    level: float = 0.95, worlds: int = 100, kind: str = "uniform", bound: float = 0.4
) -> list[Statement]:
    """Return the calibrated line of the spacecraft's certificate: the position's tube.

    Args:
        level: Probability of the bound.
        worlds: Calibration worlds; about a second each.
        kind: Kind of the disturbance.
        bound: d_bar, in units of the state per second.

    Raises:
        ValueError: There are too few worlds for the level.
    """
    scores = spacecraft_scores(worlds, kind=kind, bound=bound)
    return _statements(SPACECRAFT_SCORES, scores, level, _where(kind, bound))


def _statements(
    kinds: Sequence[Score], scores: EpisodeScores, level: float, where: str
) -> list[Statement]:
    bounds = [(one, conformal_bound(scores.values[one.name], level)) for one in kinds]
    # All bounds are of the same flights: each line carries its share of their time.
    share = scores.seconds / len(bounds)
    return [bound_statement(one.what, one.unit, bound, where, share) for one, bound in bounds]


def _where(kind: str, bound: float) -> str:
    return f"{kind} disturbance, d_bar = {bound:g}"


def _built(policy: str, expert: CartPoleExpert) -> Any:
    import gymnasium as gym

    import lagros_envs  # noqa: F401  (registers the environment)

    env = gym.make(
        "lagros/CartPole-v0",
        settings=expert.task,
        max_episode_steps=expert.task.steps,
        disable_env_checker=True,
    )
    return make(policy, env)
