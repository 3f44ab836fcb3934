"""What is guaranteed of the episodes of a benchmark: the figures of its columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_benchmarks.evidence.loops import is_spoken_of, loop_of
from lagros_envs.arrays import FloatArray
from lagros_envs.task import Task
from lagros_policies.proof.guarantee import guarantees


@dataclass(frozen=True)
class Guaranteed:
    """What is proved of one episode.

    Attributes:
        holds: Whether it is guaranteed; see `Guarantees.holds`.
        motion: The motion that its tube surrounds, shape (N + 1, n).
        norm: Bounds of the distance from it, shape (N + 1,); inf where there is no tube.
    """

    holds: bool
    motion: FloatArray
    norm: FloatArray

    def error_bounds(self, nominal: FloatArray | None) -> FloatArray | None:
        """Bound the distance from a nominal (N + 1, n), which need not be the motion itself.

        Returns:
            Shape (N + 1,); None where there is no nominal, or no bound.
        """
        if nominal is None or not np.isfinite(self.norm).all():
            return None
        # A policy plans from what it is shown, which is rounded; the nominal is from the start.
        apart = np.linalg.norm(nominal - self.motion, axis=-1)
        bounds: FloatArray = apart + self.norm
        return bounds


def guaranteed(
    policy: Any, task: Task, seeds: Sequence[int], bound: float
) -> dict[int, Guaranteed] | None:
    """Return what is proved of the episodes of some seeds, by seed.

    Args:
        policy: The policy that flies them.
        task: The task.
        seeds: Of the episodes; one without a plan has no entry.
        bound: d_bar, in units of the state per second.

    Returns:
        None where no statement is about the policy.
    """
    if not is_spoken_of(policy):
        return None
    try:
        loop = loop_of(policy, task, seeds)
    except RuntimeError:  # none of them has a plan
        return {}
    if loop.tubes is None:
        return None
    flown, tubes = loop.episodes, loop.tubes(bound)
    proved = guarantees(task, flown.goals, flown.discs, flown.plans, flown.controls, tubes)
    return {
        seed: Guaranteed(bool(proved.holds[index]), flown.plans[index], proved.norm[index])
        for index, seed in enumerate(flown.seeds)
    }
