"""Random flights: their disturbances, and where a network comes to, for DAgger to plan anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.dynamics import hold_step
from lagros_envs.dynamics.system import components
from lagros_envs.numbers import functions
from lagros_envs.task import LARGEST_CONTROL, Scenario, Task
from lagros_policies.learning.features import seen, view_of
from lagros_policies.learning.networks import Mlp
from lagros_policies.planning.vectors import segment_distance

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Kinds of disturbance whose closed loops fill the tube; `none` would only repeat the plan.
_KINDS = ("uniform", "sphere", "constant", "sinusoid", "gust")
# Of the episodes that end well, so many are planned anew from somewhere; of the others all, from
# some time before their end, as shares of the time limit.
_WELL = 0.3
_BEFORE = (1.0 / 30.0, 0.25)
# So near the time limit nothing is planned.
LATEST = 0.9


def padded_discs(task: Task, episode: Scenario) -> FloatArray:
    """Return the discs of an episode as an observation has them, shape (most discs, 3)."""
    discs = np.zeros((task.most_discs, 3))
    discs[: len(episode.discs)] = episode.discs
    return discs


def draw_pushes(rng: np.random.Generator, count: int, task: Task, bound: float) -> FloatArray:
    """Draw disturbances of episodes, each of a kind and a bound of its own, shape (p, N, n)."""
    # Every bound down to zero: the tube of a small disturbance lies inside that of a large one.
    bounds = bound * rng.random((count, 1, 1))
    n, period = task.system.state_dim, task.control_period
    pushes = np.stack(
        [
            OPEN_LOOP[_KINDS[rng.integers(len(_KINDS))]].realise(rng, task.steps, n, period)
            for _ in range(count)
        ]
    )
    pushes *= bounds
    return pushes


def met_states(
    rng: np.random.Generator,
    task: Task,
    network: Mlp,
    episodes: Sequence[Scenario],
    pushes: FloatArray,
) -> list[tuple[int, int, FloatArray]]:
    """Let a network fly episodes, and pick states of them from which to plan anew.

    Args:
        rng: Random generator.
        task: The task.
        network: The network.
        episodes: What is flown.
        pushes: The disturbances, shape (p, N, n).

    Returns:
        Which episode, the control step and the state x, shape (n,), of each.
    """
    states = flown(task, network, episodes, pushes)
    ended = trouble(task, episodes, states)
    bad = ended.any(axis=1)
    steps = task.steps
    early, late = (max(1, round(share * steps)) for share in _BEFORE)
    before = np.argmax(ended, axis=1) - rng.integers(early, late + 1, len(states))
    step = np.where(bad, before, rng.integers(0, steps, len(states)))
    picked = (bad | (rng.random(len(states)) < _WELL)) & (step <= LATEST * steps)
    return [
        (int(which), int(max(step[which], 0)), states[which, max(step[which], 0)])
        for which in np.flatnonzero(picked)
    ]


def met_along(
    rng: np.random.Generator,
    task: Task,
    network: Mlp,
    plans: Mapping[str, NDArray[Any]],
    bound: float,
) -> FloatArray:
    """Let a network fly the episodes of plans, each under a kind and a bound of its own.

    Args:
        rng: Random generator.
        task: The task.
        network: The network.
        plans: `plan_starts`, `plan_states` and `plan_discs`, as in `ExpertData`.
        bound: Largest bound of the disturbance.

    Returns:
        The states at each control step, shape (p, N, n).
    """
    goals = plans["plan_states"][:, -1]
    discs = [rows[rows[:, 2] > 0.0] for rows in plans["plan_discs"]]
    episodes = [Scenario(*one) for one in zip(plans["plan_starts"], goals, discs, strict=True)]
    pushes = draw_pushes(rng, len(episodes), task, bound)
    return flown(task, network, episodes, pushes)[:, :-1]


def flown(task: Task, network: Mlp, episodes: Sequence[Scenario], pushes: FloatArray) -> FloatArray:
    """Return the states of episodes that a network flies, shape (p, N + 1, n).

    An episode stops where its state is beyond what the task allows.
    """
    layout, see = task.layout, view_of(task)
    low, high = np.maximum(task.control_low, -LARGEST_CONTROL), task.control_high
    observation = np.empty((len(episodes), layout.size), np.float32)
    for row, episode in zip(observation, episodes, strict=True):
        row[layout.goal], row[layout.initial_state] = episode.goal, episode.initial_state
        row[layout.discs] = padded_discs(task, episode).ravel()
    states = np.empty((len(episodes), task.steps + 1, task.system.state_dim))
    states[:, 0] = state = np.stack([episode.initial_state for episode in episodes])
    for step in range(task.steps):
        observation[:, layout.state] = state
        observation[:, layout.time] = step * task.control_period
        features, signs = seen(see, observation)
        control = network(features).astype(np.float64)
        control = np.clip(control if signs is None else control * signs, low, high)
        following = hold_step(task.system, state, control, task.control_period, pushes[:, step])
        down = fallen(task, following) | ~np.isfinite(following).all(axis=1)
        state = np.where(down[:, None], state, following)
        states[:, step + 1] = state
    return states


def trouble(task: Task, episodes: Sequence[Scenario], states: FloatArray) -> BoolArray:
    """Return at which steps episodes collide or are about to fall, shape (p, N)."""
    # Where a state stays as it was, the next one would have fallen.
    ended: BoolArray = np.all(states[:, 1:] == states[:, :-1], axis=-1)
    if task.position and task.most_discs:
        place = states[..., list(task.position)]
        for which, episode in enumerate(episodes):
            centres, radii = episode.discs[:, :2], episode.discs[:, 2]
            gaps = segment_distance(place[which, :-1], place[which, 1:], centres)
            ended[which] |= np.any(gaps < radii + task.body_radius, axis=-1)
    return ended


def fallen(task: Task, states: FloatArray) -> BoolArray:
    """Return which states (s, n) are beyond what the task allows, shape (s,)."""
    found = task.fallen(components(states), functions)
    return np.broadcast_to(np.asarray(found, np.bool_), states.shape[:1])
