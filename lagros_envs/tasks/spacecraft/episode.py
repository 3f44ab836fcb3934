"""One episode of spacecraft: what their environments share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray

from lagros_envs.arrays import FloatArray
from lagros_envs.conventions import (
    Conforming,
    End,
    check_started,
    plain_seed,
    warned_after,
)
from lagros_envs.disturbances import Disturbance, channel_mask
from lagros_envs.options import known_options
from lagros_envs.seeding import episode_streams
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import Preset, Scenario, preset_named
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.world import Outcome, SpacecraftWorld


class SpacecraftEpisode:
    """Worlds, and how an episode starts in them.

    The arguments from `preset` to `settings` are those of `SpacecraftParallelEnv`.

    Args:
        num_agents: Number of agents; None for the preset's own.
        worlds: Number of worlds.
        compiled: As in `SpacecraftWorld`.
        max_cycles: As in `SpacecraftParallelEnv`.

    Raises:
        ValueError: A setting is not valid.
    """

    def __init__(
        self,
        num_agents: int | None,
        preset: str | Preset | Mapping[str, Any],
        disturbance: str | Any,
        disturbance_bound: float,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool],
        metric: Any,
        settings: task.SpacecraftSettings | Mapping[str, Any] | None,
        worlds: int = 1,
        compiled: bool | None = False,
        max_cycles: int | None = None,
    ) -> None:
        self.preset = preset_named(preset).for_agents(num_agents)
        self.settings = task.limited(task.settings_for(self.preset, settings), max_cycles)
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
        self.layout = Layout.for_preset(self.preset, self.settings)
        self.started = False
        self.end = End.NOT_YET

    def checked(self, options: Mapping[str, Any] | None) -> dict[str, Any]:
        """Check the options of a reset of one world, and return what `start` is to start from.

        Raises:
            ValueError: An option is unknown, or has a wrong type, shape or value.
        """
        options = known_options(options, task.OPTIONS)
        nominal = task.nominal_from_options(options, self.settings, (self.preset.agents,))
        self.need_nominal(nominal)
        scenario = self.checked_scenario("scenario", options.get("scenario"))
        return {"nominal": nominal, "scenario": scenario}

    def start(self, seed: int, given: dict[str, Any]) -> None:
        """Start the episode of a seed, or of the scenario that was given.

        Args:
            seed: Seed of the episode.
            given: What `checked` returned.

        Raises:
            ValueError: No scenario has the density of the preset.
        """
        streams = episode_streams(seed)
        scenario = given["scenario"] or self.preset.sample(streams.scenario)
        nominal = given["nominal"]
        self.world.begin(np.zeros(1, np.intp), [scenario], [streams.disturbance])
        self.world.nominal = None if nominal is None else nominal[None]
        self.started, self.end = True, End.NOT_YET

    def step(self, forces: FloatArray) -> Outcome:
        """Hold the forces (agents, 8) [N] in the one world for a control step."""
        if self.end is not End.NOT_YET:
            self.end = warned_after(self.end)
        outcome = self.world.step(forces[None])
        if self.end is End.NOT_YET and (outcome.terminated.any() or outcome.truncated.any()):
            self.end = End.REACHED
        return outcome

    def checked_scenario(self, name: str, scenario: Any) -> Scenario | None:
        """Return a scenario that fits into these worlds, or None for none.

        Args:
            name: Of the option that holds it.
            scenario: What it holds.

        Raises:
            ValueError: It is not a `Scenario`, or does not fit.
        """
        if scenario is None:
            return None
        if not isinstance(scenario, Scenario):
            raise ValueError(
                f"options[{name!r}] has a {type(scenario).__name__}; it must be a "
                "lagros_envs.tasks.spacecraft.scenarios.Scenario (Scenario.load reads one)"
            )
        self.world.check(scenario)
        # No observation tells them, so that whoever flies takes the preset's.
        for radius, own, wanted in (
            ("agent_radius", scenario.agent_radius, self.preset.agent_radius),
            ("core_radius", scenario.core, self.preset.core),
        ):
            if own != wanted:
                raise ValueError(
                    f"options[{name!r}] has {radius}={own!r}; this environment's preset has "
                    f"{wanted!r}: build it with preset=dataclasses.replace(PRESETS[...], "
                    f"{radius}={own!r})"
                )
        return scenario

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

    def need_start(self, what: str) -> None:
        """Refuse what only an episode has; see `conventions.check_started`."""
        check_started(self.started, what)


class OneWorld(Conforming):
    """An environment of one world: how its episodes begin, and its picture.

    The renderer, and pygame with it, comes with the first frame.
    """

    render_mode: str | None
    episode: SpacecraftEpisode
    metadata: dict[str, Any]
    _np_random: np.random.Generator | None = None
    _np_random_seed: int | None = None
    _renderer: Any = None

    def _begin(self, seed: int | None, options: Mapping[str, Any] | None) -> None:
        """Start the episode of a seed, or of the next draw; a reset that is refused does nothing.

        Raises:
            ValueError: The seed is none, or an option is unknown or has a wrong type, shape or
                value.
        """
        given = self.episode.checked(options)
        seed = plain_seed(seed)
        if seed is not None or self._np_random is None:
            self._np_random, self._np_random_seed = seeding.np_random(seed)
        self.episode.start(int(self._np_random.integers(2**63)) if seed is None else seed, given)
        if self.render_mode == "human":
            self.render()

    @property
    def scenario(self) -> Scenario:
        """The scenario of the episode."""
        self.episode.need_start("scenario")
        return cast(Scenario, self.episode.world.scenarios[0])

    @property
    def time(self) -> float:
        """The time t [s]."""
        self.episode.need_start("time")
        return float(self.episode.world.time[0])

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene: an RGB array, or a window in the mode "human"."""
        if self.render_mode is None:
            gym.logger.warn(
                "render() was called without a render mode; "
                'pass render_mode="rgb_array" to the constructor'
            )
            return None
        self.episode.need_start("render()")
        if self._renderer is None:
            from lagros_envs.tasks.spacecraft.draw import SpacecraftRenderer

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


def infos_by_agent(info: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the info of each agent of the first world, numbers as Python's own."""
    columns = [
        value[0].tolist() if value.ndim == 2 else list(value[0].copy()) for value in info.values()
    ]
    return [dict(zip(info, row, strict=True)) for row in zip(*columns, strict=True)]
