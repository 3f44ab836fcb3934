"""An environment of somebody else's under attack: many copies side by side, one policy.

The score of a flight is what its goal asks for: minus the return, or minus the steps that it took
until the environment ended it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np

from lagros_benchmarks.run.flying import AnswerError, Attempt, ask
from lagros_benchmarks.run.library import make_single_policy
from lagros_benchmarks.run.workers import Progress
from lagros_benchmarks.tasks.foreign.loop import ForeignLoop, fly
from lagros_benchmarks.worst_case.flights import UnfitError
from lagros_benchmarks.worst_case.replay import Outcome
from lagros_benchmarks.worst_case.search import Found, search
from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.disturbances import Disturbance
from lagros_envs.foreign import Foreign
from lagros_envs.registry import find_any
from lagros_envs.seeding import episode_streams
from lagros_policies.policy import BasePolicy

GOALS = ("return", "termination")


class ForeignTarget:
    """Episodes of one policy under one bound, with one goal; see `worst_case.search.Target`.

    Args:
        task: The environment.
        policy: What flies.
        goal: One of `GOALS`.
        bound: d_bar.
        seeds: Of the episodes.
        channels: Which coordinates are pushed.
    """

    slope_cost = 0  # nothing can be differentiated here

    def __init__(
        self,
        task: Foreign,
        policy: BasePolicy,
        goal: str,
        bound: float,
        seeds: list[int],
        channels: tuple[bool, ...],
    ) -> None:
        self._task, self._policy, self._goal, self._bound = task, policy, goal, bound
        self._seeds, self._pushed = seeds, np.flatnonzero(channels)
        self._states = len(channels)
        self._envs: list[Any] = []
        self.episodes, self.steps = len(seeds), task.facts.steps
        self.channels = len(self._pushed)

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return how bad the flights (b,) under d/d_bar (b, steps, channels) are."""
        pushes = self._bound * self.whole(sequences)
        while len(self._envs) < len(pushes):
            self._envs.append(self._task.undisturbed())
        envs = [
            self._task.disturbed(env, push, self._bound, "all")
            for env, push in zip(self._envs, pushes, strict=False)
        ]
        seeds = [self._seeds[index] for index in episode]
        return -_flown(envs, seeds, self._policy, self._goal)

    def whole(self, sequences: FloatArray) -> FloatArray:
        """Return sequences of the channels as ones of the state, (..., n)."""
        full = np.zeros((*sequences.shape[:-1], self._states))
        full[..., self._pushed] = sequences
        return full

    def slopes(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Refuse: there are none."""
        raise NotImplementedError("an environment of somebody else's has no slopes")

    def starts(self) -> FloatArray:
        """Return constant pushes along every axis, both ways."""
        axes = np.concatenate([np.eye(self.channels), -np.eye(self.channels)])
        axes = np.repeat(axes[:, None], self.steps, axis=1)
        return np.broadcast_to(axes, (self.episodes, *axes.shape))

    def close(self) -> None:
        """Release the environments."""
        for env in self._envs:
            env.close()


def _flown(envs: list[Any], seeds: list[int], policy: BasePolicy, goal: str) -> FloatArray:
    """Return the return (b,) of flights side by side, or their steps until they were ended.

    A flight that raises has minus infinity: it is as bad as any.

    Raises:
        UnfitError: The policy keeps a memory, or answers a batch by anything but an action each.
    """
    space = envs[0].action_space
    gained, steps = np.zeros(len(envs)), np.zeros(len(envs))
    seen: list[Any] = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)]
    flying = list(range(len(envs)))
    while flying:
        actions = _asked(policy, [seen[index] for index in flying], space)
        going = []
        for index, action in zip(flying, actions, strict=True):
            with Attempt() as attempt:
                if action is None:
                    raise ValueError("the policy raised")
                seen[index], reward, terminated, truncated, _ = envs[index].step(action)
                gained[index] += float(reward)
                steps[index] += 1
                if not (terminated or truncated):
                    going.append(index)
            if attempt.error is not None:
                gained[index] = steps[index] = -math.inf
        flying = going
    return gained if goal == "return" else steps


def _asked(policy: BasePolicy, rows: list[Any], space: Any) -> list[Any]:
    """Return an action for each row, None for one on which the policy raises alone, too."""

    def asked(some: list[Any]) -> list[Any]:
        starts = np.ones(len(some), bool)
        try:
            answer = ask(policy, np.stack(some), None, starts, (len(some), *space.shape))
        except AnswerError as error:
            raise UnfitError(
                f"policy {policy.name}: {error}. A search flies many episodes at a time"
            ) from error
        if answer.state is not None:
            raise UnfitError(
                f"policy {policy.name} keeps a memory; a search needs one that does not"
            )
        return list(answer.action.astype(space.dtype))

    with Attempt(UnfitError):
        return asked(rows)
    actions: list[Any] = [None] * len(rows)
    for index, row in enumerate(rows):
        with Attempt(UnfitError):
            actions[index] = asked([row])[0]
    return actions


class ForeignBench:
    """Episodes and policy of an attack on an environment of somebody else's.

    Args:
        settings: An `AttackSettings`.

    Attributes:
        shape: Of the pushes of one episode.
    """

    population = 20
    goals = GOALS

    def __init__(self, settings: Any) -> None:
        self.settings = settings
        self.task = cast(Foreign, find_any(settings.task))
        self.seeds: list[int] = settings.episode_seeds()
        self.shape = (self.task.facts.steps, self.task.facts.states)

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
        """Build the policy.

        Raises:
            ValueError: The environment cannot be pushed as it is asked for.
        """
        env = self.task.make("constant", self.settings.bound)
        env.reset(seed=0)
        env.step(env.action_space.sample())
        self.channels = tuple(env.disturbance.channels)
        name = self.settings.policy
        self.policy = make_single_policy(name, env)
        ForeignLoop(env, self.policy).rehearse(f"policy {name!r}")

    def search(self, tell: Progress) -> list[Found]:
        """Search the worst sequence of every episode."""
        goal, bound = self.settings.goal, self.settings.bound
        target = ForeignTarget(self.task, self.policy, goal, bound, self.seeds, self.channels)
        found = search(target, self.settings.search, self.settings.seed, tell)
        target.close()
        return [replace(one, sequence=target.whole(one.sequence)) for one in found]

    def random(self, kind: str) -> FloatArray:
        """Return the random disturbance of every episode, shape (episodes, steps, n)."""
        disturbance = Disturbance(kind, self.settings.bound, self.channels)
        steps, period = self.task.facts.steps, self.task.control_period
        return np.stack(
            [
                disturbance.realise(episode_streams(seed).disturbance, steps, period)
                for seed in self.seeds
            ]
        )

    def replay(self, pushes: FloatArray) -> list[Outcome]:
        """Fly sequences (episodes, steps, n) one after the other."""
        env, outcomes = self.task.undisturbed(), []
        for seed, one in zip(self.seeds, pushes, strict=True):
            given = self.task.disturbed(env, one, self.settings.bound, "all")
            flown = fly(given, self.policy, seed, self.settings.policy, "sequence")
            if flown.error is not None:
                outcomes.append(Outcome(seed, math.inf, True, {}, flown.error))
                continue
            returned = self.settings.goal == "return"
            threshold = self.task.facts.threshold
            short = threshold is not None and flown.total_reward < threshold
            broken = short if returned else flown.terminated
            score = flown.total_reward if returned else flown.length
            measures: dict[str, float | bool | None] = {
                "total_reward": flown.total_reward,
                "length": flown.length,
                "terminated": flown.terminated,
                "success": flown.success,
            }
            outcomes.append(Outcome(seed, -float(score), bool(broken), measures))
        env.close()
        return outcomes

    def figures(self) -> dict[str, Any]:
        """Return what the row of the attack says besides: without a threshold nothing is broken."""
        if self.settings.goal != "return" or self.task.facts.threshold is not None:
            return {}
        return dict.fromkeys(("broken_rate", "broken_ci95", "random_broken_rate"))
