"""What a benchmark runs: checked when it is built, with errors that name the valid choices."""

from __future__ import annotations

import difflib
import importlib.util
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from lagros_envs.disturbances import KINDS
from lagros_envs.seeding import EVALUATION, episode_seeds

TASKS = ("cartpole",)
PLANNED_TASKS = ("spacecraft",)
CHANNELS = ("all", "rates")
DEFAULT_POLICIES = ("learned", "tube-mpc", "lagros", "lqr")


class Condition(NamedTuple):
    """One disturbance that all policies meet.

    Attributes:
        kind: A name of `lagros_envs.disturbances.KINDS`.
        bound: d_bar, in units of the state per second.
    """

    kind: str
    bound: float


def unknown_name(what: str, given: str, valid: Iterable[str], note: str = "") -> str:
    """Return the message for a name that is not known: a close match, then all valid names."""
    names = list(valid)
    close = difflib.get_close_matches(given.lower(), names, n=1, cutoff=0.5)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"unknown {what} {given!r}.{hint} Valid: {', '.join(names)}{note}."


def check_policy(name: str) -> None:
    """Check that a policy is a known name, an existing file or an importable module.

    Raises:
        ValueError: It is neither.
    """
    import lagros_policies

    names = tuple(lagros_policies.NAMES)
    if name in names:
        return
    # A file may be written algorithm:file, as in sac:model.zip.
    path = Path(name.rpartition(":")[2])
    if path.suffix == ".zip":
        if path.is_file():
            return
        raise ValueError(f"there is no file {str(path)!r} for a policy")
    module, colon, _ = name.partition(":")
    if colon:
        if importlib.util.find_spec(module) is None:
            raise ValueError(f"there is no module {module!r} for the policy {name!r}")
        return
    raise ValueError(
        unknown_name(
            "policy", name, names, ", the .zip of a stable-baselines3 model, or module:Class"
        )
    )


def check_task(task: str) -> None:
    """Check the name of a task.

    Raises:
        ValueError: The task is unknown or not there yet.
    """
    if task in PLANNED_TASKS:
        raise ValueError(f"task {task!r} is not there yet. Valid: {', '.join(TASKS)}.")
    if task not in TASKS:
        raise ValueError(unknown_name("task", task, TASKS))


@dataclass(frozen=True)
class BenchmarkSettings:
    """Policies side by side on the same episodes.

    Attributes:
        task: Name of the task.
        policies: Names of `lagros_policies.NAMES`, or files of stable-baselines3 models.
        episodes: Episodes of each policy under each condition.
        seed: Seed of the run. Its episodes belong to the namespace `EVALUATION` of
            `lagros_envs.seeding`, so they are never those of a training run, of whatever seed.
        disturbances: Kinds of disturbance.
        bounds: d_bar, in units of the state per second; every kind meets every bound.
        channels: Disturbed states, "all" or "rates".
        metric: File of the contraction metric for the kind "worst" and for the certified tube;
            None takes the shipped one.
        policy_settings: Further settings of `lagros_policies.make`, by policy.
        jobs: Worker processes.
        chunk: Episodes that a worker takes at a time.
        timing_episodes: With more than one job the workers contend for the processor, so the
            published step times come from a serial pass over this many first episodes.

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
    policy_settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    jobs: int = 1
    chunk: int = 25
    timing_episodes: int = 10

    def __post_init__(self) -> None:
        """Check the settings."""
        check_task(self.task)
        for name in ("policies", "disturbances", "bounds"):
            values = getattr(self, name)
            if not values:
                raise ValueError(f"{name} must not be empty")
            if len(set(values)) != len(values):
                raise ValueError(f"{name}={','.join(map(str, values))} names one of them twice")
        for kind in self.disturbances:
            if kind not in KINDS:
                raise ValueError(unknown_name("disturbance", kind, KINDS))
        for bound in self.bounds:
            if not (math.isfinite(bound) and bound >= 0.0):
                raise ValueError(f"bound={bound!r} must be finite and >= 0")
        if self.channels not in CHANNELS:
            raise ValueError(unknown_name("channels", self.channels, CHANNELS))
        for name in ("episodes", "jobs", "chunk", "timing_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)!r} must be at least 1")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed!r} must be a non-negative integer")
        strangers = set(self.policy_settings) - set(self.policies)
        if strangers:
            raise ValueError(f"policy_settings names {sorted(strangers)}, which do not run")

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
