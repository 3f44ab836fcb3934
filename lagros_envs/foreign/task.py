"""An environment of somebody else's as the commands know it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium import spaces

from lagros_envs.checks import shown
from lagros_envs.foreign.wrapper import Disturb, disturb
from lagros_envs.of_task import Channels
from lagros_envs.task import Defaults, Described

PREFIX = "gym:"  # of the names of all of them
_FLAT = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


class Facts(NamedTuple):
    """What an environment says of itself.

    Attributes:
        observation_space: Of arrays of one shape.
        action_space: Likewise.
        states: Coordinates of its state.
        control_period: Of a step [s].
        steps: Its limit of steps.
        threshold: The return that counts as solved; None where it names none.
        source: Its class.
    """

    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    states: int
    control_period: float
    steps: int
    threshold: float | None
    source: type


@dataclass(frozen=True)
class Foreign(Described):
    """An environment of Gymnasium's, for `lagros bench` and `lagros attack`.

    `lagros bench gym:Pendulum-v1` is `Foreign("Pendulum-v1")`. One with settings of its own stands
    in a file and has a label: `task = Foreign("Pendulum-v1", {"g": 9.0}, "slow")` in `./mine.py` is
    `lagros bench ./mine.py`, and gym:slow in its tables.

    Attributes:
        env: An id, or a function that makes the environment.
        kwargs: With which it is made.
        label: Its name in tables; needed where anything but an id is given.
        channels: Disturbed coordinates, as for `disturb`, like the next three.
        scale: What counts as one unit of each coordinate.
        adapter: How the state is read and set.
        period: Control step [s].
        steps: Limit of steps of an episode, for an environment without one or to end it sooner.
        bound: d_bar where none is given.

    Raises:
        ValueError: A label is missing.
    """

    env: str | Callable[..., gym.Env[Any, Any]]
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""
    channels: Channels = "all"
    scale: Any = None
    adapter: Any = None
    period: float | None = None
    steps: int | None = None
    bound: float = 0.1

    room = "foreign"

    def __post_init__(self) -> None:
        given = [
            item.name
            for item in fields(self)[1:]
            if item.name not in ("label", "kwargs") and getattr(self, item.name) is not item.default
        ]
        given += ["kwargs"] if self.kwargs else []
        if not self.label and (given or not isinstance(self.env, str)):
            raise ValueError(
                "label='' must be a name for tables: "
                f"{', '.join(given) or 'a function'} makes it another than its id says"
            )

    @property
    def name(self) -> str:  # type: ignore[override]
        """As in `lagros bench NAME`."""
        return PREFIX + (self.label or str(self.env))

    @property
    def title(self) -> str:  # type: ignore[override]
        """The same."""
        return self.name

    @property
    def env_id(self) -> str:
        """The same; there may be no id."""
        return self.name

    @property
    def defaults(self) -> Defaults:  # type: ignore[override]
        """Of the commands."""
        return Defaults(
            policies=("random",), bounds=(self.bound,), bound=self.bound, attack_budget=200
        )

    @cached_property
    def facts(self) -> Facts:
        """What the environment says of itself, once it was made and reset.

        Raises:
            ValueError: It cannot be made, disturbed or flown; the message says why.
        """
        env = self.make("constant", self.bound)
        for what in ("observation", "action"):
            space = getattr(env, f"{what}_space")
            if not isinstance(space, _FLAT):
                raise ValueError(
                    f"{self.name}: its {what}s are of a {type(space).__name__}, and policies are "
                    "asked with arrays of one shape: wrap it, in a file of your own"
                )
        try:
            env.reset(seed=0)
            if env.pushes.knows_rates and isinstance(self.channels, str):
                # Whether all can be pushed is said where all are asked for.
                env = self.disturbed(env.env, "constant", self.bound, "rates")
                env.reset(seed=0)
            env.step(env.action_space.sample())
        except Exception as error:
            raise self._unfit(error) from error
        finally:
            env.close()
        pushes = env.pushes
        if pushes.now.ndim > 1:
            raise ValueError(
                f"{self.name}: its state is of {len(pushes.now)} bodies, {pushes.now.shape}; the "
                "commands fly one, and `disturb` all"
            )
        spec = env.spec
        return Facts(
            env.observation_space,
            env.action_space,
            pushes.now.size,
            pushes.period,
            pushes.steps,
            None if spec is None else spec.reward_threshold,
            type(env.unwrapped),
        )

    @property
    def control_period(self) -> float:
        """Of a step [s]."""
        return self.facts.control_period

    def make(self, kind: Any, bound: float, channels: Any = "all") -> Disturb:
        """Return the environment under a disturbance.

        Args:
            kind: As for `disturb`.
            bound: d_bar.
            channels: "all" for those of the description, or "rates".

        Raises:
            ValueError: It cannot be made.
        """
        return self.disturbed(self.undisturbed(), kind, bound, channels)

    def undisturbed(self) -> gym.Env[Any, Any]:
        """Return the environment alone.

        Raises:
            ValueError: It cannot be made.
        """
        try:
            if isinstance(self.env, str):
                made = gym.make(self.env, disable_env_checker=True, **self.kwargs)
            else:
                made = self.env(**self.kwargs)
        except Exception as error:
            raise self._unfit(error) from error
        if not isinstance(made, gym.Env):
            raise ValueError(f"{self.name} makes {shown(made)}; it must be a gymnasium.Env")
        return made if self.steps is None else gym.wrappers.TimeLimit(made, self.steps)

    def disturbed(self, env: gym.Env[Any, Any], kind: Any, bound: float, channels: Any) -> Disturb:
        """Return one that `undisturbed` gave under a disturbance; see `make`."""
        chosen = self.channels if channels == "all" else channels
        wrapped: Disturb = disturb(
            env,
            kind,
            bound=bound,
            channels=chosen,
            scale=self.scale,
            adapter=self.adapter,
            period=self.period,
            steps=self.steps,
        )
        wrapped.settings = self
        return wrapped

    def _unfit(self, error: Exception) -> ValueError:
        text = " ".join(str(error).split())
        if "pass " in text:
            text += "; for a command in a file of yours, with a lagros_envs.Foreign"
        own = isinstance(error, ValueError | TypeError | gym.error.Error)
        return ValueError(f"{self.name}: {text}" if own else f"{self.name}: {error!r}")
