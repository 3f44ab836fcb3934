"""A benchmark of one body: its environment, its nominal plans, its episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.episodes import EpisodeRecord, run_episode
from lagros_benchmarks.run.experiment import BenchmarkRun
from lagros_benchmarks.run.initial_errors import initial_error
from lagros_benchmarks.run.keeping import Keepable, Kept
from lagros_benchmarks.run.library import (
    SetupError,
    Toolbox,
    building,
    built_policy,
    describe_error,
)
from lagros_benchmarks.run.room import room_of
from lagros_benchmarks.run.settings import BenchmarkSettings, Case, Condition
from lagros_benchmarks.run.workers import Progress, gather, split
from lagros_envs.arrays import FloatArray
from lagros_envs.env import TaskEnv
from lagros_envs.task import Task
from lagros_policies.policy import BasePolicy

_FORWARD_CALLS = 2000
_CALM = Condition("none", 0.0)
# Above what an error rounds, relative.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class NominalPlan(Keepable):
    """The nominal trajectory of one episode.

    Attributes:
        seed: Seed of the episode.
        states: x_d at every control instant, or None if the planner found no plan.
        defect: How far the plan misses the dynamics; nan if the planner raised.
        error: What went wrong, or None.
        initial_error: x(0) - x_d(0), shape (n,); None where the episode begins on its plan.
    """

    seed: int
    states: FloatArray | None
    defect: float
    error: str | None
    initial_error: FloatArray | None = None


@dataclass(frozen=True)
class SingleRun(BenchmarkRun):
    """All episodes of a benchmark of one body.

    Attributes:
        task: The task.
        plans: Nominal trajectories, one per episode.
        forward_times: Median time of each policy's bare network [s]; None where there is none.
        times: Control instants [s].
        paper_tube: Radius of the published tube at these; None where there is none.
    """

    episodes: Mapping[Case, Sequence[EpisodeRecord]]
    timing: Mapping[Case, Sequence[EpisodeRecord]]
    task: Task
    plans: Sequence[NominalPlan]
    forward_times: Mapping[str, float | None]
    times: FloatArray
    paper_tube: FloatArray | None


@dataclass(frozen=True)
class SingleExperiment:
    """See `run.experiment.Experiment`; the task travels with it, whoever else knows of it."""

    settings: BenchmarkSettings
    toolbox: Toolbox
    task: Task
    forward_times: Mapping[str, float | None]

    @classmethod
    def set_up(cls, settings: BenchmarkSettings, toolbox: Toolbox) -> SingleExperiment:
        """Build everything once, so that a damaged file ends the run before it has begun.

        Raises:
            SetupError: Something cannot be built, or cannot run.
        """
        task: Any = settings.description
        experiment = cls(settings, toolbox, task, {})
        env = experiment.environment(_CALM)
        with building("the planner"):
            toolbox.make_planner(task)
        if "worst" in settings.disturbances:
            with building("the contraction metric"):
                toolbox.load_metric(task, settings.metric)
        forward_times = {}
        for name in settings.policies:
            policy = experiment.policy(name, env)
            with building(f"policy {name!r}"):
                forward_times[name] = forward_time(policy)
        return replace(experiment, forward_times=forward_times)

    @property
    def timed_apart(self) -> bool:
        """Whether workers contend for the processor."""
        return self.settings.backend.in_parallel(self.settings.jobs)

    def units(self, progress: Progress | None, keeper: Kept | None = None) -> list[NominalPlan]:
        """Return the nominal plan of every episode, which depends on the scenario alone."""
        settings = self.settings
        chunks = list(split(settings.episode_seeds(), settings.chunk))

        def work(seeds: Sequence[int]) -> list[NominalPlan]:
            return _plan_chunk(self, seeds)

        jobs, backend = settings.jobs, settings.backend
        planned = gather("planning", work, chunks, jobs, progress, backend, keeper)
        return [plan for part in planned for plan in part]

    def play(self, case: Case, units: Sequence[NominalPlan]) -> list[EpisodeRecord]:
        """Run episodes one after the other and return their records."""
        records = self.time(case, units)
        if not self.settings.proves(case.condition):
            return records
        policy = self.policy(case.policy, self.environment(case.condition))
        seeds = [plan.seed for plan in units]
        prove = room_of(self.task).part("guaranteed")
        proved = prove(policy, self.task, seeds, case.condition.bound)
        if proved is None:
            return records
        return [
            _with_guarantee(record, proved.get(plan.seed), plan.states)
            for record, plan in zip(records, units, strict=True)
        ]

    def time(self, case: Case, units: Sequence[NominalPlan]) -> list[EpisodeRecord]:
        """Return the records alone, for their step times."""
        env = self.environment(case.condition)
        policy = self.policy(case.policy, env)
        return [
            run_episode(
                env,
                policy,
                plan.seed,
                plan.states,
                label=case.policy,
                initial_error=plan.initial_error,
            )
            for plan in units
        ]

    def finish(
        self,
        units: Sequence[NominalPlan],
        outcomes: Mapping[Case, Sequence[list[EpisodeRecord]]],
        timing: Mapping[Case, list[EpisodeRecord]] | None,
    ) -> SingleRun:
        """Put the run together."""
        episodes = {
            case: [record for part in parts for record in part] for case, parts in outcomes.items()
        }
        if self.settings.guarantee:
            episodes = _shared(self.settings, episodes)
        times = self.task.control_period * np.arange(self.task.steps + 1, dtype=np.float64)
        return SingleRun(
            settings=self.settings,
            episodes=episodes,
            timing=episodes if timing is None else timing,
            control_period=self.task.control_period,
            task=self.task,
            plans=units,
            forward_times=self.forward_times,
            times=times,
            paper_tube=self.task.tube_radius(times),
        )

    def environment(self, condition: Condition) -> TaskEnv:
        """Return the environment of one condition."""
        metric = None
        if condition.kind == "worst":
            metric = self.toolbox.load_metric(self.task, self.settings.metric)
        channels: Any = self.settings.channels
        return TaskEnv(condition.kind, condition.bound, channels, metric, task=self.task)

    def policy(self, name: str, env: TaskEnv) -> BasePolicy:
        """Build a policy and call it once, so that what its first call loads is not timed.

        Raises:
            SetupError: It cannot be built, or cannot run.
        """
        given = self.settings.policy_settings.get(name, {})
        policy = built_policy(name, lambda: self.toolbox.make_policy(name, env, given))
        # The kind "worst" insists on a nominal trajectory; for a warm-up any will do.
        still = np.zeros((self.task.steps + 1, self.task.system.state_dim))
        ClosedLoop(env, policy).rehearse(f"policy {name!r}", options={"nominal": still})
        return policy


def _with_guarantee(
    record: EpisodeRecord, proved: Any, nominal: FloatArray | None
) -> EpisodeRecord:
    """Return a record with what is proved of its episode; None: it has no plan."""
    if proved is None:
        return replace(record, guaranteed=False)
    bounds = proved.error_bounds(nominal)
    return _bounded(replace(record, guaranteed=proved.holds), bounds)


def _bounded(record: EpisodeRecord, bounds: FloatArray | None) -> EpisodeRecord:
    """Return a record with what is proved of its error."""
    if bounds is None:
        return record
    # The error is a rounded number, too.
    left = bool(np.any(record.tracking_error > bounds * (1.0 + _ROUNDING)))
    return replace(
        record,
        left_certified_tube=left,
        error_bound=float(bounds.max()),
        error_bounds=bounds,
    )


def _shared(
    settings: BenchmarkSettings, episodes: Mapping[Case, list[EpisodeRecord]]
) -> dict[Case, list[EpisodeRecord]]:
    """Give all conditions of one bound what is proved for every disturbance up to it."""
    proved = {
        (case.policy, case.condition.bound): records
        for case, records in episodes.items()
        if settings.proves(case.condition)
    }
    return {
        case: [
            _bounded(replace(one, guaranteed=its.guaranteed), its.error_bounds)
            for one, its in zip(records, proved[case.policy, case.condition.bound], strict=True)
        ]
        for case, records in episodes.items()
    }


def forward_time(policy: BasePolicy) -> float | None:
    """Return the median time of the policy's bare network on one input [s], or None."""
    features = policy.example_features()
    if features is None:
        return None
    times = np.empty(_FORWARD_CALLS)
    for call in range(_FORWARD_CALLS):
        begin = perf_counter()
        policy.bare_forward(features)
        times[call] = perf_counter() - begin
    return float(np.median(times))


def _plan_chunk(experiment: SingleExperiment, seeds: Sequence[int]) -> list[NominalPlan]:
    env = experiment.environment(_CALM)
    planner = experiment.toolbox.make_planner(experiment.task)
    plans = []
    for seed in seeds:
        env.reset(seed=seed)
        scenario, share = env.scenario, experiment.settings.initial_error
        error = initial_error(experiment.task, scenario, seed, share) if share else None
        discs = scenario.discs if len(scenario.discs) else None
        try:
            plan = planner.plan(scenario.initial_state, scenario.goal, discs=discs)
        except ImportError as raised:  # of a solver: no plan would be worth anything
            raise SetupError.building("the planner", raised) from raised
        except Exception as raised:
            text = describe_error(raised)
            plans.append(NominalPlan(seed, None, float("nan"), text, error))
            continue
        states = np.asarray(plan.states, dtype=np.float64) if plan.solved else None
        problem = None if plan.solved else f"not solved, defect {plan.defect:.3g}"
        plans.append(NominalPlan(seed, states, float(plan.defect), problem, error))
    return plans
