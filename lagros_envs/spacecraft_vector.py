"""Many spacecraft worlds as one Gymnasium vector environment, with a row for every agent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from lagros_envs import spacecraft_task as task
from lagros_envs.autoreset import autoreset_mode_named
from lagros_envs.observation import global_state, named_state_space, observe
from lagros_envs.scenarios import Preset, Scenario
from lagros_envs.seeding import episode_streams
from lagros_envs.spacecraft_episode import SpacecraftEpisode, action_space, scenario_from_options

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


class SpacecraftVectorEnv(gym.vector.VectorEnv[Float32Array, Float32Array, Any]):
    """Worlds of spacecraft side by side; each row is one agent, the agents of a world together.

    Row `world * num_agents + agent` is that agent of that world, and `reshape(worlds, num_agents,
    ...)` on whatever has a leading axis of rows gives worlds and agents. Spaces, dynamics, reward
    and info are those of `spacecraft.SpacecraftParallelEnv`; the agents of a world end together.

    `reset(seed=...)` takes one integer, from which the worlds draw independent seeds, or a list
    with one seed per *world*, each of which starts the episode that the single environment starts.
    `reset(options=...)` takes `scenarios` (one `Scenario` or None per world), `nominal` (worlds,
    steps + 1, num_agents, 6) and `reset_mask` (worlds,); what the options say of worlds outside the
    mask is not looked at.

    Args:
        num_envs: Number of rows, a multiple of `num_agents`.
        num_agents: Agents in each world.
        preset: As in `SpacecraftParallelEnv`.
        disturbance: As in `SpacecraftParallelEnv`.
        disturbance_bound: As in `SpacecraftParallelEnv`.
        disturbance_channels: As in `SpacecraftParallelEnv`.
        metric: As in `SpacecraftParallelEnv`.
        settings: The task.
        autoreset_mode: "next_step" (Gymnasium's default), "same_step" (the last observation and
            info of an episode come in `info["final_obs"]` and `info["final_info"]`) or "disabled".
        render_mode: Must be None; render a single environment instead.

    Raises:
        ValueError: A setting is not valid.
    """

    metadata = {
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        num_agents: int = 1,
        preset: str | Preset = "paper",
        disturbance: str | Any = "none",
        disturbance_bound: float = 0.4,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool] = "all",
        metric: Any = None,
        settings: task.SpacecraftSettings | None = None,
        autoreset_mode: Literal["next_step", "same_step", "disabled"] | AutoresetMode = "next_step",
        render_mode: str | None = None,
    ) -> None:
        """Build the worlds; see the class for the arguments."""
        if num_agents < 1:
            raise ValueError(f"num_agents={num_agents!r} must be at least 1")
        if num_envs < 1 or num_envs % num_agents:
            raise ValueError(
                f"num_envs={num_envs!r} must be a positive multiple of num_agents={num_agents}: "
                "there is a row for every agent of every world"
            )
        if render_mode is not None:
            raise ValueError(
                f"render_mode={render_mode!r}: the vector environment does not draw; "
                "use spacecraft_v0.parallel_env(render_mode=...)"
            )
        self.num_envs, self.num_agents = num_envs, num_agents
        self.num_worlds = num_envs // num_agents
        self.episode = SpacecraftEpisode(
            num_agents,
            preset,
            disturbance,
            disturbance_bound,
            disturbance_channels,
            metric,
            settings,
            self.num_worlds,
        )
        self.world, self.layout = self.episode.world, self.episode.layout
        self.settings, self.preset = self.episode.settings, self.episode.preset
        self.disturbance = self.episode.disturbance
        self.autoreset_mode = autoreset_mode_named(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = None
        self.named_space = self.layout.named_space
        self.named_state_space = named_state_space(
            num_agents, self.world.obstacles, self.settings.time_limit
        )
        self.single_observation_space = spaces.flatten_space(self.named_space)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        # Worlds whose episode ended and that start anew on the next call of step.
        self._pending = np.zeros(self.num_worlds, bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start an episode in every world, or in those of `options["reset_mask"]`.

        Args:
            seed: One integer, or one per world.
            options: See the class.

        Returns:
            Observations (num_envs, size) and the info, whose entries have a leading axis of rows.

        Raises:
            ValueError: A seed list or an option has a wrong length, shape or value.
        """
        options = options or {}
        seeds = self._seeds(seed)
        if seeds is not None:
            # The episodes that autoreset starts are as reproducible as the first ones.
            self.np_random = np.random.default_rng(seeds)
        elif seed is not None:
            super().reset(seed=int(cast(int, seed)))
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_worlds, bool)))
        if mask.shape != (self.num_worlds,) or mask.dtype != np.bool_:
            raise ValueError(
                f"options['reset_mask'] must be {self.num_worlds} booleans, one per world"
            )
        if not self.episode.started and not mask.all():
            raise ValueError("the first reset must start every world; leave out reset_mask")
        scenarios = self._scenarios(options)
        self._set_nominal(mask, options)
        self._begin(mask, seeds, scenarios)
        self.episode.started = True
        return self._observation(), self._info()

    def step(
        self, actions: Float32Array
    ) -> tuple[Float32Array, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Hold the thrust of every agent for one control step.

        Args:
            actions: Thrust in units of `settings.thrust_scale`, shape (num_envs, 8).

        Returns:
            Observations, rewards, terminated, truncated and info, batched over rows. A world that
            starts anew on this call (next-step autoreset) ignores its actions and has reward 0.

        Raises:
            ValueError: The actions have a wrong shape or are not finite.
            RuntimeError: The environment was not reset.
        """
        self.episode.need_start()
        values = task.checked_actions(actions, (self.num_envs, task.THRUSTERS))
        forces = task.applied_forces(self.settings, values)
        restarting = self._pending
        if restarting.any():
            self._begin_unasked(restarting)
        outcome = self.world.step(
            forces.reshape(self.num_worlds, self.num_agents, task.THRUSTERS), ~restarting
        )
        ended = (outcome.terminated | outcome.truncated)[:, 0]
        self._pending = np.zeros(self.num_worlds, bool)
        info = self._info()
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._pending = ended
        elif self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            info = self._restart_now(ended, info)
        return (
            self._observation(),
            outcome.reward.reshape(-1),
            outcome.terminated.reshape(-1),
            outcome.truncated.reshape(-1),
            info,
        )

    def state(self) -> Float32Array:
        """Return the global state of every world, shape (worlds, size of `named_state_space`)."""
        return global_state(self.world)

    @property
    def states(self) -> FloatArray:
        """The states x in double precision, shape (worlds, num_agents, 6)."""
        return self.world.states

    @property
    def scenarios(self) -> list[Scenario | None]:
        """The scenario of each world."""
        return list(self.world.scenarios)

    def _seeds(self, seed: int | Sequence[int] | None) -> list[int] | None:
        if seed is None or isinstance(seed, int | np.integer):
            return None
        seeds = [int(value) for value in seed]
        if len(seeds) != self.num_worlds or min(seeds) < 0:
            raise ValueError(
                f"seed must be {self.num_worlds} non-negative integers, one per world; it is "
                f"{seed!r}"
            )
        return seeds

    def _scenarios(self, options: dict[str, Any]) -> list[Scenario | None]:
        given = options.get("scenarios")
        if given is None:
            return [None] * self.num_worlds
        if len(given) != self.num_worlds:
            raise ValueError(
                f"options['scenarios'] has {len(given)} entries; it must have {self.num_worlds}, "
                "one per world"
            )
        return [scenario_from_options({"scenario": scenario}) for scenario in given]

    def _set_nominal(self, mask: BoolArray, options: dict[str, Any]) -> None:
        nominal = task.nominal_from_options(
            options, self.settings, (self.num_worlds, self.num_agents)
        )
        world = self.world
        if mask.all() or world.nominal is None:
            self.episode.need_nominal(nominal)
            world.nominal = nominal
        elif nominal is not None:
            world.nominal = np.where(mask[:, None, None, None], nominal, world.nominal)

    def _begin_unasked(self, mask: BoolArray) -> None:
        """Start the episodes of an autoreset, for which nobody has planned a nominal."""
        if self.disturbance.kind == "worst":
            raise ValueError(
                'disturbance="worst" needs nominal trajectories for every episode, and an '
                'autoreset starts one without: use autoreset_mode="disabled" and reset with '
                'options={"nominal": ..., "reset_mask": ...}'
            )
        if self.world.nominal is not None:
            self.world.nominal[mask] = np.nan
        self._begin(mask, None, [None] * self.num_worlds)

    def _begin(
        self, mask: BoolArray, seeds: list[int] | None, scenarios: list[Scenario | None]
    ) -> None:
        """Draw scenario and disturbance of the masked worlds and put their agents at the start."""
        worlds = np.flatnonzero(mask)
        drawn = (
            self.np_random.integers(2**63, size=worlds.size).tolist()
            if seeds is None
            else [seeds[world] for world in worlds]
        )
        streams = [episode_streams(word) for word in drawn]
        chosen = [
            scenarios[world] or self.preset.sample(stream.scenario)
            for world, stream in zip(worlds, streams, strict=True)
        ]
        self.world.begin(worlds, chosen, [stream.disturbance for stream in streams])
        self._pending = self._pending & ~mask

    def _restart_now(self, ended: BoolArray, info: dict[str, Any]) -> dict[str, Any]:
        final_observation = self._observation()
        final_info = info
        self._begin_unasked(ended)
        rows = np.repeat(ended, self.num_agents)
        info = self._info()
        info["final_obs"], info["_final_obs"] = final_observation, rows
        info["final_info"], info["_final_info"] = final_info, rows
        return info

    def _observation(self) -> Float32Array:
        return observe(self.world, self.layout).reshape(self.num_envs, -1)

    def _info(self) -> dict[str, Any]:
        return {
            name: value.reshape(self.num_envs, *value.shape[2:])
            for name, value in self.world.info().items()
        }
