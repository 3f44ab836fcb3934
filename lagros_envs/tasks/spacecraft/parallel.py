"""Spacecraft among obstacles and each other: `spacecraft_v0.parallel_env()`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Literal, cast

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils.env_logger import EnvLogger

from lagros_envs.arrays import Float32Array, FloatArray
from lagros_envs.conventions import (
    RENDER_MODES,
    check_render_mode,
)
from lagros_envs.options import checked_actions
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.episode import (
    OneWorld,
    SpacecraftEpisode,
    action_space,
    infos_by_agent,
)
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.sensing import global_state, named_state_space, observe

# What PettingZoo's own tests pass to the reset of any environment.
_OF_CHECKERS = {"options": 1}


class SpacecraftParallelEnv(OneWorld, ParallelEnv[str, Float32Array, Float32Array]):
    """Spacecraft that seek their goals among obstacles and each other, under bounded disturbance.

    ## Action
    `Box(0, 1, (8,))`: the forces of the eight thrusters in units of `settings.thrust_scale` (1 N).
    Actions beyond 1 are applied as they are, unless `settings.thrust_limit` is set; thrusters
    cannot pull, so that negative actions count as zero.

    ## Observation
    A flat float32 vector; `gymnasium.spaces.unflatten(env.named_space, observation)` names its
    parts. With K = max(1, agents - 1) and O the most obstacles of the preset:

    | part             | shape  | content                                                       |
    |------------------|--------|---------------------------------------------------------------|
    | `goal`           | (2,)   | p_f - p [m]                                                   |
    | `velocity`       | (2,)   | v [m/s]                                                       |
    | `heading`        | (3,)   | cos phi, sin phi, phi - phi(0) [rad]                          |
    | `spin`           | (1,)   | omega [rad/s]                                                 |
    | `time`           | (1,)   | t [s]                                                         |
    | `neighbours`     | (K, 4) | position and velocity of the others relative to self [m, m/s] |
    | `neighbour_mask` | (K,)   | 1 if the centre is within `settings.sensing_radius`           |
    | `obstacles`      | (O, 3) | centre relative to self, radius [m]                           |
    | `obstacle_mask`  | (O,)   | 1 if any part is within `settings.sensing_radius`             |

    What is not sensed is zero. `state()` is the global vector; `named_state_space` names its parts.

    ## Dynamics
    dx/dt = f(x) + B(x) u + d for x = [p_x, p_y, phi, v_x, v_y, omega], u and d held over the
    control step, ||d|| <= `disturbance_bound` for every agent.

    ## Reward
    `lagros_envs.tasks.spacecraft.task.reward`, for each agent alone: approach to the goal, minus
    effort, a bonus at the first arrival, a penalty at the first collision.

    ## Starting state
    Drawn from the preset, at rest. `reset(options=...)` takes `scenario`, a
    `lagros_envs.tasks.spacecraft.scenarios.Scenario`, and `nominal`, x_d of all agents at every
    control instant, shape (steps + 1, agents, 6). A reset that is refused leaves the environment as
    it was.

    ## Episode end
    `truncated` for all agents at `settings.time_limit` (45 s, more where the preset says so),
    `terminated` for all as soon as all have collided. Arriving
    ends nothing: agents keep station and stay obstacles to others. Nor does one collision: agents
    pass through what they hit, and it is counted. Collisions are found between control steps, too.
    A thrust too large to integrate leaves the state as it was and counts as a collision.

    ## Info
    For each agent `success` (it came within `settings.goal_radius` of its goal at a control instant
    before any collision of its own), `is_success` (the same, by the name that other libraries
    read), `success_time` [s] (inf before), `strict_success` (it is there now and has never
    collided; at the end this is the strict measure), `reached` (it came there, collided or not),
    `paper_success` and its time (||(p - p_f, v)|| <= r(t) of the published tube before any
    collision), `collided`, `collision_time`, `effort` (the integral of ||u||^2 so far),
    `effort_to_success` (the same, frozen at the first success), `disturbance` (d of the step),
    `tube_radius` r(t), `goal_distance` and, where the episode has a nominal, `tracking_error`
    ||x - x_d||.

    Args:
        num_agents: Number of agents; None for the preset's own.
        preset: A name of `lagros_envs.tasks.spacecraft.scenarios.PRESETS`, a `Preset`, or a
            dictionary of those fields that differ from the defaults.
        disturbance: Kind of disturbance, one of `lagros_envs.disturbances.KINDS`, or a function of
            a `Situation`, which sees all agents at once.
        disturbance_bound: d_bar, in units of the state per second.
        disturbance_channels: "all", "rates", or a mask of the six states.
        metric: Contraction metric M for the kind "worst": (6, 6), or a function of the state.
        settings: The task: a `SpacecraftSettings`, or a dictionary of those fields that differ from
            those of the preset; None for the preset's (`task.settings_for`).
        max_cycles: Control steps of an episode, in place of `settings.time_limit`.
        render_mode: None, "human" or "rgb_array".

    Raises:
        ValueError: A setting is not valid.
    """

    settings: task.SpacecraftSettings
    metadata = {
        "name": "spacecraft_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        num_agents: int | None = None,
        preset: str | Preset | Mapping[str, Any] = "paper",
        disturbance: str | Any = "none",
        disturbance_bound: float = 0.4,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool] = "all",
        metric: Any = None,
        settings: task.SpacecraftSettings | Mapping[str, Any] | None = None,
        max_cycles: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.episode = SpacecraftEpisode(
            num_agents,
            preset,
            disturbance,
            disturbance_bound,
            disturbance_channels,
            metric,
            settings,
            max_cycles=max_cycles,
        )
        self.settings, self.preset = self.episode.settings, self.episode.preset
        self.disturbance = self.episode.disturbance
        self.possible_agents = [f"agent_{index}" for index in range(self.preset.agents)]
        self.agents: list[str] = []
        layout, world = self.episode.layout, self.episode.world
        self.named_space = layout.named_space
        self.named_state_space = named_state_space(
            world.agents, world.obstacles, self.settings.time_limit
        )
        self.state_space = spaces.flatten_space(self.named_state_space)
        # A space of its own for every agent, as seeds are per space.
        self.observation_spaces = {
            agent: cast("spaces.Space[Float32Array]", spaces.flatten_space(self.named_space))
            for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: cast("spaces.Space[Float32Array]", action_space())
            for agent in self.possible_agents
        }

    def observation_space(self, agent: str) -> spaces.Space[Float32Array]:
        """Return the observation space of an agent."""
        return self.observation_spaces[self._known(agent)]

    def action_space(self, agent: str) -> spaces.Space[Float32Array]:
        """Return the action space of an agent."""
        return self.action_spaces[self._known(agent)]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Float32Array], dict[str, dict[str, Any]]]:
        """Start an episode.

        Args:
            seed: Seed of the episode; the scenario and the disturbance have a stream each.
            options: `scenario` and `nominal`, see the class.

        Returns:
            Observations and infos, by agent.

        Raises:
            ValueError: The seed is none, or an option is unknown or has a wrong type, shape or
                value.
        """
        self._begin(seed, None if options == _OF_CHECKERS else options)
        self.agents = self.possible_agents[:]
        return self._observations(), self._infos()

    def step(
        self, actions: dict[str, Float32Array]
    ) -> tuple[
        dict[str, Float32Array],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Hold the thrust of every agent for one control step.

        Args:
            actions: For each agent its thrust in units of `settings.thrust_scale`, shape (8,).

        Returns:
            Observations, rewards, terminations, truncations and infos, by agent. After the end of
            an episode there are no agents, and these are empty; PettingZoo's logger warns.

        Raises:
            ValueError: An agent is missing or unknown, or an action is not eight finite numbers.
            RuntimeError: The environment was not reset.
        """
        self.episode.need_start("step()")
        if not isinstance(actions, Mapping):
            raise ValueError(
                f"the actions are {type(actions).__name__}; give a dictionary by agent"
            )
        if not self.agents:
            EnvLogger.warn_step_after_terminated_truncated()
            return {}, {}, {}, {}, {}
        values = self._checked(actions)
        for agent in actions:
            self._known(agent)
        outcome = self.episode.step(task.applied_forces(self.settings, values))
        agents = self.agents
        rewards, terminations, truncations = (
            dict(zip(agents, part[0].tolist(), strict=True)) for part in outcome
        )
        observations, infos = self._observations(), self._infos()
        if outcome.terminated.any() or outcome.truncated.any():
            self.agents = []
        if self.render_mode == "human":
            self.render()
        return observations, rewards, terminations, truncations, infos

    def state(self) -> Float32Array:
        """Return the global state, laid out as `named_state_space` says."""
        self.episode.need_start("state()")
        return cast(Float32Array, global_state(self.episode.world)[0])

    @property
    def states(self) -> FloatArray:
        """The states x of all agents in double precision, shape (agents, 6)."""
        self.episode.need_start("states")
        return cast(FloatArray, self.episode.world.states[0])

    def _known(self, agent: str) -> str:
        if agent not in self.action_spaces:
            raise ValueError(
                f"there is no agent {agent!r}; the agents are {', '.join(self.possible_agents)}"
            )
        return agent

    def _checked(self, actions: Mapping[str, Any]) -> FloatArray:
        """Return the actions of all agents, shape (agents, 8), or refuse the first that is none."""
        wanted = self.agents
        given = [actions.get(agent) for agent in wanted]
        # All at once: where there is a fault the agents are looked at one by one.
        if all(type(one) is np.ndarray and one.dtype.kind == "f" for one in given):
            with suppress(ValueError):
                return checked_actions(given, (len(wanted), task.THRUSTERS), task.ACTION)
        return np.stack([self._action(actions, agent) for agent in wanted])

    def _action(self, actions: Mapping[str, Any], agent: str) -> FloatArray:
        if agent not in actions:
            raise ValueError(
                f"the actions lack {agent!r}; give one to each of {', '.join(self.agents)}"
            )
        try:
            return checked_actions(actions[agent], (task.THRUSTERS,), task.ACTION)
        except ValueError as error:
            raise ValueError(f"{agent}: {error}") from None

    def _observations(self) -> dict[str, Float32Array]:
        rows = observe(self.episode.world, self.episode.layout)[0]
        return dict(zip(self.possible_agents, rows, strict=True))

    def _infos(self) -> dict[str, dict[str, Any]]:
        rows = infos_by_agent(self.episode.world.info())
        return dict(zip(self.possible_agents, rows, strict=True))
