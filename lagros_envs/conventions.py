"""What Gymnasium and the libraries around it expect of any environment, in one place."""

from __future__ import annotations

import copy
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields, is_dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from lagros_envs.checks import check_seed, check_whole, shown, suggestion

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

RENDER_MODES = ("human", "rgb_array")

Settings = TypeVar("Settings", bound="DataclassInstance")


class LimitedSettings(Protocol):
    """Settings of a task whose episodes have a time limit."""

    @property
    def control_period(self) -> float:
        """Length of a control step [s]."""

    @property
    def time_limit(self) -> float:
        """Length of an episode [s]."""

    @property
    def steps(self) -> int:
        """Control steps of an episode that runs to its limit."""


class Conforming:
    """Behaviour that every environment owes: copies are independent, and its spec can be written.

    Attributes:
        settings: The task.
    """

    settings: LimitedSettings
    _spec: EnvSpec | None = None

    @property
    def step_limit(self) -> int:
        """Control steps after which an episode is truncated."""
        return self.settings.steps

    def _usual_steps(self) -> int | None:
        """Return the limit that the id is registered with; None for none."""
        return type(self.settings)().steps

    def __copy__(self) -> Self:
        """Return a copy that shares nothing: one that shared arrays would step both."""
        return copy.deepcopy(self)

    @property
    def spec(self) -> EnvSpec | None:
        """What the environment was made from; its arguments are plain, so that it becomes JSON."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        """Take the spec from `gym.make` or `gym.make_vec`.

        Raises:
            ValueError: `gym.make` was given settings and a limit of steps that contradict.
        """
        if value is not None:
            check_step_limit(_limit_from_make(), self.settings, self._usual_steps())
            # The environment truncates by itself, with Gymnasium's wrapper around it or without.
            value = replace(value, kwargs=plain(value.kwargs), max_episode_steps=self.step_limit)
        self._spec = value


def check_step_limit(limit: int | None, settings: LimitedSettings, usual: int | None) -> None:
    """Check Gymnasium's `max_episode_steps` against the task's own time limit.

    An id is registered with the limit of the default settings, which so stands for none being
    asked for. A limit shorter than the task's ends episodes sooner.

    Args:
        limit: Control steps; None for no limit.
        settings: The task.
        usual: The limit that the id is registered with; None for none.

    Raises:
        ValueError: The limit is not a positive number, is longer than the task's, or is that of
            default settings while these have longer episodes.
    """
    if limit is None:
        return
    check_whole("max_episode_steps", limit)
    if limit > settings.steps and limit != usual:
        raise ValueError(
            f"max_episode_steps={limit} is beyond the {settings.steps} control steps of "
            f"settings.time_limit={settings.time_limit:g}: a longer episode is another task, with "
            f"settings of time_limit={limit * settings.control_period:g}"
        )
    if limit == usual and limit < settings.steps:
        raise ValueError(
            f"settings.time_limit={settings.time_limit:g} is {settings.steps} control steps, and "
            f"Gymnasium ends the episodes of this id after max_episode_steps={limit} unless told "
            f"otherwise: pass max_episode_steps={settings.steps}, too"
        )


def _limit_from_make() -> int | None:
    """Return the limit that the `gym.make` in the midst of which this runs will put on episodes.

    Gymnasium wraps its TimeLimit around an environment without telling it: what was asked of
    `gym.make` stands in its frame only. Anywhere else there is no limit.
    """
    # This function, the setter, and who sets the spec.
    caller = sys._getframe(2)
    if caller.f_code is not gym.make.__code__:
        return None
    asked, spec = (caller.f_locals.get(name) for name in ("max_episode_steps", "env_spec"))
    limit: int | None = getattr(spec, "max_episode_steps", None) if asked is None else asked
    return None if limit == -1 else limit


def plain(value: Any) -> Any:
    """Return arguments of an environment in a form that JSON holds, as far as there is one.

    Settings become the dictionaries that environments read; a function stays.
    """
    if is_dataclass(value) and not isinstance(value, type) and not callable(value):
        return plain(asdict(value))
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, AutoresetMode):
        return value.name.lower()
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def plain_seed(seed: int | np.integer[Any] | None) -> int | None:
    """Return the seed of a reset as Python's own number; None stays None.

    Raises:
        ValueError: It is not a non-negative integer.
    """
    if seed is None:
        return None
    check_seed(int(seed) if isinstance(seed, np.integer) else seed)
    return int(seed)


def check_render_mode(render_mode: str | None) -> str | None:
    """Return a render mode that is known.

    Raises:
        ValueError: It is not.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(
            f"render_mode={shown(render_mode)} is not known; use one of "
            f"{list(RENDER_MODES)} or None"
        )
    return render_mode


class NotStartedError(RuntimeError, AttributeError):
    """Something of an episode was asked for before `reset`; to `hasattr` there is none."""


def check_started(started: bool, what: str) -> None:
    """Refuse what only an episode has.

    Raises:
        NotStartedError: The environment was not reset.
    """
    if not started:
        raise NotStartedError(f"call reset() before {what}")


class End(Enum):
    """How far an episode is from its end."""

    NOT_YET = "not yet"
    REACHED = "reached"
    WARNED = "warned"  # of a step beyond it


def warned_after(end: End) -> End:
    """Say once that `step` was called after the end, as Gymnasium's own environments do."""
    if end is End.REACHED:
        gym.logger.warn(
            "You are calling 'step()' even though this environment has already returned "
            "terminated = True or truncated = True. You should always call 'reset()' once you "
            "receive either -- any further steps are undefined behavior."
        )
    return End.WARNED


@contextmanager
def beyond_the_end() -> Iterator[None]:
    """Step on after the end without being warned, where what happens there is measured, too."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*even though this environment has already")
        yield


def settings_of(default: Settings, given: Settings | Mapping[str, Any] | None) -> Settings:
    """Return the settings of a task from what an environment was given.

    Args:
        default: The default settings.
        given: Settings; a dictionary of those fields that differ from the default, such as
            `dataclasses.asdict` or a spec read from JSON gives; or None for the default.

    Raises:
        ValueError: It is neither, has an unknown field, or a value that cannot be.
    """
    if given is None:
        return default
    return built_like(default, given, "settings")


def built_like(default: Settings, given: Any, name: str) -> Settings:
    """Return a dataclass: the one given, or the default with the entries of a dictionary.

    Args:
        default: An instance, whose fields may be dataclasses again.
        given: An instance, or a dictionary.
        name: What the caller calls it.

    Raises:
        ValueError: It is neither, or an entry is unknown or has a value that cannot be.
    """
    if isinstance(given, type(default)):
        return given
    if not isinstance(given, Mapping):
        raise ValueError(
            f"{name}={shown(given)} must be a {type(default).__name__} or a dictionary of its "
            "fields"
        )
    known = [item.name for item in fields(default)]
    changes = {}
    for key, value in given.items():
        if key not in known:
            raise ValueError(
                f"{name} has no entry {shown(key)}; it has {', '.join(known)}."
                f"{suggestion(key, known)}"
            )
        usual = getattr(default, key)
        nested = is_dataclass(usual) and not isinstance(usual, type)
        changes[key] = built_like(usual, value, f"{name}.{key}") if nested else value
    return replace(default, **changes)
