"""What a benchmark runs: checked when it is built, with errors that name the valid choices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from lagros_envs.checks import (
    check_disturbance_bound,
    check_fields,
    check_seed,
    check_whole,
    shown,
    suggestion,
)
from lagros_envs.disturbances import KINDS
from lagros_envs.registry import task_named
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_policies.backends import LOKY, Backend

TASKS = ("cartpole", "spacecraft")
CHANNELS = ("all", "rates")
# Whether policies fly without a safety filter, with it, or both one after the other.
SAFETY_FILTERS: dict[str, tuple[bool, ...]] = {
    "none": (False,),
    "all": (True,),
    "both": (False, True),
}
DEFAULT_POLICIES = ("learned", "tube-mpc", "lagros", "lqr")
# What a task wants in place of the defaults of `BenchmarkSettings`.
DEFAULTS: dict[str, dict[str, Any]] = {
    "cartpole": {},
    "spacecraft": {
        "policies": ("learned", "tube-mpc", "lagros", "centralized"),
        "bounds": (0.2, 0.4, 0.6, 0.8, 1.0),
        "preset": "paper",
        "agents": (6,),
        "safety_filter": "both",
    },
}
# Bound of a comparison of numbers of agents, which has no use for a sweep over bounds.
SCALE_BOUNDS = (0.4,)
# What is kept of an episode lies in memory, and every job is a process.
_MOST = {"episodes": 1_000_000, "jobs": 1024, "chunk": 1_000_000, "timing_episodes": 1_000_000}


class Condition(NamedTuple):
    """One disturbance that all policies meet.

    Attributes:
        kind: A name of `lagros_envs.disturbances.KINDS`.
        bound: d_bar, in units of the state per second.
    """

    kind: str
    bound: float


class Case(NamedTuple):
    """One policy under one condition.

    Attributes:
        policy: Policy, as the run was asked for it.
        condition: The disturbance.
        safety_filter: Whether it wears the safety filter.
        agents: Agents of each world; None for the cart-pole.
    """

    policy: str
    condition: Condition
    safety_filter: bool = False
    agents: int | None = None


def unknown_name(what: str, given: object, valid: Iterable[str], note: str = "") -> str:
    """Return the message for a name that is not known: a close match, then all valid names."""
    names = list(valid)
    hint = suggestion(given, names)
    return f"unknown {what} {shown(given)}.{hint} Valid: {', '.join(names)}{note}."


def check_policy(name: str, task: str = "cartpole") -> None:
    """Check that a policy is a known name, an existing file or an importable module.

    Args:
        name: The policy.
        task: The task whose names count.

    Raises:
        ValueError: It is neither.
    """
    from lagros_policies.naming import is_file, is_importable, model_file, user_class
    from lagros_policies.policy import policy_names

    names = policy_names(task_named(task))
    if name in names:
        return
    model = model_file(name)
    if model is not None:
        if is_file(model.path):
            return
        raise ValueError(f"there is no file {str(model.path)!r} for a policy")
    own = user_class(name)
    if own is not None:
        if is_importable(own.module):
            return
        raise ValueError(f"there is no module {own.module!r} for the policy {name!r}")
    raise ValueError(
        unknown_name(
            "policy", name, names, ", the .zip of a stable-baselines3 model, or module:Class"
        )
    )


def check_task(task: str) -> None:
    """Check the name of a task.

    Raises:
        ValueError: The task is unknown.
    """
    if not isinstance(task, str) or task not in TASKS:
        raise ValueError(unknown_name("task", task, TASKS))


@dataclass(frozen=True)
class BenchmarkSettings:
    """Policies side by side on the same episodes.

    Attributes:
        task: Name of the task.
        policies: Names of `lagros_policies.NAMES`, or files of stable-baselines3 models.
        episodes: Episodes of each policy under each condition; worlds, with agents.
        seed: Seed of the run. Its episodes belong to the namespace `EVALUATION` of
            `lagros_envs.seeding`, so they are never those of a training run, of whatever seed.
        disturbances: Kinds of disturbance.
        bounds: d_bar, in units of the state per second; every kind meets every bound.
        channels: Disturbed states, "all" or "rates".
        metric: File of the contraction metric for the kind "worst"; None takes the shipped one.
        preset: Preset of the spacecraft's scenarios; None for the cart-pole, as the next two.
        agents: Numbers of spacecraft in a world; several compare them.
        safety_filter: "none", "all" policies wear the filter, or "both" one after the other.
        policy_settings: Further settings of `lagros_policies.make`, by policy.
        jobs: Worker processes.
        chunk: Episodes that a worker takes at a time; worlds that fly in one batch.
        timing_episodes: The published step times come from a serial pass over this many first
            episodes: with more than one job the workers contend for the processor, and the
            spacecraft fly in batches.
        backend: Whose processes the workers are.

    Raises:
        ValueError: A setting is not valid.
    """

    task: str = "cartpole"
    policies: tuple[str, ...] = DEFAULT_POLICIES
    episodes: int = 50
    seed: int = 0
    disturbances: tuple[str, ...] = ("uniform",)
    bounds: tuple[float, ...] = (0.75,)
    channels: str = "all"
    metric: str | None = None
    preset: str | None = None
    agents: tuple[int, ...] = ()
    safety_filter: str = "none"
    policy_settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    jobs: int = 1
    chunk: int = 25
    timing_episodes: int = 10
    backend: Backend = LOKY

    def __post_init__(self) -> None:
        """Check the settings."""
        check_fields(self)
        check_task(self.task)
        for name in ("policies", "disturbances", "bounds", "agents"):
            values = getattr(self, name)
            if not values and not (name == "agents" and self.task == "cartpole"):
                raise ValueError(f"{name} must not be empty")
            twice = [value for value, count in Counter(values).items() if count > 1]
            if twice:
                raise ValueError(f"{name}={','.join(map(str, values))} names {twice[0]} twice")
        for kind in self.disturbances:
            if kind not in KINDS:
                raise ValueError(unknown_name("disturbance", kind, KINDS))
        for bound in self.bounds:
            check_disturbance_bound("bound", bound)
        if self.channels not in CHANNELS:
            raise ValueError(unknown_name("channels", self.channels, CHANNELS))
        for name, most in _MOST.items():
            check_whole(name, getattr(self, name), 1, most)
        check_seed(self.seed)
        if self.task == "cartpole":
            self._check_alone()
        else:
            self._check_spacecraft()
        self._check_policy_settings()

    def _check_policy_settings(self) -> None:
        given = self.policy_settings
        held = isinstance(given, Mapping) and all(
            isinstance(one, Mapping) and all(isinstance(name, str) for name in one)
            for one in given.values()
        )
        if not held:
            raise ValueError(
                f"policy_settings={shown(given)} must be mappings of names to values, one for each "
                "policy that has any"
            )
        strangers = [name for name in given if name not in self.policies]
        if strangers:
            raise ValueError(f"policy_settings names {strangers}, which do not run")

    def _check_alone(self) -> None:
        for name, none in (("preset", None), ("agents", ()), ("safety_filter", "none")):
            if getattr(self, name) != none:
                raise ValueError(
                    f"{name}={getattr(self, name)!r} is for the task spacecraft; leave it out for "
                    "cartpole"
                )

    def _check_spacecraft(self) -> None:
        from lagros_envs.tasks.spacecraft.scenarios import MOST_AGENTS, PRESETS

        if self.preset not in PRESETS:
            raise ValueError(unknown_name("preset", self.preset, PRESETS))
        if self.safety_filter not in SAFETY_FILTERS:
            raise ValueError(unknown_name("safety filter", self.safety_filter, SAFETY_FILTERS))
        for count in self.agents:
            check_whole("agents", count, 1, MOST_AGENTS)
        if "worst" in self.disturbances:
            raise ValueError(
                "disturbance 'worst' pushes away from one nominal trajectory that all policies "
                "share, which the spacecraft's do not: each makes its own way, and `lagros attack "
                "spacecraft` searches the worst of each. Valid: "
                f"{', '.join(kind for kind in KINDS if kind != 'worst')}."
            )

    @classmethod
    def for_task(cls, task: str, **given: Any) -> BenchmarkSettings:
        """Return the settings of a task, with its own defaults for what is None.

        Args:
            task: Name of the task.
            given: Settings; None takes the task's default.

        Raises:
            ValueError: A setting is not valid.
        """
        check_task(task)
        chosen = {name: value for name, value in given.items() if value is not None}
        defaults = DEFAULTS[task]
        if len(chosen.get("agents", ())) > 1:
            defaults = defaults | {"bounds": SCALE_BOUNDS}
        return cls(task=task, **(defaults | chosen))

    @property
    def cases(self) -> tuple[Case, ...]:
        """All that is run, in the order of the rows."""
        return tuple(
            Case(policy, condition, filtered, count)
            for count in self.agents or (None,)
            for condition in self.conditions
            for filtered in SAFETY_FILTERS[self.safety_filter]
            for policy in self.policies
        )

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Every kind with every bound; "none" has no bound and appears once."""
        pairs: list[Condition] = []
        for kind in self.disturbances:
            bounds = (0.0,) if kind == "none" else self.bounds
            pairs += [Condition(kind, bound) for bound in bounds]
        return tuple(pairs)

    def episode_seeds(self) -> list[int]:
        """Return the seeds of the episodes: the same for every policy, kind and bound."""
        return episode_seeds(self.seed, self.episodes, EVALUATION)
