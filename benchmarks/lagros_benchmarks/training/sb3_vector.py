"""Our vector environments as stable-baselines3 `VecEnv`s: one array operation for all worlds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lagros_envs.checks import shown
from lagros_envs.conventions import plain_seed

Indices = int | Iterable[int] | None


def world_seeds(seed: int | None, worlds: int) -> list[int]:
    """Return seed, seed + 1, ... for the worlds; from a random one if there is none.

    Raises:
        ValueError: The seed is not a non-negative integer.
    """
    given = plain_seed(seed)
    first = int(np.random.default_rng().integers(2**32)) if given is None else given
    return list(range(first, first + worlds))


class AlikeVecEnv(VecEnv):
    """What our `VecEnv`s share: worlds that start alike, and the entries of episodes that ended."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._actions: NDArray[Any] | None = None
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, dtype=np.intp)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions (rows, m) of the coming step."""
        self._actions = actions

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        """Return False per chosen row, or True for Monitor, whose `episode` entry is provided."""
        from stable_baselines3.common.monitor import Monitor

        return [wrapper_class is Monitor for _ in self._get_indices(indices)]

    def _begin_episodes(self) -> None:
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self.reset_infos = [{} for _ in range(self.num_envs)]

    def _taken(self) -> NDArray[Any]:
        """Return the actions of this step."""
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        actions, self._actions = self._actions, None
        return actions

    def _close_episodes(
        self, rewards: NDArray[Any], done: NDArray[np.bool_], infos: list[dict[str, Any]]
    ) -> None:
        """Add up returns, and note those of the episodes that are over."""
        self._returns += rewards
        self._lengths += 1
        for row in np.flatnonzero(done):
            infos[row]["episode"] = {"r": float(self._returns[row]), "l": int(self._lengths[row])}
        self._returns[done] = 0.0
        self._lengths[done] = 0

    def _check_all(self, name: str, indices: Indices) -> None:
        """Refuse to set an attribute for some rows, as those of a world share it.

        Raises:
            ValueError: Only some were chosen.
        """
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"the rows share {name!r}: it can be set for all of them only")

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Refuse options for the next reset, which the worlds would not get.

        Raises:
            ValueError: There are options.
        """
        if options and any(options if isinstance(options, list) else [options]):
            raise ValueError(
                f"options={shown(options)}: {type(self).__name__} starts its worlds without "
                "options; give the environment other settings, or reset it yourself"
            )
        super().set_options(options)


class SB3VectorEnv(AlikeVecEnv):
    """A Gymnasium vector environment in same-step autoreset mode, as stable-baselines3 wants it.

    Where an episode ends, the info of that world holds what stable-baselines3 reads there:
    `terminal_observation` (the last observation of the episode; the one returned already belongs
    to the next), `TimeLimit.truncated` (it ended by the time limit alone, so that the value beyond
    it is bootstrapped), `episode` (`r` return, `l` length), and the final entries of our own info.
    The infos of the other worlds are empty.

    Args:
        venv: The environment, with `autoreset_mode="same_step"` and flat Box spaces.

    Raises:
        ValueError: It is no vector environment, or resets in another mode.
    """

    def __init__(self, venv: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(venv, gym.vector.VectorEnv):
            raise ValueError(
                f"venv={shown(venv)} must be a vector environment, such as gym.make_vec("
                '"lagros/...", num_envs=64, autoreset_mode="same_step")'
            )
        mode = venv.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"autoreset_mode is {mode}; stable-baselines3 needs a vector environment built "
                'with autoreset_mode="same_step"'
            )
        self.venv = venv
        super().__init__(venv.num_envs, venv.single_observation_space, venv.single_action_space)
        self._seed: int | None = None

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the next reset.

        Returns the seed of each row's world, as stable-baselines3 seeds them: one more for each.
        """
        worlds = getattr(self.venv.unwrapped, "num_worlds", self.num_envs)
        seeds = world_seeds(seed, worlds)
        self._seed = seeds[0]
        return np.repeat(seeds, self.num_envs // worlds).tolist()

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world and return the observations (worlds, n)."""
        observation, _ = self.venv.reset(seed=self._seed)
        self._seed = None
        self._begin_episodes()
        return np.asarray(observation)

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step: observations, rewards, dones and one info per world.

        Raises:
            RuntimeError: `step_async` was not called before.
        """
        observation, reward, terminated, truncated, info = self.venv.step(self._taken())
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(done):
            final = info["final_info"]
            infos[world] = {key: values[world] for key, values in final.items()}
            infos[world]["terminal_observation"] = info["final_obs"][world]
            # A fall at the very last step is a fall: nothing is bootstrapped.
            infos[world]["TimeLimit.truncated"] = bool(truncated[world] and not terminated[world])
        self._close_episodes(reward, done, infos)
        return observation, np.asarray(reward, dtype=np.float32), done, infos

    def close(self) -> None:
        """Close the environment."""
        self.venv.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return the attribute of the environment, once per chosen world."""
        value = getattr(self.venv, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set the attribute for all worlds; they share one environment.

        Raises:
            ValueError: Only some worlds were chosen.
        """
        self._check_all(attr_name, indices)
        setattr(self.venv, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the environment once and return its value per chosen world."""
        value = getattr(self.venv, method_name)(*method_args, **method_kwargs)
        return [value for _ in self._get_indices(indices)]


class LinearFeatures(VecEnvWrapper):
    """Shows the agent fixed linear combinations of the observation.

    Args:
        venv: The environment, with flat observations of n numbers.
        matrix: Features from observations, shape (k, n).

    Raises:
        ValueError: The matrix does not fit the observation.
    """

    def __init__(self, venv: VecEnv, matrix: NDArray[np.float64]) -> None:
        if matrix.ndim != 2 or (matrix.shape[1],) != venv.observation_space.shape:
            raise ValueError(
                f"matrix has shape {matrix.shape}; it must be (k, n) with n of the observation's "
                f"shape {venv.observation_space.shape}"
            )
        space = spaces.Box(-np.inf, np.inf, (matrix.shape[0],), np.float32)
        super().__init__(venv, observation_space=space)
        self.matrix = matrix.astype(np.float32)

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world and return the features (worlds, k)."""
        features: NDArray[np.float32] = np.asarray(self.venv.reset()) @ self.matrix.T
        return features

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step and map the observations, those of ended episodes included."""
        observation, reward, done, infos = self.venv.step_wait()
        for world in np.flatnonzero(done):
            infos[world]["terminal_observation"] = (
                self.matrix @ infos[world]["terminal_observation"]
            )
        return np.asarray(observation) @ self.matrix.T, reward, done, infos
