"""`lagros/Spacecraft-v0`: one spacecraft among obstacles, as a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import gymnasium as gym
from gymnasium import spaces

from lagros_envs.arrays import Float32Array, FloatArray
from lagros_envs.conventions import RENDER_MODES, check_render_mode
from lagros_envs.options import checked_actions, real_numbers
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.episode import (
    OneWorld,
    SpacecraftEpisode,
    action_space,
    infos_by_agent,
)
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.sensing import observe


class SpacecraftEnv(OneWorld, gym.Env[Float32Array, Float32Array]):
    """One spacecraft that seeks its goal among obstacles, under bounded disturbance.

    The world, action, observation, reward and info of `SpacecraftParallelEnv` with a
    single agent: the one slot for a neighbour is always empty. `terminated` at a collision,
    `truncated` at the time limit of the preset, 45 s of `paper`; the episode goes on after the
    arrival. `gym.make(..., max_episode_steps=20)` ends it sooner.

    `reset(options=...)` takes `scenario`, a `tasks.spacecraft.scenarios.Scenario` of one agent,
    and `nominal`, x_d at every control instant, shape (steps + 1, 6).

    The arguments from `preset` to `settings` are those of `SpacecraftParallelEnv`.

    Args:
        render_mode: None, "human" or "rgb_array".

    Raises:
        ValueError: A setting is not valid.
    """

    settings: task.SpacecraftSettings
    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}

    def __init__(
        self,
        preset: str | Preset | Mapping[str, Any] = "paper",
        disturbance: str | Any = "none",
        disturbance_bound: float = 0.4,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool] = "all",
        metric: Any = None,
        settings: task.SpacecraftSettings | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.episode = SpacecraftEpisode(
            1, preset, disturbance, disturbance_bound, disturbance_channels, metric, settings
        )
        self.settings, self.preset = self.episode.settings, self.episode.preset
        self.disturbance = self.episode.disturbance
        self.named_space = self.episode.layout.named_space
        self.observation_space = cast(
            "spaces.Space[Float32Array]", spaces.flatten_space(self.named_space)
        )
        self.action_space = cast("spaces.Space[Float32Array]", action_space())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the episode; the scenario and the disturbance have a stream each.
            options: `scenario` and `nominal`, see the class.

        Returns:
            The observation and the info.

        Raises:
            ValueError: The seed is none, or an option is unknown or has a wrong type, shape or
                value.
        """
        self._begin(seed, _with_agents(options))
        return self._observation(), self._info()

    def step(self, action: Float32Array) -> tuple[Float32Array, float, bool, bool, dict[str, Any]]:
        """Hold the thrust for one control step.

        Args:
            action: Thrust in units of `settings.thrust_scale`, shape (8,).

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            ValueError: The action is not eight finite numbers.
            RuntimeError: The environment was not reset.
        """
        self.episode.need_start("step()")
        values = checked_actions(action, (task.THRUSTERS,), task.ACTION)
        outcome = self.episode.step(task.applied_forces(self.settings, values)[None])
        if self.render_mode == "human":
            self.render()
        return (
            self._observation(),
            float(outcome.reward[0, 0]),
            bool(outcome.terminated[0, 0]),
            bool(outcome.truncated[0, 0]),
            self._info(),
        )

    @property
    def state(self) -> FloatArray:
        """The state x in double precision, shape (6,)."""
        self.episode.need_start("state")
        return cast(FloatArray, self.episode.world.states[0, 0])

    def _usual_steps(self) -> None:
        """Return none: every preset has its own limit, which the environment keeps by itself."""

    def _observation(self) -> Float32Array:
        return cast(Float32Array, observe(self.episode.world, self.episode.layout)[0, 0])

    def _info(self) -> dict[str, Any]:
        return infos_by_agent(self.episode.world.info())[0]


def _with_agents(options: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Give a nominal (steps + 1, 6) the axis of the one agent."""
    if not isinstance(options, Mapping):
        return options
    nominal = real_numbers(options.get("nominal"))
    if nominal is None or nominal.ndim != 2:
        return options
    return {**options, "nominal": nominal[:, None]}
