"""The spacecraft's part of a benchmark: its worlds, its policies with and without the filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from lagros_benchmarks.run.episodes import added_up
from lagros_benchmarks.run.experiment import BenchmarkRun
from lagros_benchmarks.run.keeping import Kept
from lagros_benchmarks.run.library import Toolbox, building, built_policy
from lagros_benchmarks.run.settings import PROVED_FILTER, BenchmarkSettings, Case
from lagros_benchmarks.run.workers import Progress
from lagros_benchmarks.tasks.spacecraft.claims import position_margin, tracked_with_a_gain
from lagros_benchmarks.tasks.spacecraft.episodes import (
    Flight,
    Prover,
    Trace,
    WorldRecord,
    WorldsLoop,
    fly,
    fly_chunk,
    make_filter,
    make_worlds,
)
from lagros_benchmarks.tasks.spacecraft.guaranteed import kept_apart, proved
from lagros_benchmarks.tasks.spacecraft.timing import PLAN_WORLDS, Timing, time_plans, time_policy
from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.scenarios import Scenario
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.policy import BasePolicy

Value = TypeVar("Value")


@dataclass(frozen=True)
class SpacecraftRun(BenchmarkRun):
    """All worlds of a spacecraft benchmark, and what the policy of each case counts in them."""

    episodes: Mapping[Case, Sequence[WorldRecord]]
    timing: Mapping[Case, Sequence[Timing]]
    counters: Mapping[Case, Mapping[str, int]]


@dataclass(frozen=True)
class ScenePanel:
    """One policy in the world of a scene.

    Attributes:
        case: The policy, and what it met.
        path: Positions at every control instant, shape (instants, agents, 2) [m].
        world: What happened.
    """

    case: Case
    path: FloatArray
    world: WorldRecord


@dataclass(frozen=True)
class Scene:
    """Several policies in the same world under the same disturbance.

    Attributes:
        scenario: Starts, goals and obstacles.
        arena: Side of the square in which everything was placed [m].
        goal_radius: Distance at which an agent has arrived [m].
        control_period: Time between the instants of a path [s].
        panels: One per policy.
    """

    scenario: Scenario
    arena: float
    goal_radius: float
    control_period: float
    panels: tuple[ScenePanel, ...]


@dataclass(frozen=True)
class SpacecraftExperiment:
    """See `lagros_benchmarks.run.experiment.Experiment`."""

    settings: BenchmarkSettings
    toolbox: Toolbox
    control_period: float

    @classmethod
    def set_up(cls, settings: BenchmarkSettings, toolbox: Toolbox) -> SpacecraftExperiment:
        """Build everything once, so that a damaged file ends the run before it has begun.

        Raises:
            SetupError: A policy cannot be built or cannot run, or no scenario can be drawn.
        """
        experiment = cls(settings, toolbox, 0.0)
        period = 0.0
        rehearsed: set[str] = set()
        # Beginning with the smallest worlds, of which one call is quick.
        for case in sorted(settings.cases, key=lambda case: case.agents or 0):
            with building(f"the environment of {case.agents} agents"):
                env = experiment.environment(case, 1)
                env.reset(seed=[0])
                period = env.settings.control_period
            policy = experiment.policy(case, env)
            if case.policy not in rehearsed:
                rehearsed.add(case.policy)
                WorldsLoop(env, policy).rehearse(f"policy {case.policy!r}", [0])
        return cls(settings, toolbox, period)

    @property
    def timed_apart(self) -> bool:
        """Always: a batch of worlds tells nothing about one decision."""
        return True

    def environment(self, case: Case, worlds: int) -> SpacecraftVectorEnv:
        """Return worlds of a case."""
        preset = self.settings.preset or "paper"
        return make_worlds(
            worlds, case.agents or 1, preset, *case.condition, self.settings.channels
        )

    def policy(self, case: Case, env: SpacecraftVectorEnv) -> BasePolicy:
        """Build the policy of a case, with its filter.

        Raises:
            SetupError: It cannot be built.
        """
        name, bound = case.policy, case.condition.bound
        given = self.settings.policy_settings.get(name, {})
        policy = built_policy(name, lambda: self.toolbox.make_policy(name, env, given))
        if not case.safety_filter:
            return policy
        with building(f"policy {name!r} with the safety filter"):
            if self.settings.safety_filter == PROVED_FILTER:
                return make_filter(policy, env, bound, proved=True)
            return (self.toolbox.make_filter or make_filter)(policy, env, bound)

    def units(self, progress: Progress | None, keeper: Kept | None = None) -> list[int]:
        """Return the seed of every world: each policy plans for itself."""
        return self.settings.episode_seeds()

    def play(self, case: Case, units: Sequence[int]) -> Flight:
        """Fly a chunk of worlds."""
        policy = self.policy(case, self.environment(case, 1))
        bound_of = self.toolbox.position_margin or position_margin
        margin = bound_of(policy, case.condition.bound)

        def worlds(count: int) -> SpacecraftVectorEnv:
            return self.environment(case, count)

        return fly_chunk(worlds, policy, units, margin, self._prover(case, policy))

    def _prover(self, case: Case, policy: BasePolicy) -> Prover | None:
        """Return what says of worlds what is proved of them; None where nothing is."""
        if case.safety_filter and self.settings.safety_filter == PROVED_FILTER:
            return kept_apart
        if tracked_with_a_gain(policy):
            return partial(proved, policy=policy, bound=case.condition.bound)
        return None

    def time(self, case: Case, units: Sequence[int]) -> list[Timing]:
        """Measure the times of the calls, and of more plans than those worlds need."""
        env = self.environment(case, 1)
        policy = self.policy(case, env)
        WorldsLoop(env, policy).rehearse(f"policy {case.policy!r}", [0])
        timing = time_policy(env, policy, units)
        if policy.observes == "local":
            return [timing]
        further = self.settings.episode_seeds()[len(units) : PLAN_WORLDS]
        plans = np.concatenate([timing.plans, time_plans(env, policy, further)])
        return [replace(timing, plans=plans)]

    def finish(
        self,
        units: Sequence[int],
        outcomes: Mapping[Case, Sequence[Flight]],
        timing: Mapping[Case, Any] | None,
    ) -> SpacecraftRun:
        """Put the run together."""
        return SpacecraftRun(
            settings=self.settings,
            episodes={
                case: [world for flight in flights for world in flight.worlds]
                for case, flights in outcomes.items()
            },
            timing=timing or {},
            control_period=self.control_period,
            counters={
                case: added_up(flight.counters for flight in flights)
                for case, flights in outcomes.items()
            },
        )


def fly_scene(settings: BenchmarkSettings, world: int, toolbox: Toolbox) -> Scene:
    """Fly one world of a run again, from 0, with every policy, and keep where everybody was.

    With several bounds or numbers of agents it is the middle one (the lower of two); with the
    filter only where the run has no policy without it.

    Raises:
        ValueError: The run has no such world.
    """
    seeds = settings.episode_seeds()
    if not 0 <= world < len(seeds):
        raise ValueError(f"scene world {world} must be one of the run: 0 to {len(seeds) - 1}")
    experiment = SpacecraftExperiment(settings, toolbox, 0.0)
    agents = _middle(sorted(settings.agents))
    condition = _middle(sorted(settings.conditions, key=lambda condition: condition.bound))
    filtered = settings.cases[0].safety_filter
    panels = []
    for policy in settings.policies:
        case = Case(policy, condition, filtered, agents)
        env = experiment.environment(case, 1)
        trace = Trace()
        flight = fly(WorldsLoop(env, experiment.policy(case, env)), [seeds[world]], None, trace)
        panels.append(ScenePanel(case, np.array(trace.path)[:, 0], flight.worlds[0]))
    scenario = env.scenarios[0]
    if scenario is None:
        raise RuntimeError("the world of the scene was not begun")
    return Scene(
        scenario,
        env.preset.arena,
        env.settings.goal_radius,
        env.settings.control_period,
        tuple(panels),
    )


def _middle(values: Sequence[Value]) -> Value:
    return values[(len(values) - 1) // 2]
