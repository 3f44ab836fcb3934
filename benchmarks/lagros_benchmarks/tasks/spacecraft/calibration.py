"""Scores of the spacecraft's worlds for calibrated bounds: the position's tube."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from lagros_benchmarks.evidence.calibration import EpisodeScores, Score
from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.tasks.spacecraft.episodes import fly_chunk, make_worlds
from lagros_benchmarks.worst_case.seeds import CALIBRATION
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.policy import make

POSITION_ERROR = Score(
    "position_error", "the largest ||p - p_d|| of any agent of a world (centralised)", "m"
)
# Worlds that fly in one batch.
_WORLDS = 25


def spacecraft_scores(
    count: int = 200,
    namespace: int = CALIBRATION,
    seed: int = 0,
    kind: str = "uniform",
    bound: float = 0.4,
    preset: str = "paper",
    agents: int = 6,
    policy: str = "centralized",
    tell: Progress = untold,
) -> EpisodeScores:
    """Fly worlds of a centralised policy and return the largest position error of each.

    See `evidence.calibration.single_scores`; preset and agents are those of the worlds, of which
    as many as have flown are told.
    """
    begun = perf_counter()

    def worlds(number: int) -> SpacecraftVectorEnv:
        return make_worlds(number, agents, preset, kind, bound)

    flown: Any = make(policy, worlds(1))
    seeds = episode_seeds(seed, count, namespace)
    scores = []
    for at in range(0, count, _WORLDS):
        tell("calibration", at, count)
        for world in fly_chunk(worlds, flown, seeds[at : at + _WORLDS]).worlds:
            errors = [agent.max_position_error for agent in world.agents]
            whole = world.error is None and world.planned and None not in errors
            scores.append(max(e for e in errors if e is not None) if whole else np.inf)
    tell("calibration", count, count)
    values = np.array(scores)
    failed = int(np.count_nonzero(np.isinf(values)))
    return EpisodeScores({POSITION_ERROR.name: values}, failed, perf_counter() - begun)
