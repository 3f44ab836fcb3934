"""The cart-pole in closed loop, in batches, as the target of a search for its worst disturbance.

A law answers any batch of (episode, step, state), so that all sequences of a population fly at
once and the closed loop can be differentiated at every step of a flight in one call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.flying import AnswerError, Attempt, ask
from lagros_envs.disturbances import Disturbance, onto_unit_sphere
from lagros_envs.dynamics import hold_step
from lagros_envs.seeding import episode_streams
from lagros_envs.tasks.cartpole import task
from lagros_policies.contraction import ContractionMetric
from lagros_policies.tasks.cartpole.expert import CartPoleExpert

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
# (states (b, 4), episodes (b,), steps (b,)) -> forces (b, 1) [N].
Law = Callable[[FloatArray, IntArray, IntArray], FloatArray]

GOALS = ("tube", "success", "clearance")
# Differences of the closed loop. Networks run in float32, whose rounding of an observation times
# the gain must stay far below the step.
_STEP = 1e-3


class UnfitError(ValueError):
    """A policy is not one that a search can fly: many episodes at a time, without a memory."""


@dataclass(frozen=True)
class Episodes:
    """What the episodes ask for.

    Attributes:
        settings: The task.
        seeds: Seed of each episode.
        initial_states: x(0), shape (e, 4).
        goals: x_f, shape (e, 4).
        plans: x_d at every control instant, shape (e, steps + 1, 4).
        controls: u_d, shape (e, steps, 1) [N].
        unplanned: Seeds of the episodes that have no plan and cannot be searched.
    """

    settings: task.CartPoleSettings
    seeds: tuple[int, ...]
    initial_states: FloatArray
    goals: FloatArray
    plans: FloatArray
    controls: FloatArray
    unplanned: tuple[int, ...] = ()


@dataclass(frozen=True)
class Flights:
    """Closed-loop trajectories. One whose policy raised counts as fallen from there on.

    Attributes:
        states: x at every control instant, shape (b, steps + 1, 4); after a fall as at the fall.
        forces: u, shape (b, steps, 1) [N]; nan where the policy raised.
        alive: Whether the pole had not fallen *before* the instant, shape (b, steps + 1).
        fallen: Whether it fell, shape (b,).
    """

    states: FloatArray
    forces: FloatArray
    alive: BoolArray
    fallen: BoolArray


def draw_episodes(expert: CartPoleExpert, seeds: Sequence[int]) -> Episodes:
    """Draw the scenario of each seed, as the environment does, and plan it.

    Raises:
        RuntimeError: No episode has a plan.
    """
    settings = expert.task
    planned = []
    for seed in seeds:
        one = task.sample_scenario(episode_streams(seed).scenario, settings)
        planned.append((seed, one, expert.planner.plan(one.initial_state, one.goal)))
    solved = [entry for entry in planned if entry[2].solved]
    if not solved:
        raise RuntimeError(f"none of the {len(seeds)} episodes has a plan")
    return Episodes(
        settings,
        tuple(seed for seed, _, _ in solved),
        np.stack([one.initial_state for _, one, _ in solved]),
        np.stack([one.goal for _, one, _ in solved]),
        np.stack([plan.states for _, _, plan in solved]),
        np.stack([plan.controls for _, _, plan in solved]),
        tuple(seed for seed, _, plan in planned if not plan.solved),
    )


def random_pushes(episodes: Episodes, kind: str, bound: float) -> FloatArray:
    """Return d as the environment draws it for each episode, shape (e, steps, 4)."""
    settings = episodes.settings
    disturbance = Disturbance(kind, bound, (True,) * task.STATE_DIM)
    drawn = [
        disturbance.realise(
            episode_streams(seed).disturbance, settings.steps, settings.control_period
        )
        for seed in episodes.seeds
    ]
    return np.stack(drawn)


def tracking_law(expert: CartPoleExpert, episodes: Episodes) -> Law:
    """Return u* around the plans: policy (b), whose re-plans confirm the plan it has."""
    tracked = expert.track(episodes.plans, episodes.controls)
    scale = episodes.settings.force_scale

    def law(state: FloatArray, episode: IntArray, step: IntArray) -> FloatArray:
        force = expert.control(tracked, episode, step, state)
        # The environment takes the action in single precision, of the state that it shows.
        return _applied(episodes.settings, force / scale)

    return law


def policy_law(policy: Any, episodes: Episodes) -> Law:
    """Return a policy that keeps no memory as a law.

    Where it raises on a batch, its rows are asked one by one, and the force of a row that raises is
    nan: its flight ends there.

    Raises:
        UnfitError: The policy remembers something between its calls, or answers a batch by
            anything but one action for each row.
    """
    settings = episodes.settings
    name = type(policy).__name__

    def asked(rows: NDArray[np.float32]) -> FloatArray:
        starts = np.ones(len(rows), bool)
        try:
            answer = ask(policy, rows, None, starts, (len(rows), 1))
        except AnswerError as error:
            raise UnfitError(
                f"policy {name}: {error}. A search flies many episodes at a time"
            ) from error
        if answer.state is not None:
            raise UnfitError(
                f"policy {name} keeps a memory; a search needs one that does not, or tube-mpc"
            )
        return _applied(settings, answer.action)

    def law(state: FloatArray, episode: IntArray, step: IntArray) -> FloatArray:
        rows = np.empty((len(state), task.OBSERVATION_DIM), np.float32)
        rows[:, task.STATE] = state
        rows[:, task.GOAL] = episodes.goals[episode]
        rows[:, task.INITIAL_STATE] = episodes.initial_states[episode]
        rows[:, task.TIME] = step * settings.control_period
        with Attempt(UnfitError):
            return asked(rows)
        forces = np.full((len(rows), 1), np.nan)
        for row in range(len(rows) if len(rows) > 1 else 0):
            with Attempt(UnfitError):
                forces[row] = asked(rows[row : row + 1])[0]
        return forces

    return law


def fly(episodes: Episodes, law: Law, episode: IntArray, pushes: FloatArray) -> Flights:
    """Fly a batch in closed loop under given disturbances.

    Args:
        episodes: The episodes.
        law: The policy.
        episode: Which episode each flight belongs to, shape (b,).
        pushes: d, shape (b, steps, 4), in units of the state per second.
    """
    settings = episodes.settings
    state = episodes.initial_states[episode]
    states = np.empty((len(episode), settings.steps + 1, task.STATE_DIM))
    forces = np.zeros((len(episode), settings.steps, 1))
    alive = np.ones(states.shape[:2], bool)
    states[:, 0] = state
    up = np.ones(len(episode), bool)
    for step in range(settings.steps):
        force = law(state, episode, np.full(len(episode), step))
        with np.errstate(over="ignore", invalid="ignore"):
            following = hold_step(
                settings.system, state, force, settings.control_period, pushes[:, step]
            )
            distance = task.goal_distance(following.T, episodes.goals[episode].T, np.sqrt)
        sane = distance <= task.LARGEST_DISTANCE
        state = np.where((up & sane)[:, None], following, state)
        forces[:, step] = np.where(up[:, None], force, 0.0)
        alive[:, step + 1] = up
        up = up & sane & (np.abs(state[:, 1]) <= task.FALL_ANGLE)
        states[:, step + 1] = state
    return Flights(states, forces, alive, ~up)


def profile(episodes: Episodes, goal: str, episode: IntArray, states: FloatArray) -> FloatArray:
    """Return what a goal looks at, at every instant; a larger one is worse for the policy.

    Args:
        episodes: The episodes.
        goal: "tube": ||x - x_d|| in radii of the published tube, which has the shape of every tube
            of Theorem 1. "success": ||x - x_f|| - r(t), whose *least* value counts. "clearance":
            |theta| - pi/2 [rad], from which on the pole has fallen.
        episode: Which episode each trajectory belongs to, shape (b,).
        states: Shape (b, steps + 1, 4).

    Returns:
        Shape (b, steps + 1).

    Raises:
        ValueError: The goal is unknown.
    """
    settings = episodes.settings
    radius = settings.tube.radius(settings.control_period * np.arange(states.shape[1]))
    if goal == "clearance":
        return np.abs(states[..., 1]) - task.FALL_ANGLE
    if goal == "success":
        gap = np.linalg.norm(states - episodes.goals[episode][:, None], axis=-1) - radius
        return np.asarray(gap)
    if goal != "tube":
        raise ValueError(f"goal {goal!r} must be one of {', '.join(GOALS)}")
    error = np.linalg.norm(states - episodes.plans[episode], axis=-1)
    # Both are zero at the start.
    return np.asarray(error / np.maximum(radius, radius[1] * 1e-6))


def scores(
    episodes: Episodes, goal: str, episode: IntArray, flights: Flights
) -> tuple[FloatArray, IntArray]:
    """Return how bad each flight is, shape (b,), and the instant at which it is, shape (b,).

    "clearance" takes the largest of the profile, the fall with it; "tube" the largest and "success"
    the least while the pole is up. Success is broken where that is positive. A flight whose policy
    raised is infinitely bad, whatever the goal.
    """
    values = profile(episodes, goal, episode, flights.states)
    # The state at the instant of the fall says only how hard the last force was.
    upright = np.abs(flights.states[..., 1]) <= task.FALL_ANGLE
    counted = flights.alive if goal == "clearance" else flights.alive & upright
    if goal == "success":
        values = np.where(counted, values, np.inf)
        instant = np.argmin(values, axis=1)
    else:
        values = np.where(counted, values, -np.inf)
        instant = np.argmax(values, axis=1)
    worst = values[np.arange(len(values)), instant]
    return np.where(np.isnan(flights.forces).any(axis=(1, 2)), np.inf, worst), instant


def gradient(
    episodes: Episodes, law: Law, goal: str, episode: IntArray, pushes: FloatArray, flights: Flights
) -> FloatArray:
    """Return the slope of the score by every push, shape (b, steps, 4).

    Central differences of one closed-loop step at all instants of all flights in two batches, then
    the adjoint recursion backwards from the instant that decides the score.
    """
    settings = episodes.settings
    steps, n = settings.steps, task.STATE_DIM
    count = len(episode)
    here = flights.states[:, :-1].reshape(-1, n)
    push = pushes.reshape(-1, n)
    which, step = np.repeat(episode, steps), np.tile(np.arange(steps), count)

    def ahead(state: FloatArray, disturbance: FloatArray, force: FloatArray) -> FloatArray:
        with np.errstate(over="ignore", invalid="ignore"):
            return hold_step(settings.system, state, force, settings.control_period, disturbance)

    by_state, by_push = np.empty((len(here), n, n)), np.empty((len(here), n, n))
    force = flights.forces.reshape(-1, 1)
    for column in range(n):
        shift = np.zeros(n)
        shift[column] = _STEP
        ends = [ahead(x, push, law(x, which, step)) for x in (here + shift, here - shift)]
        by_state[:, :, column] = (ends[0] - ends[1]) / (2.0 * _STEP)
        ends = [ahead(here, d, force) for d in (push + shift, push - shift)]
        by_push[:, :, column] = (ends[0] - ends[1]) / (2.0 * _STEP)
    state_slopes = np.nan_to_num(by_state).reshape(count, steps, n, n)
    push_slopes = np.nan_to_num(by_push).reshape(count, steps, n, n)
    _, instant = scores(episodes, goal, episode, flights)
    slope = _profile_slope(episodes, goal, episode, flights.states, instant)
    result = np.zeros((count, steps, n))
    pull = np.zeros((count, n))
    for index in range(steps - 1, -1, -1):
        pull = np.where((instant == index + 1)[:, None], slope, pull)
        result[:, index] = np.einsum("bij,bi->bj", push_slopes[:, index], pull)
        pull = np.einsum("bij,bi->bj", state_slopes[:, index], pull)
    return result


def _profile_slope(
    episodes: Episodes, goal: str, episode: IntArray, states: FloatArray, instant: IntArray
) -> FloatArray:
    """Return the slope of the profile by the state at the instant, shape (b, 4), up to a factor."""
    at = np.arange(len(states))
    here = states[at, instant]
    if goal == "clearance":
        slope = np.zeros_like(here)
        slope[:, 1] = np.sign(here[:, 1])
        return slope
    target = episodes.goals[episode] if goal == "success" else episodes.plans[episode, instant]
    return here - target


def _applied(settings: task.CartPoleSettings, action: NDArray[Any]) -> FloatArray:
    single = np.asarray(action, np.float32).astype(np.float64)
    force: FloatArray = task.applied_force(settings, single, np.clip)
    return force


@dataclass(frozen=True)
class CartPoleTarget:
    """Episodes of one policy of the cart-pole under one bound, with one goal.

    Attributes:
        flown: The episodes.
        law: The policy.
        goal: One of `GOALS`.
        bound: d_bar, in units of the state per second.
        adversary: A feedback, states and plans (b, 4) to directions (b, 4), whose pushes are tried
            first; None for none.
    """

    flown: Episodes
    law: Law
    goal: str
    bound: float
    adversary: Callable[[FloatArray, FloatArray], FloatArray] | None = None

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.flown.seeds)

    @property
    def steps(self) -> int:
        """Control steps of an episode."""
        return self.flown.settings.steps

    @property
    def channels(self) -> int:
        """Coordinates of d."""
        return task.STATE_DIM

    @property
    def slope_cost(self) -> int:
        """Two closed-loop steps per state, and two per push, at every instant."""
        return 4 * task.STATE_DIM

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return how bad the flights (b,) under d/d_bar (b, steps, 4) are."""
        flights = fly(self.flown, self.law, episode, self.bound * sequences)
        return scores(self.flown, self.goal, episode, flights)[0]

    def slopes(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the slopes of the scores by the sequences, up to a factor."""
        pushes = self.bound * sequences
        flights = fly(self.flown, self.law, episode, pushes)
        return gradient(self.flown, self.law, self.goal, episode, pushes, flights)

    def starts(self) -> FloatArray:
        """Return constant pushes along every axis, and what the adversary did."""
        axes = np.concatenate([np.eye(task.STATE_DIM), -np.eye(task.STATE_DIM)])
        axes = np.repeat(axes[:, None], self.steps, axis=1)
        constant = np.broadcast_to(axes, (self.episodes, *axes.shape))
        if self.adversary is None:
            return constant
        return np.concatenate([constant, self._recorded()[:, None]], axis=1)

    def _recorded(self) -> FloatArray:
        """Fly every episode under the adversary and return d/d_bar, (episodes, steps, 4)."""
        assert self.adversary is not None
        settings, episode = self.flown.settings, np.arange(self.episodes)
        state = self.flown.initial_states
        pushes = np.zeros((self.episodes, self.steps, task.STATE_DIM))
        fallback = np.eye(task.STATE_DIM)[0]
        for step in range(self.steps):
            push = self.adversary(state, self.flown.plans[:, step])
            pushes[:, step] = onto_unit_sphere(np.nan_to_num(push), fallback)
            force = self.law(state, episode, np.full(self.episodes, step))
            with np.errstate(over="ignore", invalid="ignore"):
                state = hold_step(
                    settings.system,
                    state,
                    force,
                    settings.control_period,
                    self.bound * pushes[:, step],
                )
            state = np.clip(np.nan_to_num(state), -task.LARGEST_DISTANCE, task.LARGEST_DISTANCE)
        return pushes


def energy_adversary(
    metric: ContractionMetric,
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return the feedback that pushes along M e, as the disturbance kind "worst" does."""

    def push(state: FloatArray, nominal: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("bij,bj->bi", metric.matrix(state), state - nominal))

    return push
