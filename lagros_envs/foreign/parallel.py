"""A parallel environment of PettingZoo under bounded disturbance."""

from __future__ import annotations

import copy
from typing import Any

from pettingzoo.utils.wrappers import BaseParallelWrapper

from lagros_envs.disturbances import Disturbance
from lagros_envs.foreign.pushes import Pushes


class DisturbParallel(BaseParallelWrapper[Any, Any, Any]):
    """A PettingZoo environment under disturbance; see `disturb` for the arguments.

    Where the state has a row for each possible agent, the `info` of an agent has its own row of d,
    and otherwise all of it.
    """

    def __init__(self, env: Any, **settings: Any) -> None:
        super().__init__(env)
        self.pushes = Pushes(**settings)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[Any, Any], dict[Any, dict[str, Any]]]:
        """Begin an episode; the seed is that of the environment and of the disturbance."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self.pushes.begin(self.env, self._limit(), seed)
        return observations, self._told(infos)

    def step(
        self, actions: dict[Any, Any]
    ) -> tuple[
        dict[Any, Any],
        dict[Any, float],
        dict[Any, bool],
        dict[Any, bool],
        dict[Any, dict[str, Any]],
    ]:
        """Push the state, and let the environment make its step."""
        if self.env.agents:
            self.pushes.apply(self.env)
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        return observations, rewards, terminated, truncated, self._told(infos)

    @property
    def disturbance(self) -> Disturbance:
        """Kind and bound."""
        return self.pushes.disturbance

    def __copy__(self) -> DisturbParallel:
        """Return a copy that shares nothing."""
        return copy.deepcopy(self)

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled, which the base would look for in the environment."""
        return dict(self.__dict__)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what was pickled."""
        self.__dict__.update(state)

    def _limit(self) -> int | None:
        # The names under which MPE and others keep it.
        own = self.env.unwrapped
        for name in ("max_cycles", "max_steps", "max_episode_steps"):
            limit = getattr(own, name, None)
            if isinstance(limit, int):
                return limit
        return None

    def _told(self, infos: dict[Any, dict[str, Any]]) -> dict[Any, dict[str, Any]]:
        push, agents = self.pushes.now, list(self.env.possible_agents)
        each = push.ndim == 2 and len(push) == len(agents)
        rows = dict(zip(agents, push, strict=True)) if each else {}
        return {
            agent: {**info, "disturbance": rows.get(agent, push)} for agent, info in infos.items()
        }
