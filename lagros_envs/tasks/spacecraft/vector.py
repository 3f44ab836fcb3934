"""Many spacecraft worlds as one Gymnasium vector environment, with a row for every agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray, IntArray
from lagros_envs.autoreset import RestartingVectorEnv, nominal_after
from lagros_envs.checks import check_whole
from lagros_envs.conventions import check_started
from lagros_envs.options import checked_actions
from lagros_envs.seeding import episode_streams, seeded_streams
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.episode import SpacecraftEpisode, action_space
from lagros_envs.tasks.spacecraft.scenarios import Preset, Scenario
from lagros_envs.tasks.spacecraft.sensing import (
    global_state,
    named_state_space,
    observe,
)


class SpacecraftVectorEnv(RestartingVectorEnv):
    """Worlds of spacecraft side by side; each row is one agent, the agents of a world together.

    Row `world * num_agents + agent` is that agent of that world, and `reshape(worlds, num_agents,
    ...)` on whatever has a leading axis of rows gives worlds and agents. Spaces, dynamics, reward
    and info are those of `SpacecraftParallelEnv`; the agents of a world end together.
    Seeds, masks and autoreset are those of `autoreset.RestartingVectorEnv`. `reset(options=...)`
    also takes `scenarios` (one `Scenario` or None per world) and `nominal` (worlds, steps + 1,
    num_agents, 6).

    The arguments from `preset` to `settings` are those of `SpacecraftParallelEnv`, and
    `max_episode_steps` and `autoreset_mode` those of `autoreset.RestartingVectorEnv`.

    Args:
        num_envs: Number of rows, a multiple of `num_agents`.
        num_agents: Agents in each world.
        compiled: As in `CartPoleVectorEnv`.
        render_mode: Must be None; render a single environment instead.

    Attributes:
        compiled: Whether the equation of motion is compiled.

    Raises:
        ValueError: A setting is not valid.
        ImportError: `compiled=True` and numba is not installed.
    """

    settings: task.SpacecraftSettings
    option_names = ("reset_mask", "scenarios", "nominal")

    def __init__(
        self,
        num_envs: int = 1,
        num_agents: int = 1,
        preset: str | Preset | Mapping[str, Any] = "paper",
        disturbance: str | Any = "none",
        disturbance_bound: float = 0.4,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool] = "all",
        metric: Any = None,
        settings: task.SpacecraftSettings | Mapping[str, Any] | None = None,
        compiled: bool | None = None,
        autoreset_mode: Literal["next_step", "same_step", "disabled"] | AutoresetMode = "next_step",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        check_whole("num_agents", num_agents)
        check_whole("num_envs", num_envs)
        if num_envs % num_agents:
            raise ValueError(
                f"num_envs={num_envs!r} must be a positive multiple of num_agents={num_agents}: "
                "there is a row for every agent of every world"
            )
        self.num_agents = num_agents
        self.episode = SpacecraftEpisode(
            num_agents,
            preset,
            disturbance,
            disturbance_bound,
            disturbance_channels,
            metric,
            settings,
            num_envs // num_agents,
            compiled,
        )
        self.world, self.layout = self.episode.world, self.episode.layout
        self.compiled = self.world.compiled
        self.settings, self.preset = self.episode.settings, self.episode.preset
        self.named_space = self.layout.named_space
        self.named_state_space = named_state_space(
            num_agents, self.world.obstacles, self.settings.time_limit
        )
        super().__init__(
            num_envs,
            num_envs // num_agents,
            spaces.flatten_space(self.named_space),
            action_space(),
            self.episode.disturbance,
            self.settings,
            max_episode_steps,
            autoreset_mode,
            render_mode,
            "spacecraft_v0.parallel_env(render_mode=...)",
        )
        self.world.step_limit = self.step_limit

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
        self._need_start()
        values = checked_actions(actions, (self.num_envs, task.THRUSTERS), task.ACTION)
        forces = task.applied_forces(self.settings, values)
        restarting = self._restarting()
        outcome = self.world.step(forces.reshape(self.num_worlds, self.num_agents, task.THRUSTERS))
        if restarting is not None:
            self._restart(restarting, *outcome)
        observation, info = self._after_step((outcome.terminated | outcome.truncated)[:, 0])
        return (
            observation,
            outcome.reward.reshape(-1),
            outcome.terminated.reshape(-1),
            outcome.truncated.reshape(-1),
            info,
        )

    def state(self) -> Float32Array:
        """Return the global state of every world, shape (worlds, size of `named_state_space`)."""
        check_started(self._started, "state()")
        return global_state(self.world)

    @property
    def states(self) -> FloatArray:
        """The states x in double precision, shape (worlds, num_agents, 6)."""
        check_started(self._started, "states")
        return self.world.states

    @property
    def scenarios(self) -> list[Scenario | None]:
        """The scenario of each world."""
        check_started(self._started, "scenarios")
        return list(self.world.scenarios)

    def _usual_steps(self) -> None:
        """Return none: every preset has its own limit, which the environment keeps by itself."""

    def _checked(self, mask: BoolArray, options: dict[str, Any]) -> dict[str, Any]:
        nominal = task.nominal_from_options(
            options, self.settings, (self.num_worlds, self.num_agents), mask
        )
        self.episode.need_nominal(nominal)
        return {"nominal": nominal, "scenarios": self._scenarios(mask, options.get("scenarios"))}

    def _scenarios(self, mask: BoolArray, given: Any) -> list[Scenario | None]:
        if given is None:
            return [None] * self.num_worlds
        if not isinstance(given, Sequence) or len(given) != self.num_worlds:
            raise ValueError(
                f"options['scenarios'] must have {self.num_worlds} entries, a `Scenario` or None "
                "per world"
            )
        return [
            self.episode.checked_scenario("scenarios", one) if starts else None
            for one, starts in zip(given, mask, strict=True)
        ]

    def _set_nominal(self, mask: BoolArray, given: dict[str, Any]) -> None:
        kept = None if mask.all() else self.world.nominal
        self.world.nominal = nominal_after(kept, mask, given["nominal"])

    def _forget_nominal(self, mask: BoolArray) -> None:
        self.world.nominal = nominal_after(self.world.nominal, mask, None)

    def _start(self, worlds: IntArray, seeds: Sequence[int] | None, given: dict[str, Any]) -> None:
        stated = given.get("scenarios", [None] * self.num_worlds)
        # To draw a scenario takes much longer than to make its generator: each has one.
        seeds = (
            self.np_random.integers(2**63, size=worlds.size).tolist() if seeds is None else seeds
        )
        chosen = [
            stated[world] or self.preset.sample(stream)
            for world, stream in zip(worlds, seeded_streams(seeds, "scenario"), strict=True)
        ]
        self.world.begin(worlds, chosen, (episode_streams(seed).disturbance for seed in seeds))

    def _observation(self) -> Float32Array:
        return observe(self.world, self.layout).reshape(self.num_envs, -1)

    def _info(self) -> dict[str, Any]:
        return {
            name: value.reshape(self.num_envs, *value.shape[2:])
            for name, value in self.world.info().items()
        }
