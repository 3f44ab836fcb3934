"""Run policies on paired episodes: plans once, episodes in chunks, step times without contention.

The same seeds give the same episodes to every policy, kind and bound, and the same records whether
one process runs them or many.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple, TypeVar

import gymnasium as gym
import numpy as np

import lagros_envs  # noqa: F401  (registers the environments, in worker processes too)
from lagros_benchmarks.episodes import EpisodeRecord, describe_error, run_episode, timed_action
from lagros_benchmarks.library import Environment, FloatArray, Policy, SetupError, Toolbox
from lagros_benchmarks.settings import BenchmarkSettings, Condition

# (what is being done, units done, units in all).
Progress = Callable[[str, int, int], None]
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

_FORWARD_CALLS = 2000
_CALM = Condition("none", 0.0)
_ENV_IDS = {"cartpole": "lagros/CartPole-v0"}


class Case(NamedTuple):
    """One policy under one condition."""

    policy: str
    condition: Condition


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
class BenchmarkRun:
    """All episodes of a benchmark.

    Attributes:
        settings: What was run.
        plans: Nominal trajectories, one per episode.
        episodes: Records of each case, in the order of the seeds.
        timing: Records of the serial timing pass; those of `episodes` if there was one job.
        forward_times: Median time of each policy's bare network [s]; None where there is none.
        times: Control instants [s].
        paper_tube: Radius of the published tube at these.
        certified_tubes: Radius of our certified tube at these, by bound; None without certificate.
        control_period: Deadline of a control step [s].
    """

    settings: BenchmarkSettings
    plans: list[NominalPlan]
    episodes: dict[Case, list[EpisodeRecord]]
    timing: dict[Case, list[EpisodeRecord]]
    forward_times: dict[str, float | None]
    times: FloatArray
    paper_tube: FloatArray
    certified_tubes: dict[float, FloatArray | None]
    control_period: float


@dataclass(frozen=True)
class _Chunk:
    """Consecutive episodes of one case, the unit of work of a process."""

    case: Case
    plans: tuple[NominalPlan, ...]
    certified: FloatArray | None


def make_environment(
    settings: BenchmarkSettings, toolbox: Toolbox, condition: Condition
) -> Environment:
    """Return the environment of one condition."""
    metric = toolbox.load_metric(settings.metric) if condition.kind == "worst" else None
    return gym.make(
        _ENV_IDS[settings.task],
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
    """Build a policy and call it once, so that what its first call loads is not timed."""
    policy = toolbox.make_policy(name, env, settings.policy_settings.get(name, {}))
    observation, _ = env.reset(seed=0, options=_standing_still(env))
    # An exception is the episodes' business, where it is written down.
    try:
        timed_action(policy, observation, None, first=True)
    except Exception:
        return policy
    return policy


def run_benchmark(
    settings: BenchmarkSettings,
    toolbox: Toolbox | None = None,
    progress: Progress | None = None,
) -> BenchmarkRun:
    """Run every policy under every condition on the same episodes.

    Args:
        settings: What to run.
        toolbox: Where policies and plans come from; `lagros_policies` if None.
        progress: Called after every chunk of work.

    Returns:
        All episodes.

    Raises:
        SetupError: A policy, the planner or the metric cannot be built. (What an episode raises is
            recorded as its failure instead.)
    """
    toolbox = toolbox or Toolbox()
    conditions = settings.conditions
    env = make_environment(settings, toolbox, _CALM)
    world: Any = env.unwrapped
    times = world.settings.control_period * np.arange(world.settings.steps + 1)
    policies, tubes = _set_up(settings, toolbox, env, times)
    plans = plan_nominals(settings, toolbox, progress)
    cases = [Case(name, condition) for condition in conditions for name in settings.policies]
    episodes = _run_cases(settings, toolbox, cases, plans, tubes, progress)
    timing = episodes
    if settings.jobs > 1:
        timing = _time_cases(settings, toolbox, policies, cases, plans, progress)
    return BenchmarkRun(
        settings=settings,
        plans=plans,
        episodes=episodes,
        timing=timing,
        forward_times={name: forward_time(policy) for name, policy in policies.items()},
        times=times,
        paper_tube=np.asarray(world.settings.tube.radius(times)),
        certified_tubes=tubes,
        control_period=world.settings.control_period,
    )


def _set_up(
    settings: BenchmarkSettings, toolbox: Toolbox, env: Environment, times: FloatArray
) -> tuple[dict[str, Policy], dict[float, FloatArray | None]]:
    """Build everything once, so that a damaged file ends the run before it has begun."""
    building = "the planner"
    try:
        toolbox.make_planner()
        building = "the contraction metric"
        bounds = dict.fromkeys(condition.bound for condition in settings.conditions)
        tubes = {b: toolbox.certified_radius(settings.metric, b, times) for b in bounds}
        policies = {}
        for name in settings.policies:
            building = f"policy {name!r}"
            policies[name] = make_policy(settings, toolbox, name, env)
    except Exception as error:
        raise SetupError(f"{building} cannot be built: {describe_error(error)}") from error
    return policies, tubes


def plan_nominals(
    settings: BenchmarkSettings, toolbox: Toolbox, progress: Progress | None = None
) -> list[NominalPlan]:
    """Plan x_d of every episode once: it depends on the scenario alone."""
    chunks = list(_split(settings.episode_seeds(), settings.chunk))

    def work(seeds: Sequence[int]) -> list[NominalPlan]:
        return _plan_chunk(settings, toolbox, seeds)

    return _gather("planning", work, chunks, settings.jobs, progress)


def forward_time(policy: Policy) -> float | None:
    """Return the median time of the policy's bare network on one input [s], or None."""
    forward = getattr(policy, "bare_forward", None)
    if forward is None:
        return None
    features = policy.example_features()  # type: ignore[attr-defined]
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
        except Exception as error:
            plans.append(NominalPlan(seed, None, float("nan"), describe_error(error)))
            continue
        states = np.asarray(plan.states, dtype=np.float64) if plan.solved else None
        problem = None if plan.solved else f"not solved, defect {plan.defect:.3g}"
        plans.append(NominalPlan(seed, states, float(plan.defect), problem))
    return plans


