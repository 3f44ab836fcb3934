"""An attack from beginning to end: episodes, search, replay, and the rows that are published."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from time import perf_counter
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import lagros_envs  # noqa: F401  (registers the environments)
from lagros_benchmarks.evidence.claims import position_margin
from lagros_benchmarks.run.episodes import ACTION
from lagros_benchmarks.run.flying import rehearse
from lagros_benchmarks.run.library import building, make_filter, make_single_policy
from lagros_benchmarks.run.metrics import wilson_interval
from lagros_benchmarks.run.settings import check_policy, check_task
from lagros_benchmarks.tasks.cartpole.worst_case import (
    GOALS,
    CartPoleTarget,
    Episodes,
    Law,
    draw_episodes,
    energy_adversary,
    policy_law,
    random_pushes,
    tracking_law,
)
from lagros_benchmarks.tasks.spacecraft.episodes import WorldsLoop, bare
from lagros_benchmarks.tasks.spacecraft.plane import worst_plane_pushes
from lagros_benchmarks.tasks.spacecraft.worst_case import (
    PARAMETERS,
    SpacecraftTarget,
    first_adversaries,
)
from lagros_benchmarks.worst_case.certificate import TubeCheck
from lagros_benchmarks.worst_case.optimisers import make_search
from lagros_benchmarks.worst_case.replay import (
    Outcome,
    WorstCases,
    replay_cartpole,
    replay_spacecraft,
)
from lagros_benchmarks.worst_case.search import MOST, Found, SearchSettings, search
from lagros_benchmarks.worst_case.seeds import ATTACK
from lagros_benchmarks.worst_case.sequences import Replay
from lagros_envs.checks import (
    check_disturbance_bound,
    check_fields,
    check_name,
    check_positive,
    check_seed,
    check_whole,
)
from lagros_envs.disturbances import Disturbance
from lagros_envs.reading import Record
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole import task as cartpole_task
from lagros_envs.tasks.spacecraft import task as spacecraft_task
from lagros_envs.tasks.spacecraft.scenarios import MOST_AGENTS, PRESETS
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.remarks.policies import NeuralTubeMpcPolicy
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tube_mpc import TubeMpcPolicy

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]

# Kind of the random disturbance that the worst case is held against.
_BASELINE = "uniform"
# Policies that remember a plan and nothing else: u* around it stands in for them in a search.
_TRACKERS = (TubeMpcPolicy, NeuralTubeMpcPolicy)
# A sequence may pass its bound by rounding alone.
_ROUNDING = 1e-12
# Position and velocity along the first axis of the arena, in the state of a spacecraft.
_PLANE = [0, 3]


@dataclass(frozen=True)
class AttackSettings:
    """What is attacked and how.

    Attributes:
        task: "cartpole" or "spacecraft".
        policy: As `lagros bench` takes it.
        goal: What to break: "tube", "success" or "clearance".
        bound: d_bar, in units of the state per second.
        episodes: Episodes, each with a worst disturbance of its own.
        seed: Seed of the run; its episodes belong to the namespace `ATTACK`.
        search: How to search; of the spacecraft only optimiser, budget and population.
        safety_filter: Whether the policy of the spacecraft wears the filter.
        preset: Preset of the spacecraft's scenarios.
        agents: Spacecraft in a world.

    Raises:
        ValueError: A setting is not valid.
    """

    task: str = "cartpole"
    policy: str = "lagros"
    goal: str = "tube"
    bound: float = 0.75
    episodes: int = 10
    seed: int = 0
    search: SearchSettings = field(default_factory=SearchSettings)
    safety_filter: bool = False
    preset: str = "paper"
    agents: int = 6

    def __post_init__(self) -> None:
        """Check the settings."""
        check_fields(self)
        check_task(self.task)
        check_policy(self.policy, self.task)
        check_name("goal", self.goal, GOALS)
        check_name("preset", self.preset, PRESETS)
        check_positive("bound", self.bound)
        check_disturbance_bound("bound", self.bound)
        check_whole("episodes", self.episodes, 1, MOST)
        check_whole("agents", self.agents, 1, MOST_AGENTS)
        check_seed(self.seed)
        if self.safety_filter and self.task == "cartpole":
            raise ValueError("safety_filter=True is for the task spacecraft; leave it out")
        if self.policy == "random":
            raise ValueError("policy='random' has no worst case: it draws its actions")

    def episode_seeds(self) -> list[int]:
        """Return the seeds of the episodes."""
        return episode_seeds(self.seed, self.episodes, ATTACK)


@dataclass(frozen=True)
class Attack:
    """What an attack came to.

    Attributes:
        row: All figures, as they are published.
        cases: The sequences found, with what each did.
    """

    row: dict[str, Any]
    cases: WorstCases


def run_attack(settings: AttackSettings, progress: Progress | None = None) -> Attack:
    """Search the worst disturbance of every episode and fly what was found.

    Args:
        settings: What to attack and how.
        progress: Told in a few words what is done.

    Raises:
        ValueError: The policy keeps a memory, or has no certificate to attack.
    """
    say = progress or (lambda _: None)
    run = _attack_cartpole if settings.task == "cartpole" else _attack_spacecraft
    return run(settings, say)


def fly_again(cases: WorstCases) -> list[Outcome]:
    """Fly saved sequences again, without a search.

    Raises:
        ValueError: The file's command is not one that this version knows, or its sequences leave
            the ball that it states.
    """
    settings = settings_from(cases.command)
    check_bound(cases.pushes, settings.bound)
    check_shape(cases.pushes, settings)
    if settings.task == "cartpole":
        bench = _CartPoleBench(settings)
        found = bench.replay(cases.pushes)
    else:
        found = [
            replay_spacecraft(target, pushes)
            for target, pushes in zip(_targets(settings), cases.pushes, strict=True)
        ]
    return found


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


def check_shape(pushes: FloatArray, settings: AttackSettings) -> None:
    """Check that there is a push for every episode, step and state of an attack.

    Raises:
        ValueError: There are more or fewer.
    """
    one = (
        (cartpole_task.CartPoleSettings().steps, cartpole_task.STATE_DIM)
        if settings.task == "cartpole"
        else (
            spacecraft_task.SpacecraftSettings().steps,
            settings.agents,
            spacecraft_task.STATE_DIM,
        )
    )
    if pushes.shape != (settings.episodes, *one):
        raise ValueError(
            f"'pushes' has the shape {pushes.shape} and must have {(settings.episodes, *one)} for "
            f"episodes={settings.episodes} of {settings.task}"
        )


def check_bound(pushes: FloatArray, bound: float) -> None:
    """Check that every push of some sequences lies in the ball of the disturbance.

    Args:
        pushes: d, shape (..., n), in units of the state per second.
        bound: d_bar, in the same units.

    Raises:
        ValueError: One does not, or is not a number.
    """
    largest = float(np.linalg.norm(pushes, axis=-1).max(initial=0.0))
    if not largest <= bound * (1.0 + _ROUNDING):
        raise ValueError(
            f"a push has norm {largest!r}, above the bound {bound!r}: such sequences are no worst "
            "case of that bound"
        )


class _CartPoleBench:
    """Episodes, policy and certificate of an attack on the cart-pole."""

    def __init__(self, settings: AttackSettings) -> None:
        """Build everything, and plan the episodes."""
        self.settings = settings
        env: Any = gym.make("lagros/CartPole-v0", disable_env_checker=True)
        name, build = f"policy {settings.policy!r}", make_single_policy
        rehearse(name, build(settings.policy, env), env.reset(seed=0)[0], [True], ACTION)
        self.policy = cast(Any, build(settings.policy, env))
        self.tracks = type(self.policy) in _TRACKERS
        # One whose metric is a network is held against the tube of its own.
        self.expert: CartPoleExpert = self.policy.expert if self.tracks else CartPoleExpert()
        if self.tracks:
            # A plan that comes late on a busy machine must not change the figure.
            self.policy.deadline = math.inf
        self.episodes: Episodes = draw_episodes(self.expert, settings.episode_seeds())
        self.certificate = TubeCheck(self.expert, self.episodes, settings.bound)

    def law(self) -> Law:
        """Return the policy as a law; for tube MPC u* around its plan, which it confirms."""
        if self.tracks:
            return tracking_law(self.expert, self.episodes)
        return policy_law(self.policy, self.episodes)

    def replay(self, pushes: FloatArray) -> list[Outcome]:
        """Fly sequences (episodes, steps, 4) in the environment."""
        outcomes = []
        for index, one in enumerate(pushes):
            goal = self.settings.goal
            outcome, flight = replay_cartpole(self.episodes, index, self.policy, goal, one)
            if flight is not None:
                more = self.certificate.hold(np.array([index]), flight).observed(0)
                outcome = Outcome(
                    outcome.seed, outcome.score, outcome.broken, {**outcome.measures, **more}
                )
            outcomes.append(outcome)
        return outcomes


def _attack_cartpole(settings: AttackSettings, say: Progress) -> Attack:
    say("planning")
    bench = _CartPoleBench(settings)
    target = CartPoleTarget(
        bench.episodes,
        bench.law(),
        settings.goal,
        settings.bound,
        energy_adversary(bench.expert.metric),
    )
    say("searching")
    begun = perf_counter()
    found = search(target, settings.search, settings.seed)
    seconds = perf_counter() - begun
    say("replaying")
    pushes = settings.bound * np.stack([one.sequence for one in found])
    outcomes = bench.replay(pushes)
    baseline = bench.replay(random_pushes(bench.episodes, _BASELINE, settings.bound))
    row = _row(settings, outcomes, baseline, found, seconds)
    row["unplanned"] = len(bench.episodes.unplanned)
    return Attack(row, _cases(settings, pushes, outcomes))


def _targets(settings: AttackSettings) -> list[SpacecraftTarget]:
    """Return one target per world; they share the policy."""
    # The bound is what policies prepare for.
    env = SpacecraftVectorEnv(
        settings.agents, settings.agents, settings.preset, "none", settings.bound
    )
    first = make_single_policy(settings.policy, env)
    WorldsLoop(env, first).rehearse(f"policy {settings.policy!r}", [0])
    policy = make_single_policy(settings.policy, env)
    if settings.safety_filter:
        with building(f"policy {settings.policy!r} with the safety filter"):
            policy = make_filter(policy, env, settings.bound)
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


def _attack_spacecraft(settings: AttackSettings, say: Progress) -> Attack:
    begun = perf_counter()
    found, outcomes, baseline = [], [], []
    for number, target in enumerate(_targets(settings)):
        say(f"world {number + 1} of {settings.episodes}")
        rng = np.random.default_rng([settings.seed, number])
        one = _search_adversary(target, settings.search, rng)
        if target.goal == "tube":
            # Beside what the adversary sees, the sequence that the error's own loop stands worst.
            known = _fly_known(target)
            worse = known if known.score > one.score else one
            one = replace(worse, flights=one.flights + 1)
        found.append(one)
        outcomes.append(replay_spacecraft(target, settings.bound * one.sequence))
        baseline.append(replay_spacecraft(target, _drawn(settings, target)))
    seconds = perf_counter() - begun
    pushes = settings.bound * np.stack([one.sequence for one in found])
    row = _row(settings, outcomes, baseline, found, seconds)
    shared = {"preset": settings.preset, "agents": settings.agents}
    return Attack({**row, **shared}, _cases(settings, pushes, outcomes))


def _search_adversary(
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
    tracking: Any = getattr(bare(target.policy), "tracking", None)
    task = spacecraft_task.SpacecraftSettings()
    along = worst_plane_pushes(tracking, target.bound, task.steps)
    sequence = np.zeros((task.steps, target.agents, spacecraft_task.STATE_DIM))
    sequence[..., _PLANE] = along[:, None]
    given = Replay(target.bound * sequence, task.control_period)
    return Found(sequence, float(target.fly(target.environment(1, given)).scores[0]), 1)


def _drawn(settings: AttackSettings, target: SpacecraftTarget) -> FloatArray:
    """Return the random disturbance of a world, shape (steps, agents, 6)."""
    task = spacecraft_task.SpacecraftSettings()
    disturbance = Disturbance(_BASELINE, settings.bound, (True,) * spacecraft_task.STATE_DIM)
    streams = episode_streams(target.seed).disturbance.spawn(settings.agents)
    drawn = [disturbance.realise(stream, task.steps, task.control_period) for stream in streams]
    return np.stack(drawn, axis=1)


def _cases(settings: AttackSettings, pushes: FloatArray, outcomes: list[Outcome]) -> WorstCases:
    check_bound(pushes, settings.bound)
    return WorstCases(asdict(settings), pushes, tuple(outcomes))


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
        **{name: value for name, value in asdict(settings).items() if name != "search"},
        "search": asdict(settings.search),
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
