"""How long spacecraft policies take: a serial pass, one world at a time, one call per step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_benchmarks.run.flying import Attempt, ask, reseed
from lagros_benchmarks.run.library import FloatArray, Policy
from lagros_benchmarks.tasks.spacecraft.episodes import act, is_global
from lagros_envs.tasks.spacecraft.task import THRUSTERS
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

# A joint plan is made once a world, so that the few worlds of the pass would time too few plans.
PLAN_WORLDS = 50


@dataclass(frozen=True)
class Timing:
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


def time_policy(env: SpacecraftVectorEnv, policy: Policy, seeds: Sequence[int]) -> Timing:
    """Fly the episodes again for the times of the calls.

    A local policy is called twice at every step: for all agents of the world, which flies it, and
    for one of them alone with a memory of its own, as it would run on board. The agent changes from
    world to world. What raises ends the times of its episode, and is counted.

    Args:
        env: One world, without autoreset.
        policy: The policy.
        seeds: Seeds of the episodes.

    Returns:
        The times.
    """
    steps: list[float] = []
    batches: list[float] = []
    plans: list[float] = []
    raised = 0
    for index, seed in enumerate(seeds):
        alone = None if is_global(policy) else index % env.num_agents
        times = _WorldTimes([], [])
        with Attempt() as attempt:
            _time_world(env, policy, seed, alone, times)
        raised += attempt.error is not None
        batches += times.batches
        if alone is None:
            plans += times.batches[:1]
            steps += times.batches[1:]
        else:
            steps += times.alone
    return Timing(np.array(steps), np.array(batches), np.array(plans), env.num_agents, raised)


def time_plans(env: SpacecraftVectorEnv, policy: Policy, seeds: Sequence[int]) -> FloatArray:
    """Return the times of the first calls alone [s], of a policy for all agents together."""
    times = []
    for seed in seeds:
        with Attempt():  # as above
            rows, _ = env.reset(seed=[seed])
            times.append(act(policy, env, rows, None, first=True).seconds)
    return np.array(times)


@dataclass(frozen=True)
class _WorldTimes:
    """Times of the calls of one world for all agents, and for one alone."""

    batches: list[float]
    alone: list[float]


def _time_world(
    env: SpacecraftVectorEnv, policy: Policy, seed: int, alone: int | None, times: _WorldTimes
) -> None:
    reseed(policy, seed)
    rows, _ = env.reset(seed=[seed])
    state: Any = None
    own_state: Any = None
    for step in range(env.settings.steps):
        first = step == 0
        action, state, seconds = act(policy, env, rows, state, first)
        times.batches.append(seconds)
        if alone is not None:
            row = rows[alone : alone + 1]
            _, own_state, seconds = ask(policy, row, own_state, [first], (1, THRUSTERS))
            times.alone.append(seconds)
        rows, _, terminated, truncated, _ = env.step(action)
        if (terminated | truncated).any():
            return
