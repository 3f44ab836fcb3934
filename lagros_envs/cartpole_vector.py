"""The vectorised twin of `CartPoleEnv`: many worlds, one array operation per step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from lagros_envs import cartpole_task as task
from lagros_envs.autoreset import RestartingVectorEnv, nominal_after
from lagros_envs.checks import check_whole
from lagros_envs.conventions import settings_of
from lagros_envs.disturbances import Disturbance, Situation, channel_mask
from lagros_envs.dynamics.held import HeldBatch
from lagros_envs.options import checked_actions
from lagros_envs.seeding import seeded_streams

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


class CartPoleVectorEnv(RestartingVectorEnv):
    """Worlds of `CartPoleEnv` side by side; each world's trajectory is that of the single one.

    Spaces, dynamics, reward and info are those of `CartPoleEnv`, with a leading axis of worlds;
    seeds, masks and autoreset are those of `autoreset.RestartingVectorEnv`, with one row per world.
    `reset(options=...)` also takes `initial_state` (num_envs, 4), `goal` (num_envs, 4) or
    (num_envs,) and `nominal` (num_envs, steps + 1, 4).

    Args:
        num_envs: Number of worlds.
        disturbance: As in `CartPoleEnv`; a callable sees the states of all worlds at once.
        disturbance_bound: As in `CartPoleEnv`.
        disturbance_channels: As in `CartPoleEnv`.
        metric: As in `CartPoleEnv`.
        settings: As in `CartPoleEnv`.
        compiled: Whether numba (the extra "fast") compiles the equation of motion, which makes a
            step eight times faster; None: where it is installed. Compiled states differ from those
            of NumPy in the last digits (1e-15 a step).
        max_episode_steps: As in `autoreset.RestartingVectorEnv`.
        autoreset_mode: As in `autoreset.RestartingVectorEnv`.
        render_mode: Must be None; render a single environment instead.

    Attributes:
        compiled: Whether the equation of motion is compiled.

    Raises:
        ValueError: A setting is not valid.
        ImportError: `compiled=True` and numba is not installed.
    """

    settings: task.CartPoleSettings
    option_names = ("reset_mask", *task.OPTIONS)

    def __init__(
        self,
        num_envs: int = 1,
        disturbance: str | Any = "none",
        disturbance_bound: float = 0.75,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool] = "all",
        metric: Any = None,
        settings: task.CartPoleSettings | Mapping[str, Any] | None = None,
        compiled: bool | None = None,
        autoreset_mode: Literal["next_step", "same_step", "disabled"] | AutoresetMode = "next_step",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        """Build the worlds; see the class for the arguments."""
        check_whole("num_envs", num_envs)
        self.settings = settings_of(task.CartPoleSettings(), settings)
        self.named_space = task.named_space(self.settings)
        super().__init__(
            num_envs,
            num_envs,
            spaces.flatten_space(self.named_space),
            spaces.Box(-1.0, 1.0, (1,), np.float32),
            Disturbance(
                disturbance,
                disturbance_bound,
                channel_mask(disturbance_channels, task.RATES),
                metric,
            ),
            self.settings,
            max_episode_steps,
            autoreset_mode,
            render_mode,
            'gym.make("lagros/CartPole-v0", render_mode=...)',
        )
        self._hold = HeldBatch(
            self.settings.system,
            self.settings.control_period,
            (num_envs,),
            compiled,
            measure=task.StepMeasure(self.settings),
            given=task.STATE_DIM,
        )
        self.compiled = self._hold.compiled
        self._allocate()

    def _allocate(self) -> None:
        # Coordinates come first, (4, worlds): that is what the equation of motion works on.
        worlds, self._steps = self.num_envs, self.settings.steps
        self._state = np.zeros((task.STATE_DIM, worlds))
        self._goal = np.zeros((task.STATE_DIM, worlds))
        self._pushes = np.zeros((worlds, self._steps, task.STATE_DIM))
        self._push = np.zeros((worlds, task.STATE_DIM))
        self._step = np.zeros(worlds, dtype=np.intp)
        self._distance = np.zeros(worlds)
        self._effort = np.zeros(worlds)
        self._effort_to_success = np.zeros(worlds)
        self._success_time = np.full(worlds, np.inf)
        # Worlds without a success so far.
        self._open = np.ones(worlds, dtype=bool)
        self._fallen = np.zeros(worlds, dtype=bool)
        self._worlds = np.arange(worlds)
        self._first_push = self._worlds * self._steps
        # t and r(t) at every control instant.
        instants = np.arange(self._steps + 1)
        self._times: FloatArray = np.multiply(instants, self.settings.control_period)
        self._radii: FloatArray = self.settings.tube.radius(self._times)
        # What stays the same in every observation of an episode: goal and initial state.
        self._blank = np.zeros((worlds, task.OBSERVATION_DIM), np.float32)
        self.nominal: FloatArray | None = None

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
        self._need_start()
        force = self._force(actions)
        restarting = self._restart_pending()
        if restarting is not None:
            force[restarting] = 0.0
        effort, rewards = self._advance(force, restarting)
        first_success = self._note_arrivals()
        eventful = first_success | self._fallen
        if np.count_nonzero(eventful):
            rewards[eventful] = task.reward(
                self.settings,
                effort[eventful],
                self._distance[eventful],
                first_success[eventful],
                self._fallen[eventful],
            )
        if restarting is not None:
            rewards[restarting] = 0.0
        terminated = self._fallen.copy()
        truncated = self._step >= self.step_limit
        observation, info = self._after_step(terminated | truncated)
        return observation, rewards, terminated, truncated, info

    @property
    def state(self) -> FloatArray:
        """The states x in double precision, shape (num_envs, 4)."""
        return np.ascontiguousarray(self._state.T)

    def _checked(self, mask: BoolArray, options: dict[str, Any]) -> dict[str, Any]:
        nominal = task.nominal_from_options(options, self.settings, (self.num_envs,), mask)
        if self.disturbance.kind == "worst" and nominal is None:
            raise ValueError(
                'disturbance="worst" needs the nominal trajectories: pass '
                'reset(options={"nominal": array of shape (num_envs, steps + 1, 4)})'
            )
        scenario = task.start_and_goal(options, (self.num_envs, task.STATE_DIM), mask)
        return {"nominal": nominal, "scenario": scenario}

    def _set_nominal(self, mask: BoolArray, given: dict[str, Any]) -> None:
        kept = None if mask.all() else self.nominal
        self.nominal = nominal_after(kept, mask, given["nominal"])

    def _forget_nominal(self, mask: BoolArray) -> None:
        self.nominal = nominal_after(self.nominal, mask, None)

    def _start(self, worlds: IntArray, seeds: Sequence[int], given: dict[str, Any]) -> None:
        settings = self.settings
        shares = np.empty((worlds.size, 2))
        for row, rng in zip(shares, seeded_streams(seeds, "scenario"), strict=True):
            row[:] = task.draw_shares(rng)
        stated = {name: value[worlds] for name, value in given.get("scenario", {}).items()}
        scenario = replace(task.scenario_of_shares(shares, settings), **stated)
        pushes = np.empty((worlds.size, self._steps, task.STATE_DIM))
        streams = seeded_streams(seeds, "disturbance")
        self.disturbance.realise_all(streams, pushes, settings.control_period)
        self._pushes[worlds] = pushes
        self._state[:, worlds] = scenario.initial_state.T
        self._goal[:, worlds] = scenario.goal.T
        self._blank[worlds, task.GOAL] = scenario.goal
        self._blank[worlds, task.INITIAL_STATE] = scenario.initial_state
        self._push[worlds] = 0.0
        self._step[worlds] = 0
        self._effort[worlds] = 0.0
        self._effort_to_success[worlds] = 0.0
        self._success_time[worlds] = np.inf
        self._open[worlds] = True
        self._fallen[worlds] = False
        self._measure_distance(worlds)
        self._note_arrivals()

    def _measure_distance(self, worlds: IntArray | BoolArray) -> None:
        pair = self._state[:, worlds], self._goal[:, worlds]
        self._distance[worlds] = task.goal_distance(*pair, np.sqrt)

    def _advance(
        self, force: FloatArray, restarting: BoolArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Move the worlds that do not restart over one control step.

        Returns:
            ||u||^2 dt of the step, and its reward where nothing happened.
        """
        push = self._current_push()
        following = self._hold(self._state, [force], push.T, self._goal)
        self._distance, effort, rewards = self._hold.measured.copy()
        self._effort += effort
        self._step += 1
        # A comparison with nan gives False: what could not be integrated stays and has fallen.
        within = self._distance <= task.LARGEST_DISTANCE
        if restarting is not None or np.count_nonzero(within) < within.size:
            lost = ~within
            if restarting is not None:
                lost &= ~restarting
                push[restarting] = 0.0
                self._step[restarting] = 0
            kept = lost if restarting is None else lost | restarting
            following[:, kept] = self._state[:, kept]
            self._measure_distance(kept)
            self._fallen = lost | (np.abs(following[1]) > task.FALL_ANGLE)
        else:
            self._fallen = np.abs(following[1]) > task.FALL_ANGLE
        self._state[:] = following
        self._push = push
        return effort, rewards

    def _current_push(self) -> FloatArray:
        """Return d of this step, a new array (worlds, 4)."""
        # Past the time limit (a caller who ignored `truncated`) the last push stays.
        place = np.minimum(self._step, self._steps - 1)
        place += self._first_push
        push = self._pushes.reshape(-1, task.STATE_DIM).take(place, axis=0)
        if not self.disturbance.is_feedback:
            return push
        situation = Situation(self.state, self._nominal_now(), self._clock()[0], push)
        # A copy: a callable may return an array that it keeps.
        return self.disturbance.respond(situation).copy()

    def _force(self, actions: NDArray[np.float32]) -> FloatArray:
        values = checked_actions(actions, (self.num_envs, 1), "the force of each world")[:, 0]
        with np.errstate(over="ignore"):
            force: FloatArray = task.applied_force(self.settings, values, np.clip)
        return force

    def _clock(self) -> tuple[FloatArray, FloatArray]:
        """Return t [s] and r(t) of every world."""
        if not np.count_nonzero(self._step > self._steps):
            return self._times.take(self._step), self._radii.take(self._step)
        # A caller who ignored `truncated`.
        times: FloatArray = np.multiply(self._step, self.settings.control_period)
        radii: FloatArray = self.settings.tube.radius(times)
        return times, radii

    def _nominal_now(self) -> FloatArray | None:
        if self.nominal is None:
            return None
        return self.nominal[self._worlds, np.minimum(self._step, self._steps)]

    def _note_arrivals(self) -> BoolArray:
        """Note who is inside the tube, and return which worlds have their first success."""
        self._now, self._radius = self._clock()
        self._inside = self._distance <= self._radius
        self._inside &= ~self._fallen
        np.copyto(self._effort_to_success, self._effort, where=self._open)
        first: BoolArray = self._inside & self._open
        if np.count_nonzero(first):
            self._success_time[first] = self._now[first]
            self._open = self._open & ~first
        return first

    def _observation(self) -> NDArray[np.float32]:
        observation = self._blank.copy()
        observation[:, task.STATE] = self._state.T
        observation[:, task.TIME] = self._now
        return observation

    def _info(self) -> dict[str, Any]:
        # Copies of what a restart writes to; the others are made anew in every step.
        info = {
            "success": ~self._open,
            "is_success": ~self._open,
            "success_time": self._success_time.copy(),
            "inside_tube": self._inside,
            "fallen": self._fallen.copy(),
            "effort": self._effort.copy(),
            "effort_to_success": self._effort_to_success.copy(),
            "disturbance": self._push.copy(),
            "tube_radius": self._radius,
            "goal_distance": self._distance.copy(),
        }
        nominal = self._nominal_now()
        if nominal is not None:
            info["tracking_error"] = task.goal_distance(self._state, nominal.T, np.sqrt)
        return info
