"""One body under attack: the target of the search, and its flights in the environment."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import gymnasium as gym
import numpy as np

from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.episodes import TUBE_TOLERANCE
from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.run.library import make_single_policy
from lagros_benchmarks.run.workers import Progress
from lagros_benchmarks.worst_case.aimed import aimed_sequences
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    Flights,
    Law,
    ahead,
    disc_gap,
    draw_episodes,
    fly,
    policy_law,
    random_pushes,
    tracked_by,
    tracking_law,
)
from lagros_benchmarks.worst_case.goals import (
    SINGLE_GOALS,
    gradient,
    loop_slopes,
    scores,
    tracking_error,
)
from lagros_benchmarks.worst_case.replay import Outcome
from lagros_benchmarks.worst_case.search import Found, search
from lagros_benchmarks.worst_case.sequences import Replay
from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.balls import onto_unit_sphere
from lagros_envs.registry import find_task
from lagros_envs.task import LARGEST_DISTANCE, Task
from lagros_policies.contraction import ContractionMetric
from lagros_policies.expert import Expert
from lagros_policies.policy import BasePolicy

# States and plans (b, n) to directions (b, n).
Adversary = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class SingleTarget:
    """Episodes of one policy under one bound, with one goal.

    Attributes:
        flown: The episodes.
        law: The policy.
        goal: One of `SINGLE_GOALS`.
        bound: d_bar, in units of the state per second.
        adversary: A feedback whose pushes are tried first; None for none.
    """

    flown: Episodes
    law: Law
    goal: str
    bound: float
    adversary: Adversary | None = None

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
        return self.flown.settings.system.state_dim

    @property
    def slope_cost(self) -> int:
        """Two closed-loop steps per state, and two per push, at every instant."""
        return 4 * self.channels

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return how bad the flights (b,) under d/d_bar (b, steps, n) are."""
        flights = fly(self.flown, self.law, episode, self.bound * sequences)
        return scores(self.flown, self.goal, episode, flights)[0]

    def slopes(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the slopes of the scores by the sequences, up to a factor."""
        pushes = self.bound * sequences
        flights = fly(self.flown, self.law, episode, pushes)
        return gradient(self.flown, self.law, self.goal, episode, pushes, flights)

    def starts(self) -> FloatArray:
        """Return constant pushes along every axis, what the adversary did, and aimed pushes."""
        axes = np.concatenate([np.eye(self.channels), -np.eye(self.channels)])
        axes = np.repeat(axes[:, None], self.steps, axis=1)
        constant = np.broadcast_to(axes, (self.episodes, *axes.shape))
        found = [constant]
        if self.adversary is not None:
            found.append(self._recorded(self.adversary)[:, None])
        return np.concatenate([*found, self._aimed()], axis=1)

    def _aimed(self) -> FloatArray:
        """Return what is worst for the loop linearised along its calm flight, for every output."""
        every = np.arange(self.episodes)
        calm = np.zeros((self.episodes, self.steps, self.channels))
        flights = fly(self.flown, self.law, every, calm)
        return aimed_sequences(*loop_slopes(self.flown, self.law, every, calm, flights))

    def _recorded(self, adversary: Adversary) -> FloatArray:
        """Fly every episode under the adversary and return d/d_bar, (episodes, steps, n)."""
        task, episode = self.flown.settings, np.arange(self.episodes)
        state = self.flown.initial_states
        pushes = np.zeros((self.episodes, self.steps, self.channels))
        fallback = np.eye(self.channels)[0]
        for step in range(self.steps):
            push = adversary(state, self.flown.plans[:, step])
            pushes[:, step] = onto_unit_sphere(np.nan_to_num(push), fallback)
            control = self.law(state, episode, np.full(self.episodes, step))
            state = ahead(task, state, control, self.bound * pushes[:, step])
            state = np.clip(np.nan_to_num(state), -LARGEST_DISTANCE, LARGEST_DISTANCE)
        return pushes


def energy_adversary(metric: ContractionMetric) -> Adversary:
    """Return the feedback that pushes along M e, as the disturbance kind "worst" does."""

    def push(state: FloatArray, nominal: FloatArray) -> FloatArray:
        place = nominal if getattr(metric, "point", "state") == "nominal" else state
        return np.asarray(np.einsum("bij,bj->bi", metric.matrix(place), state - nominal))

    return push


class SingleBench:
    """Episodes, policy and certificate of an attack on one body.

    Args:
        settings: An `AttackSettings`.

    Attributes:
        shape: Of the pushes of one episode.
    """

    population = 30
    goals = SINGLE_GOALS

    def __init__(self, settings: Any) -> None:
        self.settings = settings
        self.task = cast(Task, find_task(settings.task))
        self.shape = (self.task.steps, self.task.system.state_dim)

    @staticmethod
    def check(settings: Any) -> None:
        """Check what only worlds of many agents have.

        Raises:
            ValueError: The safety filter is asked for.
        """
        for name in ("safety_filter", "proved_filter"):
            if getattr(settings, name):
                raise ValueError(
                    f"{name}=True is for worlds of many agents; leave it out for {settings.task}"
                )

    def prepare(self) -> None:
        """Build everything, and plan the episodes."""
        env: Any = gym.make(self.task.env_id, disable_env_checker=True)
        name = self.settings.policy
        ClosedLoop(env, make_single_policy(name, env)).rehearse(f"policy {name!r}")
        # Another one flies: a policy may count its calls without being told.
        policy: Any = make_single_policy(name, env)
        # The law around its plan stands in for it in a search.
        self.tracks = tracked_by(policy) is not None
        self.policy = policy
        # One whose metric is a network is held against the tube of its own.
        self.expert = cast(Any, self.policy.expert if self.tracks else Expert(self.task))
        if self.tracks:
            # A plan that comes late on a busy machine must not change the figure.
            self.policy.deadline = math.inf
        self.episodes = draw_episodes(self.expert, self.settings.episode_seeds())
        self.metric = self.expert.known_metric
        if self.metric is not None:
            self._tracked = self.expert.track(self.episodes.plans, self.episodes.controls)

    def search(self, tell: Progress) -> list[Found]:
        """Search the worst sequence of every episode."""
        # For tube MPC u* around its plan, which it keeps.
        tracked = tracking_law(self.expert, self.episodes) if self.tracks else None
        target = SingleTarget(
            self.episodes,
            tracked or policy_law(self.policy, self.episodes),
            self.settings.goal,
            self.settings.bound,
            None if self.metric is None else energy_adversary(self.metric),
        )
        return search(target, self.settings.search, self.settings.seed, tell)

    def random(self, kind: str) -> FloatArray:
        """Return the random disturbance of every episode, shape (episodes, steps, n)."""
        return random_pushes(self.episodes, kind, self.settings.bound)

    def replay(self, pushes: FloatArray) -> list[Outcome]:
        """Fly sequences (episodes, steps, n) in the environment."""
        outcomes = []
        for index, one in enumerate(pushes):
            goal = self.settings.goal
            outcome, flight = replay_single(self.episodes, index, self.policy, goal, one)
            if flight is not None:
                measures = {**outcome.measures, **self.measures(flight)}
                if self.metric is not None:
                    measures |= self.of_theorem_one(index, flight)
                outcome = replace(outcome, measures=measures)
            outcomes.append(outcome)
        return outcomes

    def of_theorem_one(self, index: int, flight: Flights) -> dict[str, float | bool | None]:
        """Return what a flight of one episode has to do with Theorem 1.

        The largest ||u - u*|| until it left the region of the metric, and whether it never did;
        what is called certified is None, as no statement of ours is about such a flight.
        """
        plans, controls = self.episodes.plans[[index]], self.episodes.controls[[index]]
        controls = np.concatenate([controls, controls[:, -1:]], axis=1)
        inside = self.metric.region.contains(flight.states, plans, controls) & flight.alive
        steps = np.flatnonzero(np.logical_and.accumulate(inside[0])[:-1])
        error = 0.0
        if len(steps):
            which, states = np.full(len(steps), index), flight.states[0, steps]
            off = flight.controls[0, steps] - self.expert.control(
                self._tracked, which, steps, states
            )
            error = float(np.linalg.norm(off, axis=-1).max())
        return {
            "learning_error": error,
            "in_region": bool(inside.all()),
            **dict.fromkeys(("certified_share", "certified_crossed", "certified_radius")),
        }

    def measures(self, flight: Flights) -> dict[str, float]:
        """Return further figures of a single flight, by name."""
        gap = float(flight.gaps[flight.alive].min())
        return {"least_gap": gap} if math.isfinite(gap) else {}

    def figures(self) -> dict[str, Any]:
        """Return what the row of the attack says besides."""
        return {"unplanned": len(self.episodes.unplanned)}


def replay_single(
    episodes: Episodes, index: int, policy: BasePolicy, goal: str, pushes: FloatArray
) -> tuple[Outcome, Flights | None]:
    """Fly one sequence d (steps, n) in the environment of an episode; the goal as in `profile`.

    Returns:
        The outcome, and the flight for further questions; None where it raised.
    """
    task = episodes.settings
    given = Replay(pushes, task.control_period)
    env: Any = gym.make(
        task.env_id,
        disturbance=given,
        disturbance_bound=given.bound,
        settings=task,
        max_episode_steps=task.steps,
        disable_env_checker=True,
    ).unwrapped
    seed = episodes.seeds[index]
    with Attempt() as attempt:
        flight, info = _flight(env, policy, seed, episodes.plans[index])
    if attempt.error is not None:
        return Outcome(seed, math.inf, True, {}, attempt.error), None
    where = np.array([index])
    score = float(scores(episodes, goal, where, flight)[0][0])
    errors = tracking_error(episodes, where, flight.states)[0][flight.alive[0]]
    radius = task.success_radius(task.control_period * np.arange(len(errors)))
    away = (flight.states - episodes.plans[index])[0][flight.alive[0]]
    lost = bool(flight.lost[0])
    left = lost or bool(np.any(errors > radius + TUBE_TOLERANCE))
    broken = {
        "tube": left,
        "error": left,
        "success": not info["success"],
        "clearance": lost,
    }[goal]
    measures: dict[str, float | bool | None] = {
        "success": bool(info["success"]),
        "strict_success": not lost and bool(info["inside_tube"]),
        "fallen": bool(flight.fallen[0]),
        **({"collided": bool(flight.collided[0])} if "collided" in info else {}),
        "left_paper_tube": None if task.tube_radius(0.0) is None else left,
        "max_tracking_error": float(np.linalg.norm(away, axis=-1).max()),
    }
    return Outcome(seed, score, bool(broken), measures), flight


def _flight(
    env: Any, policy: BasePolicy, seed: int, nominal: FloatArray
) -> tuple[Flights, dict[str, Any]]:
    task: Task = env.settings
    loop = ClosedLoop(env, policy)
    states = np.empty((1, task.steps + 1, task.system.state_dim))
    controls = np.zeros((1, task.steps, task.system.control_dim))
    alive = np.zeros(states.shape[:2], bool)
    gaps = np.full(states.shape[:2], np.inf)
    for _ in loop.fly(seed, {"nominal": nominal}):
        step = loop.step
        states[0, step:], alive[0, step] = env.state, True
        discs = task.all_discs(env.scenario.discs)[None]
        gaps[:, step] = disc_gap(task, states[:, max(step - 1, 0)], states[:, step], discs)
        if step:
            controls[0, step - 1] = task.control(loop.action.astype(np.float64))
    fallen, collided = (
        np.array([bool(loop.info.get(name, False))]) for name in ("fallen", "collided")
    )
    return Flights(states, controls, alive, fallen, collided, gaps), loop.info
