"""Closed loops of one body in batches: what searches, calibrations and certificates fly.

A law answers any batch of (episode, step, state), so that all sequences of a population fly at
once and the closed loop can be differentiated at every step of a flight in one call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.flying import AnswerError, Attempt, ask
from lagros_benchmarks.run.library import make_single_policy
from lagros_envs.arrays import BoolArray, FloatArray, IntArray
from lagros_envs.disturbances import Disturbance
from lagros_envs.dynamics import hold_step
from lagros_envs.numbers import functions
from lagros_envs.seeding import episode_streams
from lagros_envs.sweep import closest_approach
from lagros_envs.task import LARGEST_DISTANCE, Scenario, Task, distance_between
from lagros_policies.planning.planner import Planner
from lagros_policies.planning.trajectory import Trajectory
from lagros_policies.tube_mpc import TubeMpcPolicy

# (states (b, n), episodes (b,), steps (b,)) -> controls (b, m).
Law = Callable[[FloatArray, IntArray, IntArray], FloatArray]


class UnfitError(ValueError):
    """A policy is not one that a search can fly: many episodes at a time, without a memory."""


@dataclass(frozen=True)
class Episodes:
    """What the episodes ask for.

    Attributes:
        settings: The task.
        seeds: Seed of each episode.
        initial_states: x(0), shape (e, n).
        goals: x_f, shape (e, n).
        plans: x_d at every control instant, shape (e, steps + 1, n).
        controls: u_d, shape (e, steps, m).
        discs: Centre and radius of each disc, shape (e, k, 3); of radius zero where there is none.
        unplanned: Seeds of the episodes that have no plan and cannot be searched.
    """

    settings: Task
    seeds: tuple[int, ...]
    initial_states: FloatArray
    goals: FloatArray
    plans: FloatArray
    controls: FloatArray
    discs: FloatArray
    unplanned: tuple[int, ...] = ()


@dataclass(frozen=True)
class Flights:
    """Closed-loop trajectories. One whose policy raised counts as fallen from there on.

    Attributes:
        states: x at every control instant, shape (b, steps + 1, n); after an end as at the end.
        controls: u, shape (b, steps, m); nan where the policy raised.
        alive: Whether the flight had not ended *before* the instant, shape (b, steps + 1).
        fallen: Whether the body fell, shape (b,).
        collided: Whether it met a disc, shape (b,).
        gaps: Least distance to a disc [m] on the way to the instant, shape (b, steps + 1); inf
            without any.
    """

    states: FloatArray
    controls: FloatArray
    alive: BoolArray
    fallen: BoolArray
    collided: BoolArray
    gaps: FloatArray

    @property
    def lost(self) -> BoolArray:
        """Whether the flight ended before its time, shape (b,)."""
        return self.fallen | self.collided


def parts_of(states: FloatArray) -> list[FloatArray]:
    """Return the coordinates of states (..., n), as the rules of a task take them."""
    return list(np.moveaxis(states, -1, 0))


def plan_of(planner: Planner, scenario: Scenario) -> Trajectory:
    """Return the plan of a scenario from its start."""
    return planner.plan(scenario.initial_state, scenario.goal, discs=scenario.discs)


def draw_episodes(
    expert: Any, seeds: Sequence[int], shown: Callable[[Scenario], Scenario] | None = None
) -> Episodes:
    """Draw the scenario of each seed, as the environment does, and plan it by the expert's planner.

    Args:
        expert: Whose task and planner.
        seeds: Seed of each episode.
        shown: What the planner is shown of a scenario; None for all of it.

    Raises:
        RuntimeError: No episode has a plan.
    """
    settings = expert.task
    planned = []
    for seed in seeds:
        one = settings.sample(episode_streams(seed).scenario)
        seen = one if shown is None else shown(one)
        planned.append((seed, one, plan_of(expert.planner, seen)))
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
        np.stack([settings.all_discs(one.discs) for _, one, _ in solved]),
        tuple(seed for seed, _, plan in planned if not plan.solved),
    )


def random_pushes(episodes: Episodes, kind: str, bound: float) -> FloatArray:
    """Return d as the environment draws it for each episode, shape (e, steps, n)."""
    settings = episodes.settings
    disturbance = Disturbance(kind, bound, (True,) * settings.system.state_dim)
    drawn = [
        disturbance.realise(
            episode_streams(seed).disturbance, settings.steps, settings.control_period
        )
        for seed in episodes.seeds
    ]
    return np.stack(drawn)


def tracking_law(expert: Any, episodes: Episodes) -> Law:
    """Return u* around the plans: policy (b), whose re-plans confirm the plan it has."""
    tracked = expert.track(episodes.plans, episodes.controls)
    task = episodes.settings

    def law(state: FloatArray, episode: IntArray, step: IntArray) -> FloatArray:
        control = expert.control(tracked, episode, step, state)
        # The environment takes the action in single precision, of the state that it shows.
        return applied(task, task.action(control))

    return law


def policy_law(policy: Any, episodes: Episodes) -> Law:
    """Return a policy that keeps no memory as a law.

    Where it raises on a batch, its rows are asked one by one, and the control of a row that raises
    is nan: its flight ends there.

    Raises:
        UnfitError: The policy remembers something between its calls, or answers a batch by
            anything but one action for each row.
    """
    settings = episodes.settings
    name = type(policy).__name__
    size = settings.system.control_dim

    def asked(rows: NDArray[np.float32]) -> FloatArray:
        starts = np.ones(len(rows), bool)
        try:
            answer = ask(policy, rows, None, starts, (len(rows), size))
        except AnswerError as error:
            raise UnfitError(
                f"policy {name}: {error}. A search flies many episodes at a time"
            ) from error
        if answer.state is not None:
            raise UnfitError(
                f"policy {name} keeps a memory; a search needs one that does not, or tube-mpc"
            )
        return applied(settings, answer.action)

    def law(state: FloatArray, episode: IntArray, step: IntArray) -> FloatArray:
        rows = observed(episodes, state, episode, step)
        with Attempt(UnfitError):
            return asked(rows)
        controls = np.full((len(rows), size), np.nan)
        for row in range(len(rows) if len(rows) > 1 else 0):
            with Attempt(UnfitError):
                controls[row] = asked(rows[row : row + 1])[0]
        return controls

    return law


def tracked_by(policy: Any) -> Any:
    """Return the expert whose law around the first plan a policy flies; None if it does not.

    What a user derives from ours is another law, and so is what plans anew.
    """
    ours = type(policy).__module__.startswith("lagros_policies.")
    keeps = ours and isinstance(policy, TubeMpcPolicy) and policy.keeps_plan
    return policy.expert if keeps and policy.replan_every is None else None


def law_of(name: str, episodes: Episodes) -> Law:
    """Return a policy as a law, by its name; one that tracks a plan is its law around the plans."""
    task = episodes.settings
    env = gym.make(
        task.env_id, settings=task, max_episode_steps=task.steps, disable_env_checker=True
    )
    policy = make_single_policy(name, env)
    expert = tracked_by(policy)
    return policy_law(policy, episodes) if expert is None else tracking_law(expert, episodes)


def observed(
    episodes: Episodes, state: FloatArray, episode: IntArray, step: IntArray
) -> NDArray[np.float32]:
    """Return what the environment shows of states (b, n) at control steps (b,)."""
    task = episodes.settings
    rows = np.zeros((len(state), task.layout.size), np.float32)
    rows[:, task.layout.state] = state
    rows[:, task.layout.goal] = episodes.goals[episode]
    rows[:, task.layout.initial_state] = episodes.initial_states[episode]
    rows[:, task.layout.time] = step * task.control_period
    rows[:, task.layout.discs] = episodes.discs[episode].reshape(len(state), -1)
    return rows


def applied(task: Task, action: NDArray[Any]) -> FloatArray:
    """Return the control (b, m) that an action (b, m) makes, in single precision as it is given."""
    return task.control(np.asarray(action, np.float32).astype(np.float64))


def fly(episodes: Episodes, law: Law, episode: IntArray, pushes: FloatArray) -> Flights:
    """Fly a batch in closed loop, each flight in one of the episodes, shape (b,).

    The pushes are d, shape (b, steps, n), in units of the state per second.
    """
    task, count = episodes.settings, len(episode)
    state, goal, discs = (
        part[episode] for part in (episodes.initial_states, episodes.goals, episodes.discs)
    )
    states = np.empty((count, task.steps + 1, task.system.state_dim))
    controls = np.zeros((count, task.steps, task.system.control_dim))
    alive = np.ones(states.shape[:2], bool)
    gaps = np.full(states.shape[:2], np.inf)
    states[:, 0] = state
    gaps[:, 0] = disc_gap(task, state, state, discs)
    up, fallen = gaps[:, 0] >= 0.0, np.zeros(count, bool)
    for step in range(task.steps):
        control = law(state, episode, np.full(count, step))
        following = ahead(task, state, control, pushes[:, step])
        with np.errstate(over="ignore", invalid="ignore"):
            distance = distance_between(parts_of(following), parts_of(goal), functions)
        sane = distance <= LARGEST_DISTANCE
        before, state = state, np.where((up & sane)[:, None], following, state)
        controls[:, step] = np.where(up[:, None], control, 0.0)
        alive[:, step + 1] = up
        gaps[:, step + 1] = disc_gap(task, before, state, discs)
        fallen |= up & ~(sane & ~task.fallen(parts_of(state), functions))
        up = up & ~fallen & (gaps[:, step + 1] >= 0.0)
        states[:, step + 1] = state
    return Flights(states, controls, alive, fallen, ~up & ~fallen, gaps)


def ahead(task: Task, state: FloatArray, control: FloatArray, push: FloatArray) -> FloatArray:
    """Return the states (b, n) one control period later."""
    with np.errstate(over="ignore", invalid="ignore"):
        return hold_step(task.system, state, control, task.control_period, push)


def disc_gap(task: Task, before: FloatArray, after: FloatArray, discs: FloatArray) -> FloatArray:
    """Return the least distance to a disc on straight ways between states (b, n), shape (b,) [m].

    It is negative inside a disc; inf where there is none, as discs (b, k, 3) of radius zero are.
    """
    if not discs.shape[1]:
        return np.full(len(after), np.inf)
    place = list(task.position)
    ends = np.stack([before[:, place], after[:, place]])[:, :, None] - discs[:, :, :2]
    away = closest_approach(np.moveaxis(ends, -1, 1)) - discs[:, :, 2] - task.body_radius
    return np.asarray(np.where(discs[:, :, 2] > 0.0, away, np.inf).min(axis=1))