def _run_cases(
    settings: BenchmarkSettings,
    toolbox: Toolbox,
    cases: Sequence[Case],
    plans: Sequence[NominalPlan],
    tubes: dict[float, FloatArray | None],
    progress: Progress | None,
) -> dict[Case, list[EpisodeRecord]]:
    chunks = [
        _Chunk(case, tuple(part), tubes[case.condition.bound])
        for case in cases
        for part in _split(plans, settings.chunk)
    ]

    def work(chunk: _Chunk) -> list[EpisodeRecord]:
        env = make_environment(settings, toolbox, chunk.case.condition)
        policy = make_policy(settings, toolbox, chunk.case.policy, env)
        return _play_chunk(env, policy, chunk)

    records = iter(_gather("episodes", work, chunks, settings.jobs, progress))
    return {case: [next(records) for _ in plans] for case in cases}


def _time_cases(
    settings: BenchmarkSettings,
    toolbox: Toolbox,
    policies: dict[str, Policy],
    cases: Sequence[Case],
    plans: Sequence[NominalPlan],
    progress: Progress | None,
) -> dict[Case, list[EpisodeRecord]]:
    """Run the first episodes again, in this process alone."""
    first = tuple(plans[: settings.timing_episodes])

    def work(case: Case) -> list[EpisodeRecord]:
        env = make_environment(settings, toolbox, case.condition)
        return _play_chunk(env, policies[case.policy], _Chunk(case, first, None))

    records = iter(_gather("timing", work, list(cases), 1, progress))
    return {case: [next(records) for _ in first] for case in cases}


def _play_chunk(env: Environment, policy: Policy, chunk: _Chunk) -> list[EpisodeRecord]:
    return [
        run_episode(
            env,
            policy,
            plan.seed,
            plan.states,
            label=chunk.case.policy,
            certified=chunk.certified,
        )
        for plan in chunk.plans
    ]


def _gather(
    title: str,
    work: Callable[[Item], list[Outcome]],
    items: Sequence[Item],
    jobs: int,
    progress: Progress | None,
) -> list[Outcome]:
    """Return the joined results of the work, in the order of the items, whatever the jobs."""
    outcomes: Iterator[list[Outcome]] = map(work, items)
    if jobs > 1:
        from joblib import Parallel, delayed

        # joblib allows each worker cpu_count // jobs threads of BLAS and OpenMP.
        outcomes = Parallel(n_jobs=jobs, backend="loky", return_as="generator")(
            delayed(work)(item) for item in items
        )
    joined: list[Outcome] = []
    for done, outcome in enumerate(outcomes, start=1):
        joined += outcome
        if progress is not None:
            progress(title, done, len(items))
    return joined


def _split(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]


def _standing_still(env: Environment) -> dict[str, Any]:
    world: Any = env.unwrapped
    # The kind "worst" insists on a nominal trajectory; for a warm-up any will do.
    return {"nominal": np.zeros((world.settings.steps + 1, 4))}
