"""What an attack breaks, as scores of closed-loop flights, and the slopes of these."""

from __future__ import annotations

import numpy as np

from lagros_benchmarks.worst_case.flights import Episodes, Flights, Law, ahead, parts_of
from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.numbers import functions
from lagros_envs.numbers.dual import gradients, seed

GOALS = ("tube", "success", "clearance")
# Of one body, which has one x_d, besides.
SINGLE_GOALS = (*GOALS, "error")
# Differences of the closed loop. Networks run in float32, whose rounding of an observation times
# the gain must stay far below the step.
_STEP = 1e-3


def profile(
    episodes: Episodes,
    goal: str,
    episode: IntArray,
    states: FloatArray,
    gaps: FloatArray | None = None,
) -> FloatArray:
    """Return what a goal looks at, at every instant; a larger one is worse for the policy.

    Args:
        episodes: The episodes.
        goal: "tube": the distance from x_d in radii r(t) of success, which have the shape of every
            tube of Theorem 1. "success": the distance from x_f less r(t), whose *least* value
            counts. "clearance": by how much the state is beyond what the task allows, or inside a
            disc [m]. "error": ||x - x_d||, of the whole state.
        episode: Which episode each trajectory belongs to, shape (b,).
        states: Shape (b, steps + 1, n).
        gaps: As in `Flights`.

    Returns:
        Shape (b, steps + 1).

    Raises:
        ValueError: The goal is unknown.
    """
    task = episodes.settings
    radius = task.success_radius(task.control_period * np.arange(states.shape[1]))
    parts = parts_of(states)
    if goal == "clearance":
        beyond = np.asarray(task.excess(parts, functions))
        return beyond if gaps is None else np.maximum(beyond, -gaps)
    if goal == "success":
        goals = parts_of(episodes.goals[episode][:, None])
        return np.asarray(task.goal_distance(parts, goals, functions) - radius)
    if goal == "error":
        return np.asarray(np.linalg.norm(states - episodes.plans[episode], axis=-1))
    if goal != "tube":
        raise ValueError(f"goal {goal!r} must be one of {', '.join(SINGLE_GOALS)}")
    # Both may be zero at the start.
    error = tracking_error(episodes, episode, states)
    return np.asarray(error / np.maximum(radius, radius[1] * 1e-6))


def tracking_error(episodes: Episodes, episode: IntArray, states: FloatArray) -> FloatArray:
    """Return how far states (b, steps + 1, n) are from x_d, as the task takes distances."""
    nominal = parts_of(episodes.plans[episode])
    distance = episodes.settings.goal_distance(parts_of(states), nominal, functions)
    return np.asarray(distance)


def scores(
    episodes: Episodes, goal: str, episode: IntArray, flights: Flights
) -> tuple[FloatArray, IntArray]:
    """Return how bad each flight is, shape (b,), and the instant at which it is, shape (b,).

    "clearance" takes the largest of the profile, that of the end with it; "tube" and "error" the
    largest and "success" the least before any fall or collision. Success is broken where that is
    positive. A flight whose policy raised is infinitely bad, whatever the goal.
    """
    values = profile(episodes, goal, episode, flights.states, flights.gaps)
    # The state at the instant of the fall says only how hard the last control was.
    fallen = episodes.settings.fallen(parts_of(flights.states), functions)
    whole = ~fallen & (flights.gaps >= 0.0)
    counted = flights.alive if goal == "clearance" else flights.alive & whole
    if goal == "success":
        values = np.where(counted, values, np.inf)
        instant = np.argmin(values, axis=1)
    else:
        values = np.where(counted, values, -np.inf)
        instant = np.argmax(values, axis=1)
    worst = values[np.arange(len(values)), instant]
    return np.where(np.isnan(flights.controls).any(axis=(1, 2)), np.inf, worst), instant


