"""What the linearised loop predicts of every disturbance: no proof rests on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_benchmarks.evidence.loops import Loop
from lagros_benchmarks.worst_case.flights import fly, parts_of
from lagros_benchmarks.worst_case.goals import loop_slopes
from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import functions
from lagros_envs.task import Task

# Rounds that turn a direction, and the least share of its weights.
_TURNS, _SMALL = 8, 1e-6


@dataclass(frozen=True)
class Prediction:
    """The worst of all sequences ||d_k|| <= d_bar, if the error were linear.

    Attributes:
        error: The largest ||x - x_d||, per unit of d_bar.
        last: The same at the time limit.
        bound: The largest d_bar at which every sequence ends within the radius of success; None
            for a task whose distance from the goal is one of its own.
    """

    error: float
    last: float
    bound: float | None

    @property
    def text(self) -> str:
        """The prediction in words."""
        ends = ""
        if self.bound is not None:
            ends = (
                f", so that whatever the disturbance does up to d_bar = {self.bound:.3g} the goal "
                "is reached at the time limit"
            )
        return (
            f"by linearisation, of which nothing is proved: ||x - x_d|| <= {self.error:.3g} d_bar, "
            f"at the time limit {self.last:.3g} d_bar{ends}"
        )


def prediction_of(loop: Loop) -> Prediction:
    """Return what the loop, linearised along its motions, predicts; the worst of its episodes."""
    flown, task = loop.episodes, loop.episodes.settings
    every = np.arange(len(flown.seeds))
    calm = np.zeros((len(every), task.steps, task.system.state_dim))
    slopes = loop_slopes(flown, loop.law, every, calm, fly(flown, loop.law, every, calm))
    reach = reached(*slopes, np.eye(task.system.state_dim))
    bound = None
    if type(task).goal_distance is Task.goal_distance:
        counted = np.eye(task.system.state_dim)[list(task.position)] if task.position else None
        last = reach[:, -1] if counted is None else reached(*slopes, counted)[:, -1]
        start = task.goal_distance(parts_of(flown.plans[:, -1]), parts_of(flown.goals), functions)
        bound = float(((task.success_radius(task.time_limit) - start) / last).min())
    return Prediction(float(reach.max()), float(reach[:, -1].max()), bound)


def reached(by_state: FloatArray, by_push: FloatArray, output: FloatArray) -> FloatArray:
    """Bound ||C e_k|| of the linear error for all ||d_j|| <= 1, shape (b, N).

    The largest l'C e_k is sum_j ||B_j' l|| with B_j = C A_{k-1} ... A_{j+1} E_j. For any c > 0 its
    square is at most (sum_j c_j) l'(sum_j B_j B_j' / c_j) l, by Cauchy and Schwarz; with c of a
    direction l that no step improves, the two are equal if l is the largest eigenvector.

    Args:
        by_state: A_k of the closed loop, shape (b, N, n, n).
        by_push: E_k, shape (b, N, n, n).
        output: C, shape (r, n).
    """
    count, steps, n, _ = by_state.shape
    maps, found = np.empty((count, 0, n, n)), np.zeros((count, steps))
    for index in range(steps):
        moved = by_state[:, None, index] @ maps
        maps = np.concatenate([moved, by_push[:, None, index]], axis=1)
        parts = output @ maps
        squares = parts @ np.swapaxes(parts, -1, -2)
        weights, best = np.ones(parts.shape[:2]), np.full(count, np.inf)
        for _ in range(_TURNS):
            total = np.einsum("bjrs,bj->brs", squares, 1.0 / weights)
            values, vectors = np.linalg.eigh(total)
            bound = np.sqrt(weights.sum(axis=1) * values[:, -1])
            pulled = np.einsum("bjrs,br->bjs", parts, vectors[..., -1])
            longest = np.linalg.norm(pulled, axis=-1)
            # What a direction does not feel may be felt beside it.
            weights = longest + _SMALL * longest.max(axis=1, keepdims=True)
            best = np.minimum(best, bound)
        found[:, index] = best
    return found
