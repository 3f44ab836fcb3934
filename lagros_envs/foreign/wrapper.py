"""`disturb`: an environment of Gymnasium or PettingZoo with bounded disturbance."""

from __future__ import annotations

import copy
from typing import Any, SupportsFloat

import gymnasium as gym

from lagros_envs.conventions import Conforming, plain
from lagros_envs.disturbances import Disturbance
from lagros_envs.foreign.adapters import Adapter
from lagros_envs.foreign.pushes import Pushes
from lagros_envs.of_task import Channels


def disturb(
    env: Any,
    kind: Any = "uniform",
    *,
    bound: float,
    channels: Channels = "all",
    scale: Any = None,
    adapter: Adapter | str | None = None,
    period: float | None = None,
    steps: int | None = None,
) -> Any:
    """Wrap an environment of anybody's so that a bounded disturbance d pushes its state.

    At the beginning of every step the state is moved by period * d, ||d / scale|| <= bound, and the
    environment then makes its own step. The sequence of an episode depends on the seed of its
    reset alone, not on what a policy does, and a larger bound is the same sequence, larger.

    Args:
        env: A Gymnasium environment, or a parallel one of PettingZoo; not a vector of them, of
            which each is wrapped: `gym.make_vec(id, n, wrappers=[partial(disturb, bound=0.5)])`.
        kind: A name of `lagros_envs.disturbances.OPEN_LOOP`, such as "uniform", "constant" or
            "gust"; a function of a `Situation` (which has no nominal) whose value is projected onto
            the ball; or a sequence of pushes d / scale, shape (steps, n), such as `lagros attack`
            finds.
        bound: d_bar, the largest ||d / scale||, in units of the state per second; of several bodies
            that of each.
        channels: Disturbed coordinates: "all", "rates" where the adapter knows them, or a mask.
        scale: What counts as one unit of each coordinate, a number or (n,); None for ones.
        adapter: How the state is read and set, an object or "module:Class"; None for what is
            shipped: environments with an attribute `state`, MuJoCo, MPE, VMAS.
        period: Control step [s]; None for what the adapter or the environment says.
        steps: Steps of an episode, for which the disturbance is drawn; None for the limit of the
            environment. After them the last push stays.

    Returns:
        The environment within a `Disturb`, or a `DisturbParallel`. Every `info` says
        `disturbance`, d of the step that led to it, in units of the state per second.

    Raises:
        TypeError: It is no such environment, or the adapter lacks a method.
        ValueError: A setting is not valid. What depends on the state is checked at the first
            reset: adapter, channels, scale, period, steps.
    """
    own = getattr(env, "unwrapped", None)
    if isinstance(own, Conforming):
        raise ValueError(
            f"{env} has a disturbance of its own: gym.make(..., disturbance={kind!r}, "
            f"disturbance_bound={bound!r})"
        )
    settings: dict[str, Any] = {
        "kind": kind,
        "bound": bound,
        "channels": channels,
        "scale": scale,
        "adapter": adapter,
        "period": period,
        "steps": steps,
    }
    if isinstance(env, gym.Env):
        return Disturb(env, **settings)
    from pettingzoo import ParallelEnv

    if isinstance(env, ParallelEnv):
        from lagros_envs.foreign.parallel import DisturbParallel

        return DisturbParallel(env, **settings)
    raise TypeError(
        f"env={env!r} must be an environment of Gymnasium, or a parallel one of PettingZoo "
        "(aec_to_parallel makes one of the other kind); of a vector wrap each: "
        "gym.make_vec(..., wrappers=[partial(disturb, ...)])"
    )


class Disturb(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """A Gymnasium environment under disturbance; see `disturb` for the arguments.

    Observations, actions, rewards and ends are the environment's own. Copies share nothing, and the
    spec becomes JSON unless kind or adapter are objects.

    Attributes:
        pushes: What moves the state.
        settings: The `Foreign` that made it, for the policies; None where nothing did.
    """

    settings: Any = None

    def __init__(
        self,
        env: gym.Env[Any, Any],
        kind: Any = "uniform",
        *,
        bound: float,
        channels: Channels = "all",
        scale: Any = None,
        adapter: Adapter | str | None = None,
        period: float | None = None,
        steps: int | None = None,
    ) -> None:
        pushes = Pushes(kind, bound, channels, scale, adapter, period, steps)
        gym.utils.RecordConstructorArgs.__init__(
            self,
            kind=plain(kind),
            bound=bound,
            channels=plain(channels),
            scale=plain(scale),
            adapter=adapter,
            period=period,
            steps=steps,
        )
        super().__init__(env)
        self.pushes = pushes

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the seed is that of the environment and of the disturbance."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.pushes.begin(self.env, self._limit(), seed)
        return observation, {**info, "disturbance": self.pushes.now}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Push the state, and let the environment make its step."""
        self.pushes.apply(self.env)
        observation, reward, terminated, truncated, info = self.env.step(action)
        info = {**info, "disturbance": self.pushes.now}
        return observation, reward, terminated, truncated, info

    @property
    def disturbance(self) -> Disturbance:
        """Kind and bound."""
        return self.pushes.disturbance

    def __copy__(self) -> Disturb:
        """Return a copy that shares nothing: one that shared the environment would step both."""
        return copy.deepcopy(self)

    def _limit(self) -> int | None:
        return None if self.env.spec is None else self.env.spec.max_episode_steps
