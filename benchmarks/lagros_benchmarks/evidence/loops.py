"""Which loop a statement about flights is of: a policy's law around the motions that it makes.

A tube is proved of one loop around one motion, and is about no other policy: what no tube is known
for has none, and the reason is said.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from lagros_benchmarks.run.library import make_single_policy
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    Law,
    draw_episodes,
    expert_of,
    policy_law,
    tracked_by,
    tracking_law,
)
from lagros_envs.arrays import FloatArray
from lagros_envs.task import Scenario, Task
from lagros_policies.proof.plan_tube import PlanTubes, plan_tubes


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
    tubes: Callable[[float], PlanTubes] | None
    why: str = ""


def loop_named(name: str, task: Task, seeds: Sequence[int]) -> Loop:
    """Return the loop of a policy by its name in the episodes of some seeds; see `loop_of`."""
    env = gym.make(
        task.env_id, settings=task, max_episode_steps=task.steps, disable_env_checker=True
    )
    return loop_of(make_single_policy(name, env), task, seeds)


def is_spoken_of(policy: Any) -> bool:
    """Return whether a statement of ours may be about the flights of a policy."""
    return tracked_by(policy) is not None


def loop_of(policy: Any, task: Task, seeds: Sequence[int]) -> Loop:
    """Return the loop of a policy in the episodes of some seeds.

    Raises:
        RuntimeError: No episode has a plan.
        UnfitError: The policy keeps a memory of its own.
    """
    tracker = tracked_by(policy)
    expert = expert_of(task) if tracker is None else tracker
    episodes = draw_episodes(expert, seeds, shown)
    if tracker is None:
        why = f"no statement of ours is about {policy.name}: no tube is known for its loop"
        return Loop(episodes, policy_law(policy, episodes), None, why)
    law = tracking_law(tracker, episodes)
    gains = getattr(tracker.track(episodes.plans, episodes.controls), "feedback", None)
    if gains is None:
        why = f"no tube is known for the law of {policy.name}, which is no linear gain"
        return Loop(episodes, law, None, why)
    return Loop(episodes, law, lambda bound: _tubes(task, episodes, gains, bound))


def shown(scenario: Scenario) -> Scenario:
    """Return what a policy is shown of a scenario: its numbers in single precision."""
    return replace(
        scenario,
        **{
            name: np.asarray(getattr(scenario, name), np.float32).astype(np.float64)
            for name in ("initial_state", "goal", "discs")
        },
    )


def _tubes(task: Task, episodes: Episodes, gains: FloatArray, bound: float) -> PlanTubes:
    return plan_tubes(
        task.system,
        task.control_period,
        episodes.plans,
        episodes.controls,
        gains,
        bound,
        directions=directions_of(task),
        control_low=np.array(task.control_low),
        control_high=np.array(task.control_high),
        control_centre=np.array(task.control_centre),
    )


def directions_of(task: Task) -> FloatArray:
    """Return the coordinates and, of a body among discs, the diagonals of its plane, (q, n)."""
    found = np.eye(task.system.state_dim)
    if not (task.position and task.most_discs):
        return found
    slanted = np.zeros((2, len(found)))
    slanted[:, list(task.position)] = np.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0]])
    return np.concatenate([found, slanted])
