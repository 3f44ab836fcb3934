"""The vectorised twin of `CartPoleEnv`: many worlds, one array operation per step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from lagros_envs import cartpole_task as task
from lagros_envs.autoreset import autoreset_mode_named
from lagros_envs.disturbances import Disturbance, Situation, channel_mask
from lagros_envs.dynamics import hold_step
from lagros_envs.seeding import episode_streams

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class CartPoleVectorEnv(gym.vector.VectorEnv[NDArray[np.float32], NDArray[np.float32], Any]):
    """Worlds of `CartPoleEnv` side by side; each world's trajectory is that of the single one.

    Spaces, dynamics, reward and info are those of `CartPoleEnv`, with a leading axis of worlds.
    `reset(seed=...)` takes one integer, from which the worlds draw independent seeds, or a list
    with one seed per world, each of which starts the episode that `CartPoleEnv.reset(seed=...)`
    starts. `reset(options=...)` takes `initial_state` (num_envs, 4), `goal` (num_envs, 4) or
    (num_envs,), `nominal` (num_envs, steps + 1, 4) and `reset_mask` (num_envs,); what the options
    say of worlds outside the mask is not looked at.

    Args:
        num_envs: Number of worlds.
        disturbance: As in `CartPoleEnv`; a callable sees the states of all worlds at once.
        disturbance_bound: As in `CartPoleEnv`.
        disturbance_channels: As in `CartPoleEnv`.
        metric: As in `CartPoleEnv`.
        settings: As in `CartPoleEnv`.
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
        disturbance: str | Any = "none",
        disturbance_bound: float = 0.75,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool] = "all",
        metric: Any = None,
        settings: task.CartPoleSettings | None = None,
        autoreset_mode: Literal["next_step", "same_step", "disabled"] | AutoresetMode = "next_step",
        render_mode: str | None = None,
    ) -> None:
        """Build the worlds; see the class for the arguments."""
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs!r} must be at least 1")
        if render_mode is not None:
            raise ValueError(
                f"render_mode={render_mode!r}: the vector environment does not draw; "
                'use gym.make("lagros/CartPole-v0", render_mode=...)'
            )
        self.num_envs = num_envs
        self.settings = settings or task.CartPoleSettings()
        self.disturbance = Disturbance(
            disturbance, disturbance_bound, channel_mask(disturbance_channels, task.RATES), metric
        )
        self.autoreset_mode = autoreset_mode_named(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = None
        self.named_space = task.named_space(self.settings)
        self.single_observation_space = spaces.flatten_space(self.named_space)
        self.single_action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._allocate()

    def _allocate(self) -> None:
        worlds, steps = self.num_envs, self.settings.steps
        self._state = np.zeros((worlds, task.STATE_DIM))
        self._goal = np.zeros((worlds, task.STATE_DIM))
        self._initial_state = np.zeros((worlds, task.STATE_DIM))
        self._pushes = np.zeros((worlds, steps, task.STATE_DIM))
        self._push = np.zeros((worlds, task.STATE_DIM))
        self._step = np.zeros(worlds, dtype=np.intp)
        self._effort = np.zeros(worlds)
        self._effort_to_success = np.zeros(worlds)
        self._success_time = np.full(worlds, np.inf)
        self._inside = np.zeros(worlds, dtype=bool)
        self._fallen = np.zeros(worlds, dtype=bool)
        # Worlds whose episode ended and that start anew on the next call of step.
        self._pending = np.zeros(worlds, dtype=bool)
        self._worlds = np.arange(worlds)
        self.nominal: FloatArray | None = None
        self._started = False

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode in every world, or in those of `options["reset_mask"]`.

        Args:
            seed: One integer, or one per world.
            options: See the class.

        Returns:
            Observations (num_envs, 13) and the info, whose entries have a leading axis of worlds.

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
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(f"options['reset_mask'] must be {self.num_envs} booleans")
        if not self._started and not mask.all():
            raise ValueError("the first reset must start every world; leave out reset_mask")
        nominal = task.nominal_from_options(options, self.settings, (self.num_envs,))
        if mask.all() or self.nominal is None:
            self.nominal = nominal
        elif nominal is not None:
            self.nominal = np.where(mask[:, None, None], nominal, self.nominal)
        if self.disturbance.kind == "worst" and self.nominal is None:
            raise ValueError(
                'disturbance="worst" needs the nominal trajectories: pass '
                'reset(options={"nominal": array of shape (num_envs, steps + 1, 4)})'
            )
        self._begin(mask, seeds, self._checked_shapes(options))
        self._started = True
        distance = self._goal_distance()
        self._note_success(distance, mask)
        return self._observation(), self._info(distance)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Hold one force per world for one control step.

        Args:
            actions: Forces in units of `settings.force_scale`, shape (num_envs, 1).

        Returns:
            Observations, rewards, terminated, truncated and info, batched over worlds. A world
            that starts anew on this call (next-step autoreset) ignores its action and has reward 0.

        Raises:
            ValueError: The actions have a wrong shape or are not finite.
            RuntimeError: The environment was not reset.
        """
        if not self._started:
            raise RuntimeError("call reset() before step()")
        force = self._force(actions)
        restarting = self._pending
        moving = ~restarting
        if restarting.any():
            self._begin_unasked(restarting)
        self._advance(force, moving)
        distance = self._goal_distance()
        first_success = self._note_success(distance, np.ones(self.num_envs, bool))
        settings = self.settings
        effort = force[:, 0] ** 2 * settings.control_period
        rewards = np.where(
            moving,
            task.reward(settings, effort, distance, first_success, self._fallen),
            0.0,
        )
        terminated = self._fallen & moving
        truncated = (self._step >= settings.steps) & moving
        info = self._info(distance)
        ended = terminated | truncated
        self._pending = np.zeros(self.num_envs, bool)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._pending = ended
        elif self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            info = self._restart_now(ended, info)
        return self._observation(), rewards, terminated, truncated, info

    @property
    def state(self) -> FloatArray:
        """The states x in double precision, shape (num_envs, 4)."""
        return self._state.copy()

    def _seeds(self, seed: int | Sequence[int] | None) -> list[int] | None:
        if seed is None or isinstance(seed, int | np.integer):
            return None
        seeds = [int(value) for value in seed]
        if len(seeds) != self.num_envs or min(seeds) < 0:
            raise ValueError(f"seed must be {self.num_envs} non-negative integers; it is {seed!r}")
        return seeds

    def _checked_shapes(self, options: dict[str, Any]) -> dict[str, Any]:
        """Return start and goal of the options as arrays with a leading axis of worlds."""
        worlds = self.num_envs
        shapes: dict[str, list[tuple[int, ...]]] = {
            "initial_state": [(worlds, task.STATE_DIM)],
            "goal": [(worlds, task.STATE_DIM), (worlds,)],
        }
        checked = {}
        for name in shapes.keys() & options.keys():
            checked[name] = np.asarray(options[name], np.float64)
            if checked[name].shape not in shapes[name]:
                wanted = " or ".join(map(str, shapes[name]))
                raise ValueError(
                    f"options[{name!r}] has shape {checked[name].shape}; it must be {wanted}"
                )
        return checked

    def _begin_unasked(self, mask: BoolArray) -> None:
        """Start the episodes of an autoreset, for which nobody has planned a nominal."""
        if self.disturbance.kind == "worst":
            raise ValueError(
                'disturbance="worst" needs a nominal trajectory for every episode, and an '
                'autoreset starts one without: use autoreset_mode="disabled" and reset with '
                'options={"nominal": ..., "reset_mask": ...}'
            )
        if self.nominal is not None:
            self.nominal = np.where(mask[:, None, None], np.nan, self.nominal)
        self._begin(mask, None, {})

    def _begin(self, mask: BoolArray, seeds: list[int] | None, options: dict[str, Any]) -> None:
        """Draw scenario and disturbance of the masked worlds and put them at their start."""
        settings = self.settings
        worlds = np.flatnonzero(mask)
        if seeds is None:
            seeds = [0] * self.num_envs
            for world, word in zip(
                worlds, self.np_random.integers(2**63, size=worlds.size), strict=True
            ):
                seeds[world] = int(word)
        for world in worlds:
            streams = episode_streams(seeds[world])
            drawn = task.sample_scenario(streams.scenario, settings)
            given: dict[str, Any] = {
                key: options[key][world] for key in ("initial_state", "goal") if key in options
            }
            scenario = task.scenario_from_options(given, drawn)
            self._initial_state[world] = scenario.initial_state
            self._goal[world] = scenario.goal
            self._pushes[world] = self.disturbance.realise(
                streams.disturbance, settings.steps, settings.control_period
            )
        self._state[worlds] = self._initial_state[worlds]
        self._push[worlds] = 0.0
        self._step[worlds] = 0
        self._effort[worlds] = 0.0
        self._effort_to_success[worlds] = 0.0
        self._success_time[worlds] = np.inf
        self._fallen[worlds] = False
        self._pending[worlds] = False

    def _advance(self, force: FloatArray, moving: BoolArray) -> None:
        settings = self.settings
        push = self._pushes[self._worlds, np.minimum(self._step, settings.steps - 1)]
        if self.disturbance.is_feedback:
            push = self.disturbance.respond(
                Situation(self._state, self._nominal_now(), self._time(), push)
            )
        with np.errstate(over="ignore", invalid="ignore"):
            following = hold_step(
                settings.system, self._state, force, settings.control_period, push
            )
        # Comparing with nan gives False: a world that could not be integrated stays and has fallen.
        integrated = np.all(np.abs(following) <= task.LARGEST_STATE, axis=1) | ~moving
        self._state = np.where((moving & integrated)[:, None], following, self._state)
        self._push = np.where(moving[:, None], push, 0.0)
        self._effort += np.where(moving, force[:, 0] ** 2 * settings.control_period, 0.0)
        self._step += moving
        self._fallen = ~integrated | (np.abs(self._state[:, 1]) > task.FALL_ANGLE)

    def _restart_now(self, ended: BoolArray, info: dict[str, Any]) -> dict[str, Any]:
        final_observation = self._observation()
        final_info = {key: value.copy() for key, value in info.items()}
        self._begin_unasked(ended)
        distance = self._goal_distance()
        self._note_success(distance, ended)
        info = self._info(distance)
        info["final_obs"], info["_final_obs"] = final_observation, ended
        info["final_info"], info["_final_info"] = final_info, ended
        return info

    def _force(self, actions: NDArray[np.float32]) -> FloatArray:
        values = np.asarray(actions, dtype=np.float64)
        if values.shape != (self.num_envs, 1):
            raise ValueError(
                f"actions have shape {values.shape}; they must be ({self.num_envs}, 1), one number "
                "per world"
            )
        if not np.all(np.isfinite(values)):
            worlds = np.flatnonzero(~np.isfinite(values[:, 0])).tolist()
            raise ValueError(f"actions are not finite in the worlds {worlds}")
        force: FloatArray = task.applied_force(self.settings, values, np.clip)
        return force

    def _time(self) -> FloatArray:
        return cast(FloatArray, self._step * self.settings.control_period)

    def _nominal_now(self) -> FloatArray | None:
        if self.nominal is None:
            return None
        return self.nominal[self._worlds, np.minimum(self._step, self.settings.steps)]

    def _goal_distance(self) -> FloatArray:
        pairs = (self._state.T, self._goal.T)
        distance: FloatArray = task.goal_distance(*pairs, np.sqrt)
        return distance

    def _note_success(self, distance: FloatArray, worlds: BoolArray) -> BoolArray:
        self._inside = ~self._fallen & (distance <= self.settings.tube.radius(self._time()))
        open_ = np.isinf(self._success_time) & worlds
        first = self._inside & open_
        self._effort_to_success = np.where(open_, self._effort, self._effort_to_success)
        self._success_time = np.where(first, self._time(), self._success_time)
        return cast(BoolArray, first)

    def _observation(self) -> NDArray[np.float32]:
        observation = np.empty((self.num_envs, task.OBSERVATION_DIM), np.float32)
        observation[:, task.STATE] = self._state
        observation[:, task.GOAL] = self._goal
        observation[:, task.INITIAL_STATE] = self._initial_state
        observation[:, task.TIME] = self._time()
        return observation

    def _info(self, distance: FloatArray) -> dict[str, Any]:
        info = {
            "success": np.isfinite(self._success_time),
            "success_time": self._success_time.copy(),
            "inside_tube": self._inside.copy(),
            "fallen": self._fallen.copy(),
            "effort": self._effort.copy(),
            "effort_to_success": self._effort_to_success.copy(),
            "disturbance": self._push.copy(),
            "tube_radius": self.settings.tube.radius(self._time()),
            "goal_distance": distance,
        }
        nominal = self._nominal_now()
        if nominal is not None:
            info["tracking_error"] = task.goal_distance(self._state.T, nominal.T, np.sqrt)
        return info
