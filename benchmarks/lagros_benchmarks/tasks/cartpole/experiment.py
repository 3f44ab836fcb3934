"""The cart-pole's part of a benchmark: its environment, its nominal plans, its episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np

import lagros_envs  # noqa: F401  (registers the environments, in worker processes too)
from lagros_benchmarks.run.episodes import ACTION, EpisodeRecord, run_episode
from lagros_benchmarks.run.experiment import BenchmarkRun
from lagros_benchmarks.run.flying import rehearse
from lagros_benchmarks.run.library import (
    Environment,
    FloatArray,
    Policy,
    SetupError,
    Toolbox,
    building,
    check_observes,
    describe_error,
)
from lagros_benchmarks.run.settings import BenchmarkSettings, Case, Condition
from lagros_benchmarks.run.workers import Keeper, Progress, gather, split

_FORWARD_CALLS = 2000
_CALM = Condition("none", 0.0)
_ENV_ID = "lagros/CartPole-v0"


@dataclass(frozen=True)
class NominalPlan:
    """The nominal trajectory of one episode.

    Attributes:
        seed: Seed of the episode.
        states: x_d at every control instant, or None if the planner found no plan.
        defect: How far the plan misses the dynamics; nan if the planner raised.
        error: What went wrong, or None.
    """

    seed: int
    states: FloatArray | None
    defect: float
    error: str | None


@dataclass(frozen=True)
class CartPoleRun(BenchmarkRun):
    """All episodes of a cart-pole benchmark.

    Attributes:
        plans: Nominal trajectories, one per episode.
        forward_times: Median time of each policy's bare network [s]; None where there is none.
        times: Control instants [s].
        paper_tube: Radius of the published tube at these.
    """

    episodes: Mapping[Case, Sequence[EpisodeRecord]]
    timing: Mapping[Case, Sequence[EpisodeRecord]]
    plans: Sequence[NominalPlan]
    forward_times: Mapping[str, float | None]
    times: FloatArray
    paper_tube: FloatArray


@dataclass(frozen=True)
class CartPoleExperiment:
    """See `run.experiment.Experiment`; the other attributes are those of the run."""

    settings: BenchmarkSettings
    toolbox: Toolbox
    control_period: float
    times: FloatArray
    paper_tube: FloatArray
    forward_times: Mapping[str, float | None]

    @classmethod
    def set_up(cls, settings: BenchmarkSettings, toolbox: Toolbox) -> CartPoleExperiment:
        """Build everything once, so that a damaged file ends the run before it has begun.

        Raises:
            SetupError: Something cannot be built, or cannot run.
        """
        env = make_environment(settings, toolbox, _CALM)
        task = env.get_wrapper_attr("settings")
        times = task.control_period * np.arange(task.steps + 1)
        with building("the planner"):
            toolbox.make_planner()
        with building("the contraction metric"):
            toolbox.load_metric(settings.metric)
        forward_times = {}
        for name in settings.policies:
            policy = make_policy(settings, toolbox, name, env)
            with building(f"policy {name!r}"):
                forward_times[name] = forward_time(policy)
        return cls(
            settings=settings,
            toolbox=toolbox,
            control_period=task.control_period,
            times=times,
            paper_tube=np.asarray(task.tube.radius(times)),
            forward_times=forward_times,
        )

    @property
    def timed_apart(self) -> bool:
        """Whether workers contend for the processor."""
        return self.settings.backend.in_parallel(self.settings.jobs)

    def units(self, progress: Progress | None, keeper: Keeper | None = None) -> list[NominalPlan]:
        """Return the nominal plan of every episode."""
        return plan_nominals(self.settings, self.toolbox, progress, keeper)

    def play(self, case: Case, units: Sequence[NominalPlan]) -> list[EpisodeRecord]:
        """Run episodes one after the other and return their records."""
        return self._episodes(case, units)

    def time(self, case: Case, units: Sequence[NominalPlan]) -> list[EpisodeRecord]:
        """Run episodes for their step times."""
        return self._episodes(case, units)

    def finish(
        self,
        units: Sequence[NominalPlan],
        outcomes: Mapping[Case, Sequence[list[EpisodeRecord]]],
        timing: Mapping[Case, list[EpisodeRecord]] | None,
    ) -> CartPoleRun:
        """Put the run together."""
        episodes = {
            case: [record for part in parts for record in part] for case, parts in outcomes.items()
        }
        return CartPoleRun(
            settings=self.settings,
            episodes=episodes,
            timing=episodes if timing is None else timing,
            control_period=self.control_period,
            plans=units,
            forward_times=self.forward_times,
            times=self.times,
            paper_tube=self.paper_tube,
        )

    def _episodes(self, case: Case, units: Sequence[NominalPlan]) -> list[EpisodeRecord]:
        env = make_environment(self.settings, self.toolbox, case.condition)
        policy = make_policy(self.settings, self.toolbox, case.policy, env)
        return [
            run_episode(env, policy, plan.seed, plan.states, label=case.policy) for plan in units
        ]


def make_environment(
    settings: BenchmarkSettings, toolbox: Toolbox, condition: Condition
) -> Environment:
    """Return the environment of one condition."""
    metric = toolbox.load_metric(settings.metric) if condition.kind == "worst" else None
    return gym.make(
        _ENV_ID,
        disturbance=condition.kind,
        disturbance_bound=condition.bound,
        disturbance_channels=settings.channels,
        metric=metric,
        # The checker warns about actions beyond the box, which this environment allows.
        disable_env_checker=True,
    )


def make_policy(
    settings: BenchmarkSettings, toolbox: Toolbox, name: str, env: Environment
) -> Policy:
    """Build a policy and call it once, so that what its first call loads is not timed.

    Raises:
        SetupError: It cannot be built, or cannot run.
    """
    with building(f"policy {name!r}"):
        policy = toolbox.make_policy(name, env, settings.policy_settings.get(name, {}))
    check_observes(f"policy {name!r}", policy)
    observation, _ = env.reset(seed=0, options=_standing_still(env))
    rehearse(f"policy {name!r}", policy, observation, [True], ACTION)
    return policy


def plan_nominals(
    settings: BenchmarkSettings,
    toolbox: Toolbox,
    progress: Progress | None = None,
    keeper: Keeper | None = None,
) -> list[NominalPlan]:
    """Plan x_d of every episode once: it depends on the scenario alone."""
    chunks = list(split(settings.episode_seeds(), settings.chunk))

    def work(seeds: Sequence[int]) -> list[NominalPlan]:
        return _plan_chunk(settings, toolbox, seeds)

    planned = gather("planning", work, chunks, settings.jobs, progress, settings.backend, keeper)
    return [plan for part in planned for plan in part]


def forward_time(policy: Policy) -> float | None:
    """Return the median time of the policy's bare network on one input [s], or None."""
    from lagros_policies.policy import as_policy

    asked = as_policy(policy)
    forward, features = asked.bare_forward, asked.example_features()
    if features is None:
        return None
    times = np.empty(_FORWARD_CALLS)
    for call in range(_FORWARD_CALLS):
        begin = perf_counter()
        forward(features)
        times[call] = perf_counter() - begin
    return float(np.median(times))


def _plan_chunk(
    settings: BenchmarkSettings, toolbox: Toolbox, seeds: Sequence[int]
) -> list[NominalPlan]:
    env: Any = make_environment(settings, toolbox, _CALM).unwrapped
    planner = toolbox.make_planner()
    plans = []
    for seed in seeds:
        env.reset(seed=seed)
        try:
            plan = planner.plan(env.scenario.initial_state, env.scenario.goal)
        except ImportError as error:  # of a solver: no plan would be worth anything
            raise SetupError.building("the planner", error) from error
        except Exception as error:
            plans.append(NominalPlan(seed, None, float("nan"), describe_error(error)))
            continue
        states = np.asarray(plan.states, dtype=np.float64) if plan.solved else None
        problem = None if plan.solved else f"not solved, defect {plan.defect:.3g}"
        plans.append(NominalPlan(seed, states, float(plan.defect), problem))
    return plans


def _standing_still(env: Environment) -> dict[str, Any]:
    world: Any = env.unwrapped
    # The kind "worst" insists on a nominal trajectory; for a warm-up any will do.
    return {"nominal": np.zeros((world.settings.steps + 1, 4))}
