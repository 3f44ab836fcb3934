"""Errors at the start: by how much an episode begins beside its plan."""

from __future__ import annotations

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import functions
from lagros_envs.seeding import episode_streams
from lagros_envs.task import Scenario, Task

_HALVINGS = 30


def initial_error(task: Task, scenario: Scenario, seed: int, share: float) -> FloatArray:
    """Return e(0) = x(0) - x_d(0) of an episode, from the stream of its seed.

    It is uniform in the box of +- share * `task.state_scale` (of ones where the task has none), and
    halved until the body neither has fallen nor lies on a disc: a larger share is the same error,
    larger.

    Args:
        task: The task.
        scenario: Of the episode, whose initial state is x_d(0).
        seed: Of the episode.
        share: Of the scale of each coordinate, not negative.

    Returns:
        Shape (n,).
    """
    n = task.system.state_dim
    scale = np.array(task.state_scale or (1.0,) * n)
    error: FloatArray = share * scale * episode_streams(seed).initial_error.uniform(-1.0, 1.0, n)
    for _ in range(_HALVINGS):
        if _may_begin(task, scenario, scenario.initial_state + error):
            return error
        error = 0.5 * error
    return np.zeros(n)


def _may_begin(task: Task, scenario: Scenario, state: FloatArray) -> bool:
    if bool(task.fallen(state.tolist(), functions)):
        return False
    if not (task.position and len(scenario.discs)):
        return True
    away = np.linalg.norm(scenario.discs[:, :2] - state[list(task.position)], axis=1)
    return bool(np.all(away > scenario.discs[:, 2] + task.body_radius))
