"""PettingZoo's parallel environments as a stable-baselines3 `VecEnv`: one row for each agent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lagros_benchmarks.training.sb3_vector import AlikeVecEnv, Indices, world_seeds
from lagros_envs.checks import shown


class ParallelVecEnv(AlikeVecEnv):
    """Parallel environments whose agents stay together, for one policy that all agents share.

    Row `world * agents + agent` is that agent of that world: row for row what `SB3VectorEnv` over
    their vector form gives, from the same seeds, one world after the other. The agents of a
    world must begin and end together; a world that ends starts anew in the same step. Where it
    does, the info of each of its rows holds what stable-baselines3 reads there:
    `terminal_observation` (the last observation of the episode; the one returned already belongs
    to the next), `TimeLimit.truncated` (it ended by the time limit alone, so that the value beyond
    it is bootstrapped), `episode` (`r` return, `l` length), and the agent's own info. The other
    infos are empty; those of the resets are in `reset_infos`.

    Args:
        worlds: The environments, of the same agents and spaces; or a single one.

    Raises:
        ValueError: There is no environment, or agents differ in their spaces, or worlds in their
            agents.
    """

    def __init__(self, worlds: Sequence[ParallelEnv[Any, Any, Any]] | ParallelEnv[Any, Any, Any]):
        # PettingZoo's own annotations are partial.
        self.worlds: list[Any] = list(worlds) if isinstance(worlds, Sequence) else [worlds]
        if not self.worlds:
            raise ValueError("worlds is empty; give at least one parallel environment")
        for index, world in enumerate(self.worlds):
            if not hasattr(world, "possible_agents"):
                raise ValueError(
                    f"world {index} is {shown(world)}; it must be a parallel environment of "
                    "PettingZoo, such as what parallel_env() of a world of many agents returns"
                )
        first = self.worlds[0]
        self.agents = list(first.possible_agents)
        name = self.agents[0]
        spaces = first.observation_space(name), first.action_space(name)
        for index, world in enumerate(self.worlds):
            if list(world.possible_agents) != self.agents:
                raise ValueError(
                    f"world {index} has the agents {world.possible_agents} and world 0 has "
                    f"{self.agents}; all worlds must have the same"
                )
            for agent in self.agents:
                if (world.observation_space(agent), world.action_space(agent)) != spaces:
                    raise ValueError(
                        f"{agent} of world {index} has other spaces than {name} of world 0; "
                        "agents that share a policy must have the same"
                    )
        super().__init__(len(self.worlds) * len(self.agents), *spaces)
        self._np_random, _ = seeding.np_random(None)
        self._first: list[int] | None = None

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the next reset, from which all later episodes draw theirs, too.

        Returns the seed of each row's world, as stable-baselines3 seeds them: one more for each.
        """
        self._first = world_seeds(seed, len(self.worlds))
        self._np_random, _ = seeding.np_random(self._first[0])
        return np.repeat(self._first, len(self.agents)).tolist()

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world and return the observations (rows, n)."""
        self._begin_episodes()
        first, self._first = self._first, None
        return np.stack(self._begin(range(len(self.worlds)), first))

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step: observations, rewards, dones and one info per row.

        Raises:
            RuntimeError: `step_async` was not called before, or some agents of a world ended
                without the others.
        """
        actions = self._taken()
        rows: list[NDArray[np.float32]] = []
        rewards: list[float] = []
        dones: list[bool] = []
        infos: list[dict[str, Any]] = []
        ended: list[int] = []
        for index, world in enumerate(self.worlds):
            part = actions[self._rows(index)]
            step = world.step(dict(zip(self.agents, part, strict=True)))
            over = self._over(world)
            if over:
                ended.append(index)
            for agent in self.agents:
                observation, reward, terminated, truncated, info = (each[agent] for each in step)
                rows.append(observation)
                rewards.append(float(reward))
                dones.append(over)
                infos.append(_final(observation, terminated, truncated, info) if over else {})
        self._close_episodes(np.array(rewards), np.array(dones), infos)
        # After all worlds have moved, in their order: the draw that a vector environment makes.
        if ended:
            fresh = iter(self._begin(ended))
            rows = [next(fresh) if done else row for row, done in zip(rows, dones, strict=True)]
        return np.stack(rows), np.array(rewards, np.float32), np.array(dones), infos

    def close(self) -> None:
        """Close the environments."""
        for world in self.worlds:
            world.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a frame of every world, which `render` puts into one picture."""
        return [world.render() for world in self.worlds]

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return the attribute of the world of each chosen row."""
        return [getattr(world, attr_name) for world in self._worlds_of(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set the attribute of every world.

        Raises:
            ValueError: Only some rows were chosen.
        """
        self._check_all(attr_name, indices)
        for world in self.worlds:
            setattr(world, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method once in each world that has a chosen row; return its value for each row."""
        chosen = self._worlds_of(indices)
        values = {
            id(world): getattr(world, method_name)(*method_args, **method_kwargs)
            for world in {id(world): world for world in chosen}.values()
        }
        return [values[id(world)] for world in chosen]

    def _rows(self, world: int) -> slice:
        return slice(world * len(self.agents), (world + 1) * len(self.agents))

    def _worlds_of(self, indices: Indices) -> list[Any]:
        count = len(self.agents)
        return [self.worlds[int(row) // count] for row in self._get_indices(indices)]

    def _begin(
        self, indices: Sequence[int], seeds: list[int] | None = None
    ) -> list[NDArray[np.float32]]:
        """Start an episode in some worlds and return the observations of their agents."""
        words = seeds or self._np_random.integers(2**63, size=len(indices)).tolist()
        rows = []
        for index, word in zip(indices, words, strict=True):
            observations, infos = self.worlds[index].reset(seed=word)
            rows += [observations[agent] for agent in self.agents]
            self.reset_infos[self._rows(index)] = [infos[agent] for agent in self.agents]
        return rows

    def _over(self, world: Any) -> bool:
        """Tell whether the episode of a world is over."""
        if world.agents and list(world.agents) != self.agents:
            raise RuntimeError(
                f"only {world.agents} of {self.agents} go on; this adapter needs agents that end "
                "together"
            )
        return not world.agents


def _final(
    observation: NDArray[np.float32], terminated: bool, truncated: bool, info: dict[str, Any]
) -> dict[str, Any]:
    """Return the info of a row whose episode is over."""
    return {
        **info,
        "terminal_observation": observation,
        # All collided at the very last step: nothing is bootstrapped.
        "TimeLimit.truncated": bool(truncated and not terminated),
    }
