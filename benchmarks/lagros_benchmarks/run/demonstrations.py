"""Expert demonstrations: whole episodes in the environment, as offline learners read them.

The expert of one body is the one behind policy (b): one plan, tracked with u*. A re-plan on the way
would confirm the plan (`tube_mpc`), so it is made once, and however long it takes: the data depend
on settings and seed, never on the load of the machine.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.room import room_of
from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_disturbance_bound, check_fields, check_seed, check_whole
from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.registry import find_task, first_task
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Described
from lagros_policies.policy import BasePolicy, PolicyState

Environment = gym.Env[Any, Any]

MOST_EPISODES = 1_000_000  # all lie in memory


@dataclass(frozen=True, slots=True)
class DemonstrationSettings:
    """What to fly.

    Attributes:
        task: As for `lagros bench`.
        episodes: Number of episodes.
        seed: Seed of the run. Its episodes belong to the namespace of training, so they are never
            those of an evaluation, of whatever seed.
        disturbance: An open-loop kind of `lagros_envs.disturbances`.
        bound: d_bar, in units of the state per second; None for the task's own.

    Raises:
        ValueError: A value is not valid.
    """

    task: str = field(default_factory=first_task)
    episodes: int = 100
    seed: int = 0
    disturbance: str = "uniform"
    bound: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        find_task(self.task)
        check_whole("episodes", self.episodes, 1, MOST_EPISODES)
        check_seed(self.seed)
        if self.disturbance not in OPEN_LOOP:
            raise ValueError(
                f"disturbance={self.disturbance!r} must be one of {', '.join(OPEN_LOOP)}: whoever "
                "reads the data must be able to repeat it without the expert's plan"
            )
        if self.bound is not None:
            check_disturbance_bound("bound", self.bound, "or None for the task's own")

    @property
    def described(self) -> Described:
        """The task."""
        return find_task(self.task)

    @property
    def disturbance_bound(self) -> float:
        """The bound d_bar in force; 0 without disturbance."""
        if self.disturbance == "none":
            return 0.0
        return self.described.defaults.bound if self.bound is None else self.bound

    def seeds(self) -> list[int]:
        """Return the seeds of the episodes, as given to `env.reset(seed=...)`."""
        return episode_seeds(self.seed, self.episodes)

    def make_env(self) -> Environment:
        """Return the environment in which the expert flies."""
        return gym.make(
            self.described.env_id,
            disturbance=self.disturbance,
            disturbance_bound=self.disturbance_bound,
        )


@dataclass(frozen=True)
class Demonstration:
    """One episode of N steps.

    Attributes:
        seed: Seed of the episode.
        observations: What the environment showed, shape (N + 1, o).
        actions: What the expert did, in the units of the environment, shape (N, m).
        rewards: Reward of each step, shape (N,).
        terminations: Whether the step ended the episode early, shape (N,).
        truncations: Whether the step reached the time limit, shape (N,).
        infos: The environment's `info` at every instant, and the plan: `nominal_state` x_d and
            `nominal_control` u_d, nan where there is none. Each of shape (N + 1,) or (N + 1, k).
        counters: Plans that the expert asked for, and how many of them failed.
    """

    seed: int
    observations: Float32Array
    actions: Float32Array
    rewards: FloatArray
    terminations: BoolArray
    truncations: BoolArray
    infos: dict[str, NDArray[Any]]
    counters: dict[str, int]

    @property
    def success(self) -> bool:
        """Whether the environment calls the episode a success (the task's own definition)."""
        return bool(self.infos["success"][-1])


class Expert(BasePolicy):
    """What flies the episodes: a policy that shows its plan.

    Attributes:
        algorithm: What it is, for the data's record.
    """

    name = "expert"
    algorithm: ClassVar[str] = ""

    def nominal(self, state: PolicyState) -> tuple[FloatArray, FloatArray]:
        """Return x_d (T + 1, n) and u_d (T + 1, k) up to the time limit, nan where unplanned."""
        raise NotImplementedError

    def record(self) -> dict[str, Any]:
        """Return metric, planner and feedback, in plain values."""
        raise NotImplementedError


def make_expert(settings: DemonstrationSettings, env: Environment) -> Expert:
    """Return the expert of a task, for the environment in which it flies."""
    made: Expert = room_of(settings.described).part("demonstrations")(env.unwrapped)
    return made


def fly(env: Environment, expert: Expert, seed: int) -> Demonstration:
    """Fly one episode of the expert to its end, whatever the end is."""
    loop = ClosedLoop(env, expert)
    observations: list[Float32Array] = []
    infos: list[dict[str, Any]] = []
    actions: list[Float32Array] = []
    steps: list[tuple[float, bool, bool]] = []
    for _ in loop.fly(seed):
        observations.append(loop.observation)
        infos.append(loop.info)
        if loop.step:
            actions.append(loop.action)
            steps.append((float(loop.reward), loop.terminated, loop.truncated))
    kept = {name: np.array([info[name] for info in infos]) for name in infos[0]}
    states, controls = expert.nominal(loop.memory)
    kept["nominal_state"] = states[: len(infos)]
    kept["nominal_control"] = controls[: len(infos)]
    rewards, terminations, truncations = zip(*steps, strict=True)
    return Demonstration(
        seed=seed,
        observations=np.array(observations, np.float32),
        actions=np.array(actions, np.float32),
        rewards=np.array(rewards, np.float64),
        terminations=np.array(terminations, np.bool_),
        truncations=np.array(truncations, np.bool_),
        infos=kept,
        counters=loop.counters(),
    )


def demonstrate(
    settings: DemonstrationSettings, on_episode: Callable[[int], None] | None = None
) -> tuple[list[Demonstration], dict[str, Any]]:
    """Fly all episodes of a run; `on_episode` is called with the number of those that are finished.

    Returns:
        The episodes in the order of their seeds, none left out, and the record of what they depend
        on: the settings, the metric and the planner.
    """
    env = settings.make_env()
    try:
        expert = make_expert(settings, env)
        flown: list[Demonstration] = []
        for seed in settings.seeds():
            flown.append(fly(env, expert, seed))
            if on_episode is not None:
                on_episode(len(flown))
        task_settings = cast(Any, env.unwrapped).settings
    finally:
        env.close()
    record = {
        "run": asdict(settings) | {"bound": settings.disturbance_bound},
        "task_settings": asdict(task_settings),
        **expert.record(),
    }
    return flown, record


class SingleExpert(Expert):
    """One plan of the whole episode, tracked with u*."""

    algorithm = "CV-STEM tube MPC: one plan, tracked with u*"

    def __init__(self, env: Any) -> None:
        from lagros_policies.tube_mpc import TubeMpcPolicy

        self._task = env.settings
        # A failed plan is asked for again at the next step.
        self._policy = TubeMpcPolicy(env.settings, deadline=math.inf)

    def predict(
        self, observation: Float32Array, state: PolicyState = None, *rest: Any
    ) -> tuple[Float32Array, PolicyState]:
        """Return the action, and the plan as the state."""
        return self._policy.predict(observation, state)

    def nominal(self, state: PolicyState) -> tuple[FloatArray, FloatArray]:
        """Return x_d and u_d; see `Expert`."""
        plan, system, steps = state[0].plan, self._task.system, self._task.steps
        states = np.full((steps + 1, system.state_dim), np.nan)
        controls = np.full((steps + 1, system.control_dim), np.nan)
        if plan is not None:
            states[steps - plan.horizon :] = plan.states
            controls[steps - plan.horizon : steps] = plan.controls
        return states, controls

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return how many plans were made and failed."""
        counted = self._policy.counters(state)
        return {name: counted[name] for name in ("plans", "failed_plans")}

    def record(self) -> dict[str, Any]:
        """Return metric, if the task has one, planner and feedback; see `Expert`."""
        expert = self._policy.expert
        metric = expert.known_metric
        return {
            "metric": None if metric is None else _metric_record(metric),
            "planner": asdict(expert.planner.settings),
            "law": expert.law_name,
            "feedback": asdict(expert.feedback),
        }


def _metric_record(metric: Any) -> dict[str, Any]:
    from lagros_policies.contraction.metric_files import region_record

    check = metric.verification
    return {
        # The digest that the manifests of training data carry.
        "sha256": hashlib.sha256(metric.coefficients.tobytes()).hexdigest(),
        "alpha": metric.contraction_rate,
        "chi": metric.condition_bound,
        "nu": metric.control_weight,
        "region": region_record(metric.region),
        "verification": None if check is None else asdict(check),
    }
