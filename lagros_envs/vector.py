"""The vectorised twin of `TaskEnv`: many worlds, one array operation per step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from lagros_envs import of_task
from lagros_envs.arrays import BoolArray, Float32Array, FloatArray, IntArray
from lagros_envs.autoreset import RestartingVectorEnv, nominal_after
from lagros_envs.checks import check_whole
from lagros_envs.conventions import check_started
from lagros_envs.disturbances import Situation
from lagros_envs.dynamics.held import HeldBatch
from lagros_envs.numbers import functions
from lagros_envs.of_task import Channels, OfTask
from lagros_envs.options import checked_actions
from lagros_envs.rules import Rows, StepRules
from lagros_envs.seeding import seeded_streams
from lagros_envs.stepwise import StepwiseDisturbance
from lagros_envs.task import LARGEST_DISTANCE, Scenario, Task, distance_between

# Starts that are drawn in advance.
_READY = 2048


class _Starts(NamedTuple):
    """What is kept of some episodes at their start: one column of the first, row of the last.

    Attributes:
        kept: Shape (rows, episodes).
        blank: Their observations but for state and time, shape (episodes, size).
    """

    kept: FloatArray
    blank: Float32Array


class TaskVectorEnv(OfTask, RestartingVectorEnv):
    """Worlds of `TaskEnv` side by side; each world's trajectory is that of the single one.

    Spaces, dynamics, reward and info are those of `TaskEnv`, with a leading axis of worlds; seeds,
    masks and autoreset are those of `autoreset.RestartingVectorEnv`, with one row per world.
    `reset(options=...)` also takes `initial_state`, `initial_error` and `goal` (num_envs, n),
    `nominal` (num_envs, steps + 1, n) and, where the task has discs, `discs` (num_envs, k, 3).

    Args:
        num_envs: Number of worlds.
        disturbance: As in `TaskEnv`; a callable sees the states of all worlds at once.
        disturbance_bound: As in `TaskEnv`.
        disturbance_channels: As in `TaskEnv`.
        metric: As in `TaskEnv`.
        settings: As in `TaskEnv`.
        compiled: Whether numba (the extra "fast") compiles the equation of motion, which makes a
            step eight times faster; None: where it is installed. Compiled states differ from those
            of NumPy in the last digits (1e-15 a step).
        autoreset_mode: As in `autoreset.RestartingVectorEnv`.
        render_mode: Must be None; render a single environment instead.
        max_episode_steps: As in `autoreset.RestartingVectorEnv`.
        task: As in `TaskEnv`.

    Attributes:
        compiled: Whether the equation of motion is compiled.

    Raises:
        ValueError: A setting is not valid.
        ImportError: `compiled=True` and numba is not installed.
    """

    settings: Task

    def __init__(
        self,
        num_envs: int = 1,
        disturbance: str | Any = "none",
        disturbance_bound: float | None = None,
        disturbance_channels: Channels = "all",
        metric: Any = None,
        settings: Task | Mapping[str, Any] | None = None,
        compiled: bool | None = None,
        autoreset_mode: Literal["next_step", "same_step", "disabled"] | AutoresetMode = "next_step",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        task: Task | str | None = None,
    ) -> None:
        check_whole("num_envs", num_envs)
        self.settings = self._settings(task, settings)
        self.option_names = ("reset_mask", *of_task.option_names(self.settings))
        self.named_space = of_task.named_space(self.settings)
        super().__init__(
            num_envs,
            num_envs,
            spaces.flatten_space(self.named_space),
            of_task.action_space(self.settings),
            of_task.disturbance_of(
                self.settings, disturbance, disturbance_bound, disturbance_channels, metric
            ),
            self.settings,
            max_episode_steps,
            autoreset_mode,
            render_mode,
            f'gym.make("{self.settings.env_id}", render_mode=...)',
        )
        self._rules = StepRules(self.settings)
        self._hold = HeldBatch(
            self.settings.system,
            self.settings.control_period,
            (num_envs,),
            compiled,
            measure=self._rules,
            given=self._rules.given,
            pushed=self.disturbance.kind != "none",
        )
        self.compiled = self._hold.compiled
        self._allocate()

    def _allocate(self) -> None:
        worlds, self._steps = self.num_envs, self.settings.steps
        self._dim, self._layout = self.settings.system.state_dim, self.settings.layout
        self._rows = Rows(self._rules)
        self._actuators = list(zip(*of_task.actuators(self.settings), strict=True))
        self._kept = np.zeros((self._rows.count, worlds))
        self._step = np.zeros(worlds, np.intp)
        self._push = np.zeros((self._dim, worlds))
        # Drawn in advance, for the episodes that were begun with a seed.
        self._pushes: FloatArray | None = None
        self._in_advance = np.zeros(worlds, bool)
        self._stepwise = StepwiseDisturbance(self.disturbance, worlds, self.settings.control_period)
        self._worlds = np.arange(worlds)
        # t and the radius of success at every control instant, and at the one to which a world that
        # is to start anew is moved.
        instants = np.arange(self._steps + 2)
        self._times: FloatArray = np.multiply(instants, self.settings.control_period)
        self._radii: FloatArray = self.settings.success_radius(self._times)
        # What stays the same in every observation of an episode: all but state and time.
        self._blank = np.zeros((worlds, self._layout.size), np.float32)
        self.nominal: FloatArray | None = None
        # Columns of starts that are drawn already, and how many of them are used up.
        self._ready: _Starts | None = None
        self._source: np.random.Generator | None = None
        self._taken = 0

    def step(
        self, actions: Float32Array
    ) -> tuple[Float32Array, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Hold the controls of every world for one control step.

        Args:
            actions: As in `TaskEnv.step`, shape (num_envs, m).

        Returns:
            Observations, rewards, terminated, truncated and info, batched over worlds. A world
            that starts anew on this call (next-step autoreset) ignores its action and has reward 0.

        Raises:
            ValueError: The actions have a wrong shape or are not finite.
            RuntimeError: The environment was not reset.
        """
        self._need_start()
        control = self._control(actions)
        restarting = self._restarting()
        self._advance(control)
        kept, rows = self._kept, self._rows
        rewards, terminated = kept[rows.reward].copy(), kept[rows.fallen] > 0.0
        if rows.collided is not None:
            terminated |= kept[rows.collided] > 0.0
        truncated = self._step >= self.step_limit
        if restarting is not None:
            self._restart(restarting, rewards, terminated, truncated)
        observation, info = self._after_step(terminated | truncated)
        return observation, rewards, terminated, truncated, info

    @property
    def state(self) -> FloatArray:
        """The states x in double precision, shape (num_envs, n)."""
        check_started(self._started, "state")
        return np.array(self._kept[self._rows.state].T, order="C")

    @property
    def _goal(self) -> FloatArray:
        return self._kept[self._rows.goal]

    def _checked(self, mask: BoolArray, options: dict[str, Any]) -> dict[str, Any]:
        nominal = of_task.stated_nominal(options, self.settings, (self.num_envs,), mask)
        if self.disturbance.kind == "worst" and nominal is None:
            raise ValueError(
                'disturbance="worst" needs the nominal trajectories: pass '
                'reset(options={"nominal": array of shape '
                f"(num_envs, steps + 1, {self._dim})}})"
            )
        scenario = of_task.stated_scenario(options, self.settings, (self.num_envs,), mask)
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
            drawn = self.settings.sample_each(seeded_streams(seeds, "scenario"))
            begun = self._starts(drawn, stated)
            if disturbed:
                self._realise(worlds, seeds)
        self._kept[:, worlds] = begun.kept
        self._blank[worlds] = begun.blank
        self._step[worlds] = 0
        if disturbed:
            self._push[:, worlds] = 0.0

    def _drawn_starts(self, count: int, stated: dict[str, FloatArray]) -> _Starts:
        """Return starts of episodes without seeds, as far as they are not stated.

        Some are drawn and worked out in advance: that takes as long for a thousand as for ten.
        """
        rng, ready = self._shared.scenario, self._ready
        if stated:
            return self._starts(self.settings.sample_many(rng, count), stated)
        if ready is None or rng is not self._source or self._taken + count > len(ready.blank):
            drawn = self.settings.sample_many(rng, max(_READY, count))
            self._source, self._taken = rng, 0
            ready = self._ready = self._starts(drawn, {})
        some = slice(self._taken, self._taken + count)
        self._taken += count
        return _Starts(ready.kept[:, some], ready.blank[some])

    def _starts(self, drawn: Scenario, stated: dict[str, FloatArray]) -> _Starts:
        """Return what is kept of episodes at their start."""
        task, rows, layout = self.settings, self._rows, self._layout
        scenario = of_task.scenario_with(drawn, stated)
        count = len(scenario.initial_state)
        kept = np.zeros((rows.count, count))
        state = kept[rows.state]
        state[:], kept[rows.goal] = scenario.initial_state.T, scenario.goal.T
        if "initial_error" in stated:
            state += stated["initial_error"].T
        kept[rows.radius], kept[rows.success_time] = self._radii[0], np.inf
        if rows.collided is not None:
            kept[rows.start] = state[list(task.position)]
            kept[rows.discs] = of_task.contacts(task, scenario.discs).T
        kept[rows.outcome] = np.broadcast_arrays(*self._rules.begun([*state], [*kept[rows.given]]))
        blank = np.zeros((count, layout.size), np.float32)
        blank[:, layout.goal], blank[:, layout.initial_state] = (
            scenario.goal,
            scenario.initial_state,
        )
        blank[:, layout.discs] = scenario.discs.reshape(count, -1)
        return _Starts(kept, blank)

    def _realise(self, worlds: IntArray, seeds: Sequence[int]) -> None:
        """Draw the disturbances of episodes with seeds."""
        if self._pushes is None:
            self._pushes = np.zeros((self.num_envs, self._steps, self._dim))
        pushes = np.empty((worlds.size, *self._pushes.shape[1:]))
        streams = seeded_streams(seeds, "disturbance")
        self.disturbance.realise_all(streams, pushes, self.settings.control_period)
        self._pushes[worlds] = pushes
        self._in_advance[worlds] = True

    def _advance(self, control: list[FloatArray]) -> None:
        """Move all worlds over one control step and judge it."""
        kept, rows = self._kept, self._rows
        self._push = self._current_push()
        self._step += 1
        kept[rows.now], kept[rows.radius] = self._clock()
        if rows.collided is not None:
            kept[rows.start] = kept[list(self.settings.position)]
        following = self._hold(kept[rows.state], control, self._push, kept[rows.given])
        outcome = self._hold.measured
        # A comparison with nan gives False.
        within = outcome[rows.size - rows.outcome.start] <= LARGEST_DISTANCE
        if np.count_nonzero(within) < within.size:
            lost = np.flatnonzero(~within)
            judged = self._rules.lost(
                [*kept[rows.state, lost]],
                [one[lost] for one in control],
                [*kept[rows.given, lost]],
                functions,
            )
            outcome[:, lost] = np.broadcast_arrays(*judged)
            following[:, lost] = kept[rows.state, lost]
        kept[rows.state], kept[rows.outcome] = following, outcome

    def _current_push(self) -> FloatArray:
        """Return d of this step, (n, worlds), not to be written to."""
        if self.disturbance.kind == "none":
            return self._push
        push = self._drawn_push()
        if not self.disturbance.is_feedback:
            return push
        now = self._kept[self._rows.now].copy()
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
        stored = self._pushes.reshape(-1, self._dim).take(place, axis=0).T
        return stored if drawn is None else np.where(advance, stored, drawn)

    def _control(self, actions: Float32Array) -> list[FloatArray]:
        """Return the controls, each an array of worlds."""
        shape = (self.num_envs, len(self._actuators))
        usual = type(actions) is np.ndarray and actions.dtype == np.float32
        usual = usual and actions.shape == shape
        if usual and np.count_nonzero(np.isfinite(actions)) == actions.size:
            # What single precision holds does not overflow on its way to a control.
            return self._applied(actions.astype(np.float64))
        checked = checked_actions(
            actions, shape, f"{of_task.meaning_of(self.settings)} of each world"
        )
        with np.errstate(over="ignore"):
            return self._applied(checked)

    def _applied(self, values: FloatArray) -> list[FloatArray]:
        control = []
        for value, (centre, scale, low, high) in zip(values.T, self._actuators, strict=True):
            moved = centre + scale * value if centre else scale * value
            # What np.clip does, in a third of its time.
            control.append(np.minimum(np.maximum(moved, low), high))
        return control

    def _clock(self) -> tuple[FloatArray, FloatArray]:
        """Return t [s] and the radius of success of every world."""
        disabled = self.autoreset_mode is AutoresetMode.DISABLED
        if disabled and np.count_nonzero(self._step >= self._times.size):
            # A caller who ignored `truncated`.
            times: FloatArray = np.multiply(self._step, self.settings.control_period)
            radii: FloatArray = self.settings.success_radius(times)
            return times, radii
        return self._times.take(self._step), self._radii.take(self._step)

    def _nominal_now(self) -> FloatArray | None:
        if self.nominal is None:
            return None
        return self.nominal[self._worlds, np.minimum(self._step, self._steps)]

    def _observation(self) -> Float32Array:
        observation = self._blank.copy()
        # One by one: quicker than to turn all of them.
        for column in range(self._dim):
            observation[:, column] = self._kept[column]
        observation[:, self._layout.time] = self._kept[self._rows.now]
        return observation

    def _info(self) -> dict[str, Any]:
        rows = self._rows
        # Copies: what is kept is written to.
        kept = self._kept[rows.radius : rows.inside + 1].copy()
        radius = kept[0]
        effort, effort_to_success, success_time, distance = kept[-7:-3]
        fallen, inside = kept[-2:] > 0.0
        success = success_time <= self._kept[rows.now]
        collided = None if rows.collided is None else kept[1] > 0.0
        if collided is not None:
            success &= ~collided
        calm, shape = self.disturbance.kind == "none", self._push.T.shape
        info = {
            "success": success,
            "is_success": success.copy(),
            "success_time": success_time,
            "inside_tube": inside,
            "fallen": fallen,
            "effort": effort,
            "effort_to_success": effort_to_success,
            "disturbance": np.zeros(shape) if calm else np.array(self._push.T, order="C"),
            "tube_radius": radius,
            "goal_distance": distance,
        }
        if collided is not None:
            info["collided"] = collided
        nominal = self._nominal_now()
        if nominal is not None:
            state = self._kept[rows.state]
            info["tracking_error"] = distance_between([*state], [*nominal.T], functions)
        return info
