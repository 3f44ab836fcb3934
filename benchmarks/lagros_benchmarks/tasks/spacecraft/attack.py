"""An attack on the worlds of the spacecraft: one target each, searched by its adversary."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.run.library import building, make_single_policy
from lagros_benchmarks.run.workers import Progress
from lagros_benchmarks.tasks.spacecraft.claims import position_margin
from lagros_benchmarks.tasks.spacecraft.episodes import WorldsLoop, make_filter
from lagros_benchmarks.tasks.spacecraft.plane import worst_plane_pushes
from lagros_benchmarks.tasks.spacecraft.worst_case import (
    PARAMETERS,
    SpacecraftTarget,
    first_adversaries,
)
from lagros_benchmarks.worst_case.goals import GOALS
from lagros_benchmarks.worst_case.optimisers import make_search
from lagros_benchmarks.worst_case.replay import Outcome
from lagros_benchmarks.worst_case.search import Found, SearchSettings
from lagros_benchmarks.worst_case.sequences import Replay
from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_name, check_whole
from lagros_envs.disturbances import Disturbance
from lagros_envs.seeding import episode_streams
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import MOST_AGENTS, PRESETS, preset_named
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

# Position and velocity along the first axis of the arena, in the state of a spacecraft.
_PLANE = [0, 3]


class SpacecraftBench:
    """The worlds of an attack; see `worst_case.single.SingleBench`.

    Args:
        settings: An `AttackSettings`.
    """

    population = 16
    goals = GOALS

    def __init__(self, settings: Any) -> None:
        self.settings = settings
        self.task = task.settings_for(preset_named(settings.preset).for_agents(settings.agents))
        self.shape = (self.task.steps, settings.agents, task.STATE_DIM)
        self._targets: list[SpacecraftTarget] = []

    @staticmethod
    def check(settings: Any) -> None:
        """Check what only these worlds have.

        Raises:
            ValueError: A setting is not valid.
        """
        check_name("preset", settings.preset, PRESETS)
        check_whole("agents", settings.agents, 1, MOST_AGENTS)
        if settings.search.method != SearchSettings().method:
            raise ValueError(
                f"--method {settings.search.method}: {settings.task} has one search only; leave "
                "--method out"
            )
        if settings.safety_filter and settings.proved_filter:
            raise ValueError("safety_filter and proved_filter: a policy wears one of them")

    def prepare(self) -> None:
        """Build everything that flies."""
        self._targets = self.targets()

    def targets(self) -> list[SpacecraftTarget]:
        """Return one target per world; they share the policy."""
        settings = self.settings
        # The bound is what policies prepare for.
        env = SpacecraftVectorEnv(
            settings.agents, settings.agents, settings.preset, "none", settings.bound
        )
        first = make_single_policy(settings.policy, env)
        WorldsLoop(env, first).rehearse(f"policy {settings.policy!r}", [0])
        policy = make_single_policy(settings.policy, env)
        if settings.safety_filter or settings.proved_filter:
            with building(f"policy {settings.policy!r} with the safety filter"):
                policy = make_filter(policy, env, settings.bound, settings.proved_filter)
        margin = position_margin(policy, settings.bound)
        return [
            SpacecraftTarget(
                policy,
                seed,
                settings.agents,
                settings.preset,
                settings.bound,
                settings.goal,
                margin,
            )
            for seed in settings.episode_seeds()
        ]

    def search(self, tell: Progress) -> list[Found]:
        """Search the worst sequence of every world."""
        found: list[Found] = []
        for number, target in enumerate(self._targets):
            tell("worlds", number, len(self._targets))
            rng = np.random.default_rng([self.settings.seed, number])
            one = search_adversary(target, self.settings.search, rng)
            if target.goal == "tube":
                # Beside what the adversary sees, what the error's own loop stands worst.
                known = _fly_known(target)
                worse = known if known.score > one.score else one
                one = replace(worse, flights=one.flights + 1)
            found.append(one)
        tell("worlds", len(found), len(found))
        return found

    def random(self, kind: str) -> FloatArray:
        """Return the random disturbance of every world, shape (worlds, steps, agents, 6)."""
        disturbance = Disturbance(kind, self.settings.bound, (True,) * task.STATE_DIM)
        steps, period = self.task.steps, self.task.control_period
        return np.stack(
            [
                np.stack(
                    [
                        disturbance.realise(stream, steps, period)
                        for stream in episode_streams(target.seed).disturbance.spawn(target.agents)
                    ],
                    axis=1,
                )
                for target in self._targets
            ]
        )

    def replay(self, pushes: FloatArray) -> list[Outcome]:
        """Fly a sequence (steps, agents, 6) in each world."""
        pairs = zip(self._targets, pushes, strict=True)
        return [replay_spacecraft(target, one) for target, one in pairs]

    def figures(self) -> dict[str, Any]:
        """Return what the row of the attack says besides: nothing."""
        return {}


def replay_spacecraft(target: SpacecraftTarget, pushes: FloatArray) -> Outcome:
    """Fly one sequence d (steps, agents, 6) in a world of its own."""
    given = Replay(pushes, target.task.control_period)
    with Attempt() as attempt:
        flown = target.fly(target.environment(1, given))
    if attempt.error is not None:
        return Outcome(target.seed, math.inf, True, {}, attempt.error)
    success, collided = flown.info["success"][0], flown.info["collided"][0]
    ratio = None if target.margin is None else float(flown.position_error.max()) / target.margin
    broken = {
        "tube": ratio is not None and ratio > 1.0,
        "success": not bool(success.all()),
        "clearance": bool(collided.any()),
    }[target.goal]
    error_ = None if ratio is None else float(flown.position_error.max())
    measures = {
        "success_share": float(success.mean()),
        "strict_success_share": float(flown.info["strict_success"][0].mean()),
        "collided_agents": int(collided.sum()),
        "least_gap": float(flown.gap[0]),
        "max_position_error": error_,
        "share_of_certified": ratio,
    }
    return Outcome(target.seed, float(flown.scores[0]), broken, measures)


def search_adversary(
    target: SpacecraftTarget, settings: SearchSettings, rng: np.random.Generator
) -> Found:
    """Search the nine numbers of the adversary, and return what its worst flight did."""
    chosen = make_search(settings.optimiser, PARAMETERS, settings.population, rng)
    points = first_adversaries()[: settings.budget]
    best: Found | None = None
    flights = 0
    while True:
        scores, pushes = target.try_adversaries(points)
        flights += len(points)
        worst = int(np.argmax(scores))
        if best is None or scores[worst] > best.score:
            best = Found(pushes[worst] / target.bound, float(scores[worst]), flights)
        if flights > len(first_adversaries()):
            chosen.tell(points, scores)
        if flights + settings.population > settings.budget:
            return Found(best.sequence, best.score, flights)
        points = chosen.ask()


def _fly_known(target: SpacecraftTarget) -> Found:
    """Fly the sequence that is the worst for the position error of any agent that is tracked."""
    tracking: Any = target.policy.bare.tracking
    flown = target.task
    along = worst_plane_pushes(tracking, target.bound, flown.steps)
    sequence = np.zeros((flown.steps, target.agents, task.STATE_DIM))
    sequence[..., _PLANE] = along[:, None]
    given = Replay(target.bound * sequence, flown.control_period)
    return Found(sequence, float(target.fly(target.environment(1, given)).scores[0]), 1)
