"""The vectorised twin of `CartPoleEnv`: many worlds, one array operation per step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from lagros_envs.autoreset import RestartingVectorEnv, nominal_after
from lagros_envs.checks import check_whole
from lagros_envs.conventions import check_started, settings_of
from lagros_envs.disturbances import Disturbance, Situation, channel_mask
from lagros_envs.dynamics.held import HeldBatch
from lagros_envs.numbers import functions
from lagros_envs.options import checked_actions
from lagros_envs.seeding import seeded_streams
from lagros_envs.stepwise import StepwiseDisturbance
from lagros_envs.tasks.cartpole import task

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

# Rows of what is kept of every world, so that a restart writes all of it at once. Coordinates come
# first: that is what the equation of motion works on. The rules of a step read `_GIVEN`, as
# `task.Given`, and renew `_OUTCOME`, as `task.Outcome`.
_STATE, _GOAL = slice(0, 4), slice(4, 8)
_NOW, _RADIUS, _EFFORT, _EFFORT_TO_SUCCESS, _SUCCESS_TIME = range(8, 13)
_DISTANCE, _REWARD, _FALLEN, _INSIDE = range(13, 17)
_GIVEN, _OUTCOME, _ROWS = slice(4, 13), slice(10, 17), 17
# Starts that are drawn in advance.
_READY = 2048


class _Starts(NamedTuple):
    """What is kept of some episodes at their start: one column of the first, row of the last.

    Attributes:
        kept: Shape (_ROWS, episodes).
        blank: Their observations but for state and time, shape (episodes, 13).
    """

    kept: FloatArray
    blank: NDArray[np.float32]


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
        self._rules = task.StepRules(self.settings)
        self._hold = HeldBatch(
            self.settings.system,
            self.settings.control_period,
            (num_envs,),
            compiled,
            measure=self._rules,
            given=self._rules.GIVEN,
            pushed=self.disturbance.kind != "none",
        )
        self.compiled = self._hold.compiled
        self._allocate()

    def _allocate(self) -> None:
        worlds, self._steps = self.num_envs, self.settings.steps
        self._kept = np.zeros((_ROWS, worlds))
        self._step = np.zeros(worlds, np.intp)
        self._push = np.zeros((task.STATE_DIM, worlds))
        # Drawn in advance, for the episodes that were begun with a seed.
        self._pushes: FloatArray | None = None
        self._in_advance = np.zeros(worlds, bool)
        self._stepwise = StepwiseDisturbance(self.disturbance, worlds, self.settings.control_period)
        self._worlds = np.arange(worlds)
        # t and r(t) at every control instant, and at the one to which a world that is to start
        # anew is moved.
        instants = np.arange(self._steps + 2)
        self._times: FloatArray = np.multiply(instants, self.settings.control_period)
        self._radii: FloatArray = self.settings.tube.radius(self._times)
        # What stays the same in every observation of an episode: goal and initial state.
        self._blank = np.zeros((worlds, task.OBSERVATION_DIM), np.float32)
        self.nominal: FloatArray | None = None
        self._ready = self._starts(np.zeros((0, 2)), {})
        self._source: np.random.Generator | None = None
        self._taken = 0

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
        restarting = self._restarting()
        self._advance(force)
        rewards, terminated = self._kept[_REWARD].copy(), self._kept[_FALLEN] > 0.0
        truncated = self._step >= self.step_limit
        if restarting is not None:
            self._restart(restarting, rewards, terminated, truncated)
        observation, info = self._after_step(terminated | truncated)
        return observation, rewards, terminated, truncated, info

    @property
    def state(self) -> FloatArray:
        """The states x in double precision, shape (num_envs, 4)."""
        check_started(self._started, "state")
        return np.array(self._kept[_STATE].T, order="C")

    @property
    def _goal(self) -> FloatArray:
        return self._kept[_GOAL]

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

    def _start(self, worlds: IntArray, seeds: Sequence[int] | None, given: dict[str, Any]) -> None:
        stated = {name: value[worlds] for name, value in given.get("scenario", {}).items()}
        disturbed = self.disturbance.kind != "none"
        if seeds is None:
            begun = self._drawn_starts(worlds.size, stated)
            if disturbed:
                self._in_advance[worlds] = False
                self._stepwise.begin(worlds, self._shared.disturbance)
        else:
            begun = self._seeded_starts(seeds, stated)
            if disturbed:
                self._realise(worlds, seeds)
        self._kept[:, worlds] = begun.kept
        self._blank[worlds] = begun.blank
        self._step[worlds] = 0
        if disturbed:
            self._push[:, worlds] = 0.0

    def _seeded_starts(self, seeds: Sequence[int], stated: dict[str, FloatArray]) -> _Starts:
        shares = np.empty((len(seeds), 2))
        for row, rng in zip(shares, seeded_streams(seeds, "scenario"), strict=True):
            row[:] = task.draw_shares(rng)
        return self._starts(shares, stated)

    def _drawn_starts(self, count: int, stated: dict[str, FloatArray]) -> _Starts:
        """Return starts of episodes without seeds, as far as they are not stated.

        Some are drawn and worked out in advance: that takes as long for a thousand as for ten.
        """
        rng = self._shared.scenario
        if stated:
            return self._starts(task.draw_shares(rng, (count,)), stated)
        if rng is not self._source or self._taken + count > len(self._ready.blank):
            drawn = task.draw_shares(rng, (max(_READY, count),))
            self._source, self._ready, self._taken = rng, self._starts(drawn, {}), 0
        some = slice(self._taken, self._taken + count)
        self._taken += count
        return _Starts(self._ready.kept[:, some], self._ready.blank[some])

    def _starts(self, shares: FloatArray, stated: dict[str, FloatArray]) -> _Starts:
        """Return what is kept of episodes at their start."""
        scenario = replace(task.scenario_of_shares(shares, self.settings), **stated)
        kept = np.zeros((_ROWS, len(shares)))
        kept[_STATE], kept[_GOAL] = scenario.initial_state.T, scenario.goal.T
        kept[_DISTANCE] = task.goal_distance(kept[_STATE], kept[_GOAL], np.sqrt)
        kept[_RADIUS] = self._radii[0]
        kept[_INSIDE] = kept[_DISTANCE] <= self._radii[0]
        kept[_SUCCESS_TIME] = np.where(kept[_INSIDE], 0.0, np.inf)
        blank = np.zeros((len(shares), task.OBSERVATION_DIM), np.float32)
        blank[:, task.GOAL], blank[:, task.INITIAL_STATE] = scenario.goal, scenario.initial_state
        return _Starts(kept, blank)

    def _realise(self, worlds: IntArray, seeds: Sequence[int]) -> None:
        """Draw the disturbances of episodes with seeds."""
        if self._pushes is None:
            self._pushes = np.zeros((self.num_envs, self._steps, task.STATE_DIM))
        pushes = np.empty((worlds.size, *self._pushes.shape[1:]))
        streams = seeded_streams(seeds, "disturbance")
        self.disturbance.realise_all(streams, pushes, self.settings.control_period)
        self._pushes[worlds] = pushes
        self._in_advance[worlds] = True

    def _advance(self, force: FloatArray) -> None:
        """Move all worlds over one control step and judge it."""
        kept = self._kept
        self._push = self._current_push()
        self._step += 1
        kept[_NOW], kept[_RADIUS] = self._clock()
        following = self._hold(kept[_STATE], [force], self._push, kept[_GIVEN])
        outcome = self._hold.measured
        # A comparison with nan gives False.
        within = outcome[_DISTANCE - _EFFORT] <= task.LARGEST_DISTANCE
        if np.count_nonzero(within) < within.size:
            lost = np.flatnonzero(~within)
            judged = self._rules.lost(
                [*kept[_STATE, lost]], [force[lost]], [*kept[_GIVEN, lost]], functions
            )
            outcome[:, lost] = np.broadcast_arrays(*judged)
            following[:, lost] = kept[_STATE, lost]
        kept[_STATE], kept[_OUTCOME] = following, outcome

    def _current_push(self) -> FloatArray:
        """Return d of this step, (4, worlds), not to be written to."""
        if self.disturbance.kind == "none":
            return self._push
        push = self._drawn_push()
        if not self.disturbance.is_feedback:
            return push
        now = self._kept[_NOW].copy()
        situation = Situation(self.state, self._nominal_now(), now, np.array(push.T, order="C"))
        # A copy: a callable may return an array that it keeps.
        return np.array(self.disturbance.respond(situation).T, order="C")

    def _drawn_push(self) -> FloatArray:
        """Return what is drawn for this step; of a feedback kind it is a direction."""
        advance, stepwise = self._in_advance, not self._in_advance.all()
        drawn = self._stepwise.step(self._step, self._shared.disturbance) if stepwise else None
        if self._pushes is None or not np.count_nonzero(advance):
            return cast(FloatArray, drawn)
        # Past the time limit (a caller who ignored `truncated`) the last push stays.
        place = np.minimum(self._step, self._steps - 1)
        place += self._worlds * self._steps
        stored = self._pushes.reshape(-1, task.STATE_DIM).take(place, axis=0).T
        return stored if drawn is None else np.where(advance, stored, drawn)

    def _force(self, actions: NDArray[np.float32]) -> FloatArray:
        if type(actions) is np.ndarray and actions.dtype == np.float32:
            # What single precision holds does not overflow on its way to a force.
            values = actions.reshape(-1)
            usual = actions.shape == (self.num_envs, 1)
            if usual and np.count_nonzero(np.isfinite(values)) == values.size:
                return self._applied(values.astype(np.float64))
        checked = checked_actions(actions, (self.num_envs, 1), "the force of each world")
        with np.errstate(over="ignore"):
            return self._applied(checked[:, 0])

    def _applied(self, values: FloatArray) -> FloatArray:
        force: FloatArray = task.applied_force(self.settings, values, _clip)
        return force

    def _clock(self) -> tuple[FloatArray, FloatArray]:
        """Return t [s] and r(t) of every world."""
        disabled = self.autoreset_mode is AutoresetMode.DISABLED
        if disabled and np.count_nonzero(self._step >= self._times.size):
            # A caller who ignored `truncated`.
            times: FloatArray = np.multiply(self._step, self.settings.control_period)
            radii: FloatArray = self.settings.tube.radius(times)
            return times, radii
        return self._times.take(self._step), self._radii.take(self._step)

    def _nominal_now(self) -> FloatArray | None:
        if self.nominal is None:
            return None
        return self.nominal[self._worlds, np.minimum(self._step, self._steps)]

    def _observation(self) -> NDArray[np.float32]:
        observation = self._blank.copy()
        # One by one: quicker than to turn all four.
        for column in range(task.STATE_DIM):
            observation[:, column] = self._kept[column]
        observation[:, task.TIME] = self._kept[_NOW]
        return observation

    def _info(self) -> dict[str, Any]:
        # Copies: what is kept is written to.
        kept = self._kept[_NOW:].copy()
        now, radius, effort, effort_to_success, success_time, distance, *_ = kept
        fallen, inside = kept[_FALLEN - _NOW :] > 0.0
        success = success_time <= now
        calm = self.disturbance.kind == "none"
        info = {
            "success": success,
            "is_success": success.copy(),
            "success_time": success_time,
            "inside_tube": inside,
            "fallen": fallen,
            "effort": effort,
            "effort_to_success": effort_to_success,
            "disturbance": np.zeros(self._push.T.shape)
            if calm
            else np.array(self._push.T, order="C"),
            "tube_radius": radius,
            "goal_distance": distance,
        }
        nominal = self._nominal_now()
        if nominal is not None:
            info["tracking_error"] = task.goal_distance(self._kept[_STATE], nominal.T, np.sqrt)
        return info


def _clip(values: FloatArray, low: float, high: float) -> FloatArray:
    # What np.clip does, in a third of its time.
    clipped: FloatArray = np.minimum(np.maximum(values, low), high)
    return clipped
