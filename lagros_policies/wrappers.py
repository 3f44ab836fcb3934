"""What lies between a policy and its world: the wrappers that may, and those that must not.

A policy speaks the environment's own observations and actions. A wrapper that changes what they
mean, though their shapes stay, would make the same policy fail without a word.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType
from typing import Any

import gymnasium as gym

from lagros_policies.room import named_in

# Known to change neither observations nor actions, by the package that they come from; the bases
# leave everything to what a subclass overrides. All others are judged by that.
HARMLESS: dict[str, frozenset[str]] = {
    "gymnasium": frozenset(
        {
            "Env",
            "Wrapper",
            "RewardWrapper",
            "VectorEnv",
            "VectorWrapper",
            "VectorRewardWrapper",
            "SyncVectorEnv",
            "AsyncVectorEnv",
            "AddWhiteNoise",
            "Autoreset",
            "ClipReward",
            "DictInfoToList",
            # Of a vector of numbers, as here, it is the identity.
            "FlattenObservation",
            "HumanRendering",
            "NormalizeReward",
            "ObstructView",
            "OrderEnforcing",
            "PassiveEnvChecker",
            "RecordEpisodeStatistics",
            "RecordVideo",
            "RenderCollection",
            "TimeLimit",
            "TransformReward",
            "VectorizeTransformReward",
        }
    ),
    "pettingzoo": frozenset(
        {
            "AECEnv",
            "ParallelEnv",
            "BaseWrapper",
            "BaseParallelWrapper",
            "CaptureStdoutWrapper",
            "MultiEpisodeEnv",
            "MultiEpisodeParallelEnv",
            "OrderEnforcingWrapper",
            "RecordVideo",
            "RecordVideoParallel",
            "aec_to_parallel_wrapper",
            "parallel_to_aec_wrapper",
        }
    ),
    "stable_baselines3": frozenset(
        {"DummyVecEnv", "Monitor", "VecCheckNan", "VecMonitor", "VecVideoRecorder"}
    ),
    "minari": frozenset({"DataCollector"}),
    "lagros_benchmarks": frozenset({"ParallelVecEnv", "SB3VectorEnv"}),
}
# What a subclass may override and still change neither observations nor actions.
_APART = frozenset({"class_name", "close", "metadata", "render", "render_mode", "reward", "spec"})
# With these a class answers in place of all that it has.
_HOOKS = ("__getattribute__",)
# What the wrappers of Gymnasium that map observations or actions define.
_MAPPINGS = ("observation", "observations", "action", "actions")
# Where wrappers keep what they wrap.
_INNER = ("env", "venv", "aec_env")
_SPACES = ("observation_space", "action_space")


def bare_environment(env: Any, allow_wrappers: bool = False) -> Any:
    """Return the environment of this package that lies beneath wrappers, if these are harmless.

    Args:
        env: An environment of Gymnasium, PettingZoo or stable-baselines3, wrapped or not, alone or
            several together; or the id of one, or its `EnvSpec`.
        allow_wrappers: Look through whatever lies in between.

    Returns:
        The environment; of several the first, as all are alike.

    Raises:
        ValueError: A wrapper may change what an observation or an action means, environments of
            one vector differ, or there is no such id.
        TypeError: There is no environment of this package.
    """
    if isinstance(env, str | gym.envs.registration.EnvSpec):
        env = _made(env)
    level = env
    while not _is_ours(type(level)):
        together = _together(level)
        inner = _inner(level)
        if together is None and inner is None:
            raise TypeError(f"there are no policies for {env}; use an environment of lagros_envs")
        if not allow_wrappers:
            _check(level, inner)
        if together is not None:
            return _one_of(type(level).__name__, together, allow_wrappers)
        level = inner
    if getattr(level, "settings", None) is None:
        # Somebody else's, which `disturb` has wrapped.
        raise TypeError(f"there are no policies for {env}; use an environment of lagros_envs")
    if not allow_wrappers:
        _check(level, None)
    return level


def _made(name: Any) -> Any:
    from lagros_envs.registry import task_named, task_names

    try:
        return gym.make(name)
    except (gym.error.Error, ImportError) as error:
        known = " or ".join(repr(task_named(one).env_id) for one in task_names())
        raise ValueError(
            f"env={name!r} cannot be made ({error}); name {known}, or give an environment"
        ) from error


def _is_ours(kind: type) -> bool:
    return any(_package(base) == "lagros_envs" for base in kind.__mro__)


def _package(kind: type) -> str:
    return kind.__module__.partition(".")[0]


def _inner(env: Any) -> Any:
    """Return what a wrapper wraps; None if it wraps nothing."""
    if isinstance(env, type | ModuleType):
        return None
    members = getattr(env, "__dict__", {})
    return next((members[name] for name in _INNER if members.get(name) is not None), None)


def _together(env: Any) -> list[Any] | None:
    """Return the environments of a vector that runs them side by side; None if it is none."""
    members = getattr(env, "__dict__", {})
    for name in ("envs", "worlds"):
        if isinstance(members.get(name), list | tuple):
            return list(members[name])
    if isinstance(env, gym.vector.AsyncVectorEnv):
        # They live in other processes; these are made alike.
        return [make() for make in env.env_fns]
    return None


def _one_of(vector: str, envs: Iterable[Any], allow_wrappers: bool) -> Any:
    """Return the first of some environments, all of which must be alike."""
    worlds = [bare_environment(env, allow_wrappers) for env in envs]
    first = worlds[0]
    for index, world in enumerate(worlds):
        here, there = _told(world), _told(first)
        for name in here:
            if here[name] != there.get(name):
                raise ValueError(
                    f"the environments 0 and {index} of {vector} differ in their {name}; a policy "
                    "is for one: give it one of the environments"
                )
    return first


def _told(world: Any) -> dict[str, Any]:
    """Return what a policy is told of an environment, by name."""
    own = named_in(world.settings, "told", None)
    common = {"settings": world.settings, "disturbance_bound": world.disturbance.bound}
    return common if own is None else common | own(world, {})


def _check(env: Any, inner: Any) -> None:
    """Refuse a wrapper, or a subclass of an environment, that may change what is seen or done."""
    kind = type(env)
    change = what_it_changes(kind) or _replaced(env)
    if change is None and inner is not None:
        spaces = (name for name in _SPACES if _space(env, name) != _space(inner, name))
        change = next((f"has another {name}" for name in spaces), None)
    if change is not None:
        raise ValueError(
            f"{kind.__name__} {change}, and may change what an observation or an action means: "
            "build the policy from the environment without it, or pass allow_wrappers=True if it "
            "changes neither"
        )


def what_it_changes(kind: type) -> str | None:
    """Say what a class does that may change observations or actions.

    Returns:
        In words; None if it does nothing of the kind.
    """
    overridden: list[str] = []
    for base in kind.__mro__:
        package = _package(base)
        if package == "lagros_envs" or base.__name__ in HARMLESS.get(package, ()):
            names = (name for name in overridden if name in _MAPPINGS or hasattr(base, name))
            return next((f"overrides {name}" for name in names), None)
        own = (name for name in vars(base) if name in _HOOKS or not name.startswith("__"))
        overridden += [name for name in own if name not in _APART]
    return "is not known"


def _replaced(env: Any) -> str | None:
    """Say which method of its class an object has another function for; None for none."""
    own = (name for name, value in vars(env).items() if callable(value) and name not in _APART)
    found = (name for name in own if callable(getattr(type(env), name, None)))
    return next((f"has {name} replaced" for name in found), None)


def _space(env: Any, name: str) -> Any:
    """Return a space of one world; None where it depends on the agent."""
    space = getattr(env, f"single_{name}", None)
    if space is None:
        space = getattr(env, name, None)
    return space if isinstance(space, gym.Space) else None
