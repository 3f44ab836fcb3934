"""An attack from beginning to end: episodes, search, replay, and the rows that are published."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from time import perf_counter
from typing import Any

import numpy as np

from lagros_benchmarks.run.metrics import wilson_interval
from lagros_benchmarks.run.room import room_of
from lagros_benchmarks.run.settings import check_fits, check_policy
from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.worst_case.replay import Outcome, WorstCases
from lagros_benchmarks.worst_case.search import MOST, Found, SearchSettings
from lagros_benchmarks.worst_case.seeds import ATTACK
from lagros_envs.arrays import FloatArray
from lagros_envs.checks import (
    check_disturbance_bound,
    check_fields,
    check_name,
    check_positive,
    check_seed,
    check_whole,
)
from lagros_envs.reading import Record
from lagros_envs.registry import find_any, first_task
from lagros_envs.seeding import episode_seeds

# What is to be broken where nothing is said.
_GOAL = "success"
# Kind of the random disturbance that the worst case is held against.
_BASELINE = "uniform"
# A sequence may pass its bound by rounding alone.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class AttackSettings:
    """What is attacked and how.

    Attributes:
        task: As in `lagros attack TASK`.
        policy: As `lagros bench` takes it.
        goal: What to break: "tube", "success" or "clearance"; of one body also "error"; of an
            environment of somebody else's "return" or "termination".
        bound: d_bar, in units of the state per second.
        episodes: Episodes, each with a worst disturbance of its own.
        seed: Seed of the run; its episodes belong to the namespace `ATTACK`.
        search: How to search; in worlds of many agents only optimiser, budget and population.
        safety_filter: Whether the policy uses the safety filter, which worlds of many agents have.
        proved_filter: Whether it uses the filter with a proof in its place.
        preset: Preset of the scenarios of such worlds.
        agents: Agents in such a world.

    Raises:
        ValueError: A setting is not valid.
    """

    task: str = field(default_factory=first_task)
    policy: str = "lagros"
    goal: str = "tube"
    bound: float = 0.75
    episodes: int = 10
    seed: int = 0
    search: SearchSettings = field(default_factory=SearchSettings)
    safety_filter: bool = False
    proved_filter: bool = False
    preset: str = "paper"
    agents: int = 6

    def __post_init__(self) -> None:
        check_fields(self)
        find_any(self.task)
        check_policy(self.policy, self.task)
        check_name("goal", self.goal, bench_of(self.task).goals)
        check_positive("bound", self.bound)
        check_disturbance_bound("bound", self.bound)
        check_whole("episodes", self.episodes, 1, MOST)
        check_seed(self.seed)
        bench_of(self.task).check(self)
        if self.policy == "random":
            raise ValueError("policy='random' has no worst case: it draws its actions")

    @classmethod
    def for_task(cls, task: str, method: str, budget: int | None, **given: Any) -> AttackSettings:
        """Return the settings of a task, with its own defaults for what is None.

        Raises:
            ValueError: A setting is not valid, or is for worlds of many agents and the task is one
                body.
        """
        described = find_any(task)
        check_fits(described, agents=given.get("agents"), preset=given.get("preset"))
        usual = described.defaults_in(given.get("preset"))
        bench = bench_of(described.name)
        search = SearchSettings(
            method,
            budget=usual.attack_budget if budget is None else budget,
            population=bench.population,
        )
        chosen = {name: value for name, value in given.items() if value is not None}
        goal = _GOAL if _GOAL in bench.goals else bench.goals[0]
        defaults: dict[str, Any] = {
            "bound": usual.bound,
            "episodes": usual.attack_episodes,
            "goal": goal,
        }
        # Of one body there are none.
        defaults |= dict(zip(("agents",), usual.agents, strict=False))
        return cls(task=described.name, search=search, **(defaults | chosen))

    def episode_seeds(self) -> list[int]:
        """Return the seeds of the episodes."""
        return episode_seeds(self.seed, self.episodes, ATTACK)


@dataclass(frozen=True)
class Attack:
    """What an attack came to: all figures as they are published, and what each sequence did."""

    row: dict[str, Any]
    cases: WorstCases


def bench_of(task: str) -> Any:
    """Return what a task brings to an attack: `SingleBench`, or a class like it of its room."""
    return room_of(find_any(task)).part("attack")


def run_attack(settings: AttackSettings, progress: Progress | None = None) -> Attack:
    """Search the worst disturbance of every episode and fly what was found.

    Raises:
        ValueError: The policy keeps a memory, or has no certificate to attack.
    """
    tell = progress or untold
    bench = bench_of(settings.task)(settings)
    tell("prepare", 0, 1)
    bench.prepare()
    tell("prepare", 1, 1)
    begun = perf_counter()
    found = bench.search(tell)
    seconds = perf_counter() - begun
    pushes = settings.bound * np.stack([one.sequence for one in found])
    check_bound(pushes, settings.bound)
    tell("replay", 0, 2)
    outcomes = bench.replay(pushes)
    tell("replay", 1, 2)
    baseline = bench.replay(bench.random(_BASELINE))
    tell("replay", 2, 2)
    row = {**_row(settings, outcomes, baseline, found, seconds), **bench.figures()}
    largest = row.get("max_tracking_error_max")
    if largest is not None:
        row["max_tracking_error_per_bound"] = largest / settings.bound
    return Attack(row, WorstCases(asdict(settings), pushes, tuple(outcomes)))


def fly_again(cases: WorstCases) -> list[Outcome]:
    """Fly saved sequences again, without a search.

    Raises:
        ValueError: The file's command is not one that this version knows, or its sequences leave
            the ball that it states.
    """
    settings = settings_from(cases.command)
    check_bound(cases.pushes, settings.bound)
    bench = bench_of(settings.task)(settings)
    check_shape(cases.pushes, settings, bench.shape)
    bench.prepare()
    flown: list[Outcome] = bench.replay(cases.pushes)
    return flown


def settings_from(command: Any) -> AttackSettings:
    """Return the settings that a file says it was made with.

    Raises:
        ValueError: They are not such settings.
    """
    given = Record(command, "'command'")
    searched = given.record("search")
    given.only([item.name for item in fields(AttackSettings)])
    searched.only([item.name for item in fields(SearchSettings)])
    return AttackSettings(**{**given.entries, "search": SearchSettings(**searched.entries)})


def check_shape(pushes: FloatArray, settings: AttackSettings, one: tuple[int, ...]) -> None:
    """Check that there is a push for every episode of an attack, of the shape `one` each.

    Raises:
        ValueError: There are more or fewer.
    """
    if pushes.shape != (settings.episodes, *one):
        raise ValueError(
            f"'pushes' has the shape {pushes.shape} and must have {(settings.episodes, *one)} for "
            f"episodes={settings.episodes} of {settings.task}"
        )


def check_bound(pushes: FloatArray, bound: float) -> None:
    """Check that every push d (..., n) of some sequences lies in the ball of the disturbance.

    Raises:
        ValueError: One does not, or is not a number.
    """
    largest = float(np.linalg.norm(pushes, axis=-1).max(initial=0.0))
    if not largest <= bound * (1.0 + _ROUNDING):
        raise ValueError(
            f"a push has norm {largest!r}, above the bound {bound!r}: such sequences are no worst "
            "case of that bound"
        )


def _row(
    settings: AttackSettings,
    outcomes: list[Outcome],
    baseline: list[Outcome],
    found: list[Found],
    seconds: float,
) -> dict[str, Any]:
    """Return the figures of an attack; none of its episodes is left out."""
    broken = sum(one.broken for one in outcomes)
    scores = [one.score for one in outcomes]
    return {
        **asdict(settings),
        "flights_per_episode": max(one.flights for one in found),
        "search_seconds": seconds,
        "broken_rate": broken / len(outcomes),
        "broken_ci95": list(wilson_interval(broken, len(outcomes))),
        "random_broken_rate": sum(one.broken for one in baseline) / len(baseline),
        "score_worst": max(scores),
        "score_median": float(np.median(scores)),
        "random_score_worst": max(one.score for one in baseline),
        "search_scores": [one.score for one in found],
        **_worst_measures(outcomes),
        "errors": sum(one.error is not None for one in outcomes),
        "outcomes": [asdict(one) for one in outcomes],
        "random_outcomes": [asdict(one) for one in baseline],
    }


def _worst_measures(outcomes: list[Outcome]) -> dict[str, Any]:
    """Return the largest (of gaps the least) of every number, and the share of every flag.

    What stands for no episode is None, under the name that its figure would have.
    """
    names = dict.fromkeys(name for one in outcomes for name in one.measures)
    summary: dict[str, Any] = {}
    for name in names:
        values = [one.measures[name] for one in outcomes if one.measures.get(name) is not None]
        numbers = [float(value) for value in values if value is not None]
        if name == "certified_crossed" or any(isinstance(value, bool) for value in values):
            summary[f"{name}_rate"] = sum(numbers) / len(outcomes) if numbers else None
        elif name in ("least_gap", "success_share", "strict_success_share"):
            summary[f"{name}_min"] = min(numbers, default=None)
        else:
            summary[f"{name}_max"] = max(numbers, default=None)
    return summary