def gradient(
    episodes: Episodes, law: Law, goal: str, episode: IntArray, pushes: FloatArray, flights: Flights
) -> FloatArray:
    """Return the slope of the score by every push, shape (b, steps, n).

    The adjoint recursion backwards from the instant that decides the score.
    """
    steps, n = episodes.settings.steps, episodes.settings.system.state_dim
    state_slopes, push_slopes = loop_slopes(episodes, law, episode, pushes, flights)
    _, instant = scores(episodes, goal, episode, flights)
    slope = _profile_slope(episodes, goal, episode, flights, instant)
    result = np.zeros((len(episode), steps, n))
    pull = np.zeros((len(episode), n))
    for index in range(steps - 1, -1, -1):
        pull = np.where((instant == index + 1)[:, None], slope, pull)
        result[:, index] = np.einsum("bij,bi->bj", push_slopes[:, index], pull)
        pull = np.einsum("bij,bi->bj", state_slopes[:, index], pull)
    return result


def loop_slopes(
    episodes: Episodes, law: Law, episode: IntArray, pushes: FloatArray, flights: Flights
) -> tuple[FloatArray, FloatArray]:
    """Return the slopes of one closed-loop step by x and by d, each of shape (b, steps, n, n).

    Central differences at all instants of all flights in two batches for each coordinate.
    """
    task = episodes.settings
    steps, n = task.steps, task.system.state_dim
    count = len(episode)
    here = flights.states[:, :-1].reshape(-1, n)
    push = pushes.reshape(-1, n)
    which, step = np.repeat(episode, steps), np.tile(np.arange(steps), count)
    by_state, by_push = np.empty((len(here), n, n)), np.empty((len(here), n, n))
    control = flights.controls.reshape(len(here), -1)
    for column in range(n):
        shift = np.zeros(n)
        shift[column] = _STEP
        ends = [ahead(task, x, law(x, which, step), push) for x in (here + shift, here - shift)]
        by_state[:, :, column] = (ends[0] - ends[1]) / (2.0 * _STEP)
        ends = [ahead(task, here, control, d) for d in (push + shift, push - shift)]
        by_push[:, :, column] = (ends[0] - ends[1]) / (2.0 * _STEP)
    shape = (count, steps, n, n)
    return np.nan_to_num(by_state).reshape(shape), np.nan_to_num(by_push).reshape(shape)


def _profile_slope(
    episodes: Episodes, goal: str, episode: IntArray, flights: Flights, instant: IntArray
) -> FloatArray:
    """Return the slope of the profile by the state at the instant, shape (b, n), up to a factor."""
    task, at = episodes.settings, np.arange(len(episode))
    here = flights.states[at, instant]
    if goal == "clearance":
        beyond = task.excess(seed(list(here.T)), functions)
        slope: FloatArray = gradients([beyond], here.shape[1], here.shape[:1])[:, 0]
        gaps = flights.gaps[at, instant]
        towards = np.where(np.isfinite(gaps)[:, None], _towards_disc(episodes, episode, here), 0.0)
        inner = -gaps > getattr(beyond, "value", beyond)
        return np.where(inner[:, None], towards, slope)
    target = episodes.goals[episode] if goal == "success" else episodes.plans[episode, instant]
    off = here - target
    if task.position and goal != "error":
        counted = np.isin(np.arange(here.shape[1]), task.position)
        off = np.where(counted, off, 0.0)
    return off


def _towards_disc(episodes: Episodes, episode: IntArray, state: FloatArray) -> FloatArray:
    """Return the way from states (b, n) to the nearest disc of each, shape (b, n)."""
    way, discs = np.zeros(state.shape), episodes.discs[episode]
    if discs.shape[1]:
        place = list(episodes.settings.position)
        offsets = discs[:, :, :2] - state[:, None, place]
        away = np.linalg.norm(offsets, axis=-1) - discs[:, :, 2]
        nearest = np.argmin(np.where(discs[:, :, 2] > 0.0, away, np.inf), axis=1)
        way[:, place] = offsets[np.arange(len(state)), nearest]
    return way
