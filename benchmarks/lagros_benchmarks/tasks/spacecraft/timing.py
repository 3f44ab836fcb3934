"""How long spacecraft policies take: a serial pass, one world at a time, one call per step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_benchmarks.run.flying import Attempt, ask
from lagros_benchmarks.run.keeping import Keepable
from lagros_benchmarks.tasks.spacecraft.episodes import WorldsLoop
from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.task import THRUSTERS
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.policy import BasePolicy

# A joint plan is made once a world, so that the few worlds of the pass would time too few plans.
PLAN_WORLDS = 50


@dataclass(frozen=True)
class Timing(Keepable):
    """Times of calls of `predict`, with the conversion of their results [s].

    Attributes:
        steps: Calls for one agent alone, its decision; of a policy for all agents together, every
            call after the first of an episode.
        batches: Calls for all agents of a world together, at every step.
        plans: First calls of a policy for all agents together, which plans in them; else empty.
        agents: Agents of a world.
        raised: Episodes whose times end with an exception.
    """

    steps: FloatArray
    batches: FloatArray
    plans: FloatArray
    agents: int
    raised: int


def time_policy(env: SpacecraftVectorEnv, policy: BasePolicy, seeds: Sequence[int]) -> Timing:
    """Fly the episodes again, in one world without autoreset, for the times of the calls.

    A local policy is called twice at every step: for all agents of the world, which flies it, and
    for one of them alone with a memory of its own, as it would run on board. The agent changes from
    world to world. What raises ends the times of its episode, and is counted.
    """
    loop = WorldsLoop(env, policy)
    steps: list[float] = []
    batches: list[float] = []
    plans: list[float] = []
    raised = 0
    for index, seed in enumerate(seeds):
        alone = None if policy.observes == "global" else index % env.num_agents
        own: list[float] = []
        with Attempt() as attempt:
            _time_world(loop, seed, alone, own)
        raised += attempt.error is not None
        batches += loop.step_times
        if alone is None:
            plans += loop.step_times[:1]
            steps += loop.step_times[1:]
        else:
            steps += own
    return Timing(np.array(steps), np.array(batches), np.array(plans), env.num_agents, raised)


def time_plans(env: SpacecraftVectorEnv, policy: BasePolicy, seeds: Sequence[int]) -> FloatArray:
    """Return the times of the first calls alone [s], of a policy for all agents together."""
    loop = WorldsLoop(env, policy)
    times: list[float] = []
    for seed in seeds:
        with Attempt():  # as above
            loop.begin([seed])
            loop.decide()
            times += loop.step_times
    return np.array(times)


def _time_world(loop: WorldsLoop, seed: int, alone: int | None, times: list[float]) -> None:
    """Fly a world, and time the calls for one of its agents alone."""
    own_state: Any = None
    loop.begin([seed])
    while not loop.over:
        loop.decide()
        if alone is not None:
            row = loop.observation[alone : alone + 1]
            first = [loop.step == 0]
            _, own_state, seconds = ask(loop.policy, row, own_state, first, (1, THRUSTERS))
            times.append(seconds)
        loop.move()
