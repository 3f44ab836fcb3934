"""One episode of spacecraft: what their environments share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lagros_envs import spacecraft_task as task
from lagros_envs.disturbances import Disturbance, channel_mask
from lagros_envs.observation import Layout
from lagros_envs.scenarios import Preset, Scenario, preset_named
from lagros_envs.seeding import episode_streams
from lagros_envs.spacecraft_world import SpacecraftWorld

FloatArray = NDArray[np.float64]

RENDER_MODES = ("human", "rgb_array")


class SpacecraftEpisode:
    """Worlds, and how an episode starts in them.

    Args:
        num_agents: Number of agents; None for the preset's own.
        preset: A name of `lagros_envs.scenarios.PRESETS`, or a `Preset`.
        disturbance: As in `SpacecraftParallelEnv`.
        disturbance_bound: As in `SpacecraftParallelEnv`.
        disturbance_channels: As in `SpacecraftParallelEnv`.
        metric: As in `SpacecraftParallelEnv`.
        settings: The task.
        worlds: Number of worlds.
        compiled: As in `SpacecraftWorld`.

    Raises:
        ValueError: A setting is not valid.
    """

    def __init__(
        self,
        num_agents: int | None,
        preset: str | Preset,
        disturbance: str | Any,
        disturbance_bound: float,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool],
        metric: Any,
        settings: task.SpacecraftSettings | None,
        worlds: int = 1,
        compiled: bool | None = False,
    ) -> None:
        """Build the worlds."""
        self.settings = settings or task.SpacecraftSettings()
        self.preset = preset_named(preset).for_agents(num_agents)
        self.disturbance = Disturbance(
            disturbance, disturbance_bound, channel_mask(disturbance_channels, task.RATES), metric
        )
        self.world = SpacecraftWorld(
            worlds,
            self.preset.agents,
            self.preset.obstacle_count[1],
            self.disturbance,
            self.settings,
            compiled,
        )
        self.layout = Layout.of(self.world)
        self.started = False

    def start(self, seed: int, options: dict[str, Any]) -> None:
        """Start the episode of a seed, or of the scenario that the options hold.

        Raises:
            ValueError: An option has a wrong type, shape or value.
        """
        streams = episode_streams(seed)
        scenario = scenario_from_options(options)
        nominal = task.nominal_from_options(options, self.settings, (self.preset.agents,))
        self.need_nominal(nominal)
        if scenario is None:
            scenario = self.preset.sample(streams.scenario)
        self.world.nominal = None if nominal is None else nominal[None]
        self.world.begin(np.zeros(1, np.intp), [scenario], [streams.disturbance])
        self.started = True

    def need_nominal(self, nominal: FloatArray | None) -> None:
        """Refuse the kind "worst" without a plan.

        Raises:
            ValueError: The disturbance needs a nominal trajectory and there is none.
        """
        if self.disturbance.kind == "worst" and nominal is None:
            raise ValueError(
                'disturbance="worst" needs the nominal trajectories of the episode: pass '
                'reset(options={"nominal": array of shape (steps + 1, agents, 6)})'
            )

    def need_start(self) -> None:
        """Refuse to step an environment that was not reset.

        Raises:
            RuntimeError: The environment was not reset.
        """
        if not self.started:
            raise RuntimeError("call reset() before step()")


def scenario_from_options(options: dict[str, Any]) -> Scenario | None:
    """Return the scenario of the options, or None.

    Raises:
        ValueError: It is not a `Scenario`.
    """
    scenario = options.get("scenario")
    if scenario is not None and not isinstance(scenario, Scenario):
        raise ValueError(
            f"options['scenario'] is a {type(scenario).__name__}; it must be a "
            "lagros_envs.scenarios.Scenario (Scenario.load reads one from a file)"
        )
    return scenario


def check_render_mode(render_mode: str | None) -> str | None:
    """Return a render mode that is known.

    Raises:
        ValueError: It is not.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(
            f"render_mode={render_mode!r} is not known; use one of {list(RENDER_MODES)} or None"
        )
    return render_mode


class SpacecraftDrawing:
    """Draws an episode; the renderer, and pygame with it, comes with the first frame."""

    render_mode: str | None
    episode: SpacecraftEpisode
    metadata: dict[str, Any]
    _renderer: Any = None

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene: an RGB array, or a window in the mode "human"."""
        if self.render_mode is None:
            gym.logger.warn(
                "render() was called without a render mode; "
                'pass render_mode="rgb_array" to the constructor'
            )
            return None
        if not self.episode.started:
            raise RuntimeError("call reset() before render()")
        if self._renderer is None:
            from lagros_envs.spacecraft_rendering import SpacecraftRenderer

            self._renderer = SpacecraftRenderer(
                self.render_mode, self.metadata["render_fps"], self.episode.preset.arena
            )
        frame: NDArray[np.uint8] | None = self._renderer.draw(self.episode.world)
        return frame

    def close(self) -> None:
        """Release the window."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def action_space() -> spaces.Box:
    """Return the action space of one agent."""
    return spaces.Box(0.0, 1.0, (task.THRUSTERS,), np.float32)


def one_info(info: dict[str, Any], agent: int) -> dict[str, Any]:
    """Return the info of one agent of the first world, numbers as Python's own."""
    rows = {name: value[0, agent] for name, value in info.items()}
    return {name: row.copy() if np.ndim(row) else row.item() for name, row in rows.items()}
