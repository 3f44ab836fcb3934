"""Which loop a statement about flights is of: a policy's law around the motions that it makes.

A tube is proved of one loop around one motion, and is about no other policy: what no tube is known
for has none, and the reason is said.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from lagros_benchmarks.run.library import make_single_policy
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    Law,
    draw_episodes,
    policy_law,
    tracked_by,
    tracking_law,
)
from lagros_envs.arrays import FloatArray
from lagros_envs.task import Scenario, Task
from lagros_policies.expert import Expert
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.proof.network_steering import network_flight
from lagros_policies.proof.plan_tube import PlanTubes, plan_tubes
from lagros_policies.proof.steering import Controller


class TubesOf(Protocol):
    """From d_bar, and what is called with the holds done and all, to the tubes of motions."""

    def __call__(
        self, bound: float, tell: Callable[[int, int], None] | None = None, /
    ) -> PlanTubes:
        """Return the tubes."""


@dataclass(frozen=True)
class Loop:
    """A policy around its undisturbed motions.

    Attributes:
        episodes: What is flown; the plans are the motions.
        law: The policy.
        tubes: From d_bar to the tubes of the motions; None where there are none.
        why: Why there are none; "" where there are.
    """

    episodes: Episodes
    law: Law
    tubes: TubesOf | None
    why: str = ""


def loop_named(name: str, task: Task, seeds: Sequence[int]) -> Loop:
    """Return the loop of a policy by its name in the episodes of some seeds; see `loop_of`."""
    env = gym.make(
        task.env_id, settings=task, max_episode_steps=task.steps, disable_env_checker=True
    )
    return loop_of(make_single_policy(name, env), task, seeds)


def is_spoken_of(policy: Any) -> bool:
    """Return whether a statement of ours may be about the flights of a policy."""
    return tracked_by(policy) is not None or type(policy) is LagrosPolicy


def loop_of(policy: Any, task: Task, seeds: Sequence[int]) -> Loop:
    """Return the loop of a policy in the episodes of some seeds.

    Raises:
        RuntimeError: No episode has a plan.
        UnfitError: The policy keeps a memory of its own.
    """
    tracker = tracked_by(policy)
    episodes = draw_episodes(Expert(task) if tracker is None else tracker, seeds, shown)
    if tracker is not None:
        return _around_plans(policy.name, tracker, episodes)
    law = policy_law(policy, episodes)
    if is_spoken_of(policy):
        return _around_flights(policy, law, episodes)
    why = f"no statement of ours is about {policy.name}: no tube is known for its loop"
    return Loop(episodes, law, None, why)


def _around_plans(name: str, expert: Expert, episodes: Episodes) -> Loop:
    """Return the loop of a law around the plans that it tracks."""
    law = tracking_law(expert, episodes)
    gains = expert.track(episodes.plans, episodes.controls).feedback
    # A projected gain is another law where the projection acts, which nothing here excludes.
    if gains is None or expert.law_name == "projected":
        why = f"no statement of ours is about {name}: no tube is known for a law that is no gain"
        return Loop(episodes, law, None, why)
    return Loop(episodes, law, partial(_tubes, episodes, gains))


def _around_flights(policy: LagrosPolicy, law: Law, episodes: Episodes) -> Loop:
    """Return the loop of a network around what it does when nothing disturbs it."""
    task = episodes.settings
    asked = zip(episodes.initial_states, episodes.goals, episodes.discs, strict=True)
    try:
        flight = network_flight(task, policy.network, [Scenario(*one) for one in asked])
    except (TypeError, ValueError) as error:
        why = f"no statement of ours is about {policy.name} on {task.name}: {error}"
        return Loop(episodes, law, None, why)
    around = replace(episodes, plans=flight.states, controls=flight.controls)
    return Loop(around, law, partial(_tubes, around, flight.steering))


def shown(scenario: Scenario) -> Scenario:
    """Return what a policy is shown of a scenario: its numbers in single precision."""
    return replace(
        scenario,
        **{
            name: np.asarray(getattr(scenario, name), np.float32).astype(np.float64)
            for name in ("initial_state", "goal", "discs")
        },
    )


def _tubes(
    episodes: Episodes,
    law: FloatArray | Controller,
    bound: float,
    tell: Callable[[int, int], None] | None = None,
) -> PlanTubes:
    task = episodes.settings
    return plan_tubes(
        task.system,
        task.control_period,
        episodes.plans,
        episodes.controls,
        law,
        bound,
        directions=directions_of(task),
        control_low=np.array(task.control_low),
        control_high=np.array(task.control_high),
        control_centre=np.array(task.control_centre),
        tell=tell,
    )


def directions_of(task: Task) -> FloatArray:
    """Return the coordinates and, of a body among discs, the diagonals of its plane, (q, n)."""
    found = np.eye(task.system.state_dim)
    if not (task.position and task.most_discs):
        return found
    slanted = np.zeros((2, len(found)))
    slanted[:, list(task.position)] = np.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0]])
    return np.concatenate([found, slanted])
