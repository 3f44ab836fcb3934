"""What a benchmark runs: checked when it is built, with errors that name the valid choices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

from lagros_envs.checks import (
    check_disturbance_bound,
    check_fields,
    check_not_negative,
    check_seed,
    check_whole,
    shown,
    suggestion,
)
from lagros_envs.disturbances import KINDS
from lagros_envs.registry import find_any, task_names
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.task import Defaults, Described, Task
from lagros_policies.backends import LOKY, Backend

CHANNELS = ("all", "rates")
# The filter with a proof, where a task has one, in place of the usual.
PROVED_FILTER = "proved"
# Whether policies fly without a safety filter, with it, or both one after the other.
SAFETY_FILTERS: dict[str, tuple[bool, ...]] = {
    "none": (False,),
    "all": (True,),
    "both": (False, True),
    PROVED_FILTER: (True,),
}
_USUAL = Defaults()
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
        safety_filter: Whether it uses the safety filter.
        agents: Agents of each world; None for a task of one body.
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


def check_policy(name: str, task: str | Described | None = None) -> None:
    """Check that a policy is a name of a task's, the first's if left out, a file or a module:Class.

    Raises:
        ValueError: It is neither.
    """
    from lagros_policies.naming import is_file, is_importable, model_file, user_class
    from lagros_policies.policy import policy_names

    names = policy_names(find_any(task or task_names()[0]))
    if name in names:
        return
    model = model_file(name)
    if model is not None:
        if is_file(model.path):
            return
        raise ValueError(f"there is no file {str(model.path)!r} for a policy")
    own = None if name.partition(":")[0] in names else user_class(name)
    if own is not None:
        if is_importable(own.module):
            return
        raise ValueError(f"there is no module {own.module!r} for the policy {name!r}")
    raise ValueError(
        unknown_name(
            "policy", name, names, ", the .zip of a stable-baselines3 model, or module:Class"
        )
    )


def check_fits(task: Described, **given: Any) -> None:
    """Check that what is asked of a run of many agents is not asked of one body.

    Raises:
        ValueError: A setting is neither None, False, empty nor "none", and the task has one body.
    """
    if task.most_agents > 1:
        return
    for name, value in given.items():
        if value and value != "none":
            raise ValueError(
                f"{name}={shown(value)} does not fit: {task.name} is one body; leave it out"
            )


@dataclass(frozen=True)
class BenchmarkSettings:
    """Policies side by side on the same episodes.

    Attributes:
        task: Name of the task, or where it is: module:attribute or a .py file; or the task.
        policies: Names of the task's policies, files of stable-baselines3 models, or module:Class.
        episodes: Episodes of each policy under each condition; worlds, with agents.
        seed: Seed of the run. Its episodes belong to the namespace `EVALUATION` of
            `lagros_envs.seeding`, so they are never those of a training run, of whatever seed.
        disturbances: Kinds of disturbance.
        bounds: d_bar, in units of the state per second; every kind meets every bound.
        channels: Disturbed states, "all" or "rates".
        metric: File of the contraction metric for the kind "worst"; None takes the task's own.
        preset: Kind of worlds; None for a task of one body, as the next two.
        agents: Numbers of agents in a world; several compare them.
        safety_filter: "none", "all" policies use the filter, "both" one after the other, or
            "proved": all use the one with a proof.
        policy_settings: Further settings of `lagros_policies.make`, by policy.
        jobs: Worker processes.
        chunk: Episodes that a worker takes at a time; worlds that fly in one batch.
        timing_episodes: The published step times come from a serial pass over this many first
            episodes: with more than one job the workers contend for the processor, and worlds of
            agents fly in batches.
        backend: Whose processes the workers are.
        guarantee: Whether it is proved of how many episodes of one body what they come to; takes
            up to a second for each plan, policy and bound.
        initial_error: How far beside its plan an episode of one body begins: x(0) - x_d(0) is drawn
            from a box of this share of the scale of each coordinate (`run.initial_errors`), the
            same for all policies, while the initial state that they are told is that of the plan.

    Raises:
        ValueError: A setting is not valid.
    """

    task: str | Described = field(default_factory=lambda: task_names()[0])
    policies: tuple[str, ...] = _USUAL.policies
    episodes: int = _USUAL.episodes
    seed: int = 0
    disturbances: tuple[str, ...] = ("uniform",)
    bounds: tuple[float, ...] = _USUAL.bounds
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
    guarantee: bool = False
    initial_error: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        task = self.description
        for name in ("policies", "disturbances", "bounds", "agents"):
            values = getattr(self, name)
            if not values and not (name == "agents" and task.most_agents == 1):
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
        check_not_negative("initial_error", self.initial_error)
        check_fits(task, preset=self.preset, agents=self.agents, safety_filter=self.safety_filter)
        if self.guarantee and self.initial_error:
            raise ValueError(
                f"guarantee=True is about episodes that begin on their plan; leave it out, or "
                f"initial_error={self.initial_error:g}"
            )
        if not isinstance(task, Task):
            self._check_unplanned(task)
        if task.most_agents > 1:
            self._check_worlds(task)
        self._check_policy_settings()

    @cached_property
    def description(self) -> Described:
        """The task, which travels to worker processes that may not know of it.

        Raises:
            ValueError: There is no such task.
        """
        return find_any(self.task)

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

    def _check_unplanned(self, task: Described) -> None:
        """Check what is said of one plan that all policies share."""
        for name in ("guarantee", "initial_error"):
            if getattr(self, name):
                raise ValueError(
                    f"{name}={getattr(self, name)} is for one body that has a plan; leave it out "
                    f"for {task.name}"
                )
        if "worst" in self.disturbances:
            raise ValueError(
                "disturbance 'worst' pushes away from one nominal trajectory that all policies "
                f"share, which those of {task.name} do not: each makes its own way, and `lagros "
                f"attack {task.name}` searches the worst of each. Valid: "
                f"{', '.join(kind for kind in KINDS if kind != 'worst')}."
            )

    def _check_worlds(self, task: Described) -> None:
        if self.preset not in task.presets:
            raise ValueError(unknown_name("preset", self.preset, task.presets))
        if self.safety_filter not in SAFETY_FILTERS:
            raise ValueError(unknown_name("safety filter", self.safety_filter, SAFETY_FILTERS))
        for count in self.agents:
            check_whole("agents", count, 1, task.most_agents)

    @classmethod
    def for_task(cls, task: str | Described, **given: Any) -> BenchmarkSettings:
        """Return the settings of a task, with its own defaults for what is None.

        Raises:
            ValueError: A setting is not valid.
        """
        usual = find_any(task).defaults_in(given.get("preset"))
        chosen = {name: value for name, value in given.items() if value is not None}
        # A comparison of numbers of agents has no use for a sweep over bounds.
        bounds = (usual.bound,) if len(chosen.get("agents", ())) > 1 else usual.bounds
        names = ("policies", "episodes", "agents", "preset", "safety_filter")
        defaults = {name: getattr(usual, name) for name in names} | {"bounds": bounds}
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

    def proves(self, condition: Condition) -> bool:
        """Return whether the guarantees of a bound are proved with a condition: once for all."""
        first = next(one for one in self.conditions if one.bound == condition.bound)
        return self.guarantee and condition == first

    def episode_seeds(self) -> list[int]:
        """Return the seeds of the episodes: the same for every policy, kind and bound."""
        return episode_seeds(self.seed, self.episodes, EVALUATION)
