"""The environment of any task of one body: bring it to a goal, under bounded disturbance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lagros_envs import of_task
from lagros_envs.arrays import Float32Array, FloatArray
from lagros_envs.conventions import (
    RENDER_MODES,
    Conforming,
    End,
    check_render_mode,
    check_started,
    plain_seed,
    warned_after,
)
from lagros_envs.disturbances import Situation
from lagros_envs.draw import Frame, Renderer
from lagros_envs.dynamics.held import HeldStep, OnFloats
from lagros_envs.numbers import functions
from lagros_envs.of_task import Channels, OfTask
from lagros_envs.options import checked_actions, known_options
from lagros_envs.rules import StepRules
from lagros_envs.seeding import SharedStreams, episode_streams
from lagros_envs.stepwise import StepwiseDisturbance
from lagros_envs.task import LARGEST_DISTANCE, Scenario, Task, distance_between

_NOT_YET = End.NOT_YET  # a member of an Enum is looked up slowly
_READY = 64  # starts that are drawn in advance


class TaskEnv(OfTask, Conforming, gym.Env[Float32Array, Float32Array]):
    """One body with n states and m controls, held for a control step, and a bounded disturbance.

    ## Action
    `Box(-1, 1, (m,))`: u = `task.control_centre` + `task.control_scale` * action. Actions beyond
    +-1 are applied as they are, as far as `task.control_low` and `task.control_high` let them.

    ## Observation
    A flat float32 vector; `gymnasium.spaces.unflatten(env.unwrapped.named_space, obs)` names its
    parts, and `task.layout` says where they lie: `state` x, `goal` x_f and `initial_state` x(0),
    n each, `time` t [s], and, where the task has discs, `discs` (most_discs, 3), centre and radius
    of each [m], zeros where there is none.

    ## Dynamics
    dx/dt = f(x) + B(x) u + d, Runge-Kutta in four substeps, u and d held over the control step,
    ||d|| <= `disturbance_bound`.

    ## Reward
    `task.reward`: minus effort and distance to the goal, plus a bonus for every step that the
    episode goes on and one for the first success.

    ## Starting state
    `task.sample`. `reset(options=...)` takes `initial_state`, `goal`, `nominal` (x_d at every
    control instant, shape (steps + 1, n)), where the task has discs `discs` (k, 3), and
    `initial_error` (n,), by which the body begins beside the initial state that is told. A reset
    that is refused leaves the environment as it was.

    ## Episode end
    `terminated` when the body has fallen (`task.fallen`; so is a control too large to integrate,
    which leaves the state as it was) or touches a disc on the straight way between two control
    instants; `truncated` at `task.time_limit`. The episode goes on after success.
    `gym.make(..., max_episode_steps=20)` ends episodes sooner; longer ones need a longer
    `settings.time_limit` and a `max_episode_steps` to match.

    ## Info
    `success` (at some control instant so far the goal was within `tube_radius`, and no disc has
    been touched), `is_success` (the same, by the name that other libraries read), `success_time`
    [s] (of the first such instant; inf before), `inside_tube` (within it at this instant),
    `fallen`, `collided` (where the task has discs), `effort` (the integral of ||u - centre||^2 so
    far), `effort_to_success` (the same, frozen at the first success), `disturbance` (d of the
    step), `tube_radius` (`task.success_radius`), `goal_distance` and, where the episode has a
    nominal, `tracking_error`, the distance from it.

    Args:
        disturbance: Kind of disturbance, one of `lagros_envs.disturbances.KINDS`, or a function of
            a `Situation`.
        disturbance_bound: d_bar, in units of the state per second; None for that of the task.
        disturbance_channels: "all", "rates", or a mask of the n states.
        metric: Contraction metric M for the kind "worst": (n, n), or a function of the state.
        settings: The task with settings of its own, or a dictionary of those fields that differ
            from the defaults.
        compiled: Whether numba (the extra "fast") compiles the equation of motion; the trajectories
            stay the same, bit for bit.
        render_mode: None, "human" or "rgb_array".
        task: The task, or the name that it is registered by.

    Raises:
        ValueError: A setting is not valid.
        ImportError: `compiled` was asked for and numba is not installed.
    """

    settings: Task
    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}

    def __init__(
        self,
        disturbance: str | Any = "none",
        disturbance_bound: float | None = None,
        disturbance_channels: Channels = "all",
        metric: Any = None,
        settings: Task | Mapping[str, Any] | None = None,
        compiled: bool = False,
        render_mode: str | None = None,
        task: Task | str | None = None,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.settings = self._settings(task, settings)
        self.disturbance = of_task.disturbance_of(
            self.settings, disturbance, disturbance_bound, disturbance_channels, metric
        )
        self._feedback = self.disturbance.is_feedback
        self._calm = self.disturbance.kind == "none"
        self._rules = StepRules(self.settings)
        self._discs = bool(self.settings.most_discs)
        self._hold = HeldStep(
            self.settings.system,
            self.settings.control_period,
            compiled,
            measure=self._rules,
            given=self._rules.given,
            pushed=not self._calm,
        )
        self._steps = self.settings.steps
        # t and the radius of success at every control instant.
        self._clock = [self._instant(step) for step in range(self._steps + 1)]
        # Drawn in advance if the episode has a seed of its own.
        self._pushes: FloatArray | None = None
        self._stepwise = StepwiseDisturbance(self.disturbance, 1, self.settings.control_period)
        self._shared: SharedStreams | None = None
        # Starts that are drawn in advance, the next one last: to draw many takes little longer than
        # to draw one.
        self._ready: list[of_task.Start] = []
        self._layout, self._options = self.settings.layout, of_task.option_names(self.settings)
        self._time_at = self._layout.time
        self.named_space = of_task.named_space(self.settings)
        flat: Any = spaces.flatten_space(self.named_space)
        box: Any = of_task.action_space(self.settings)
        self.observation_space, self.action_space = flat, box
        # Where an outcome has reward and fall, and what says that it is one.
        names = self._rules.names
        self._end_at = slice(names.index("reward"), names.index("inside"))
        self._size = names.index("size" if "size" in names else "distance")
        self._n, self._shape = self.settings.system.state_dim, box.shape
        self._apply = OnFloats(partial(of_task.applied, self.settings), a=self._shape[0])
        self._begin = OnFloats(self._rules.begun, x=self._n, g=self._rules.given)
        self._renderer: Renderer | None = None
        self._started = False
        # An `Outcome`, as far as it is kept, as a plain tuple, which is several times faster.
        self._outcome: tuple[Any, ...] = ()
        self.nominal: FloatArray | None = None
        self._end = _NOT_YET

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the episode; the scenario and the disturbance have a stream each. None
                goes on drawing from the generator that the last seed has left.
            options: `initial_state`, `initial_error`, `goal`, `nominal`, `discs`; see the class.

        Returns:
            The observation and the info.

        Raises:
            ValueError: The seed is none, or an option is unknown or has a wrong shape or value.
        """
        options = known_options(options, self._options)
        given = of_task.stated_scenario(options, self.settings) if options else {}
        nominal = of_task.stated_nominal(options, self.settings) if options else None
        if self.disturbance.kind == "worst" and nominal is None:
            raise ValueError(
                'disturbance="worst" needs the nominal trajectory of the episode: pass '
                f'reset(options={{"nominal": array of shape (steps + 1, {self._n})}})'
            )
        seed = plain_seed(seed)
        super().reset(seed=seed)
        start = self._draw(seed)
        if given:
            scenario = of_task.scenario_with(of_task.scenario_of(start), given)
            start = of_task.starts_of(self.settings, scenario)[0]
        self._start, self.nominal = start, nominal
        self._state, self._goal, _, self._fixed, self._blank = start
        if "initial_error" in given:
            self._state = tuple((self._state + given["initial_error"]).tolist())
        self._step = 0
        self._now = self._clock[0]
        self._outcome = (0.0, 0.0, 0.0, math.inf) if self._discs else (0.0, 0.0, math.inf)
        self._outcome, _ = self._begin.run(self._state, self._given())
        self._push = np.zeros(self._n)
        self._started = True
        self._end = _NOT_YET
        if self.render_mode == "human":
            self.render()
        return self._observation(), self._info()

    def step(self, action: Float32Array) -> tuple[Float32Array, float, bool, bool, dict[str, Any]]:
        """Hold the control for one control step.

        Args:
            action: Controls in units of `task.control_scale` from `task.control_centre`, (m,).

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            ValueError: The action is not m finite numbers.
            RuntimeError: The environment was not reset.
        """
        if not self._started:
            check_started(False, "step()")
        control = self._control(action)
        if self._end is not _NOT_YET:
            self._end = warned_after(self._end)
        self._push = np.zeros(self._n) if self._calm else self._current_push()
        step = self._step = self._step + 1
        self._now = self._clock[step] if step <= self._steps else self._instant(step)
        self._advance(control)
        reward, over = self._outcome[self._end_at]
        over = over or (self._discs and self._outcome[0] > 0.0)
        if self.render_mode == "human":
            self.render()
        truncated = step >= self._steps
        if (over or truncated) and self._end is _NOT_YET:
            self._end = End.REACHED
        return self._observation(), reward, over, truncated, self._info()

    @property
    def scenario(self) -> Scenario:
        """The scenario of the episode."""
        check_started(self._started, "scenario")
        found = of_task.scenario_of(self._start)
        return Scenario(found.initial_state, found.goal, found.discs[found.discs[:, 2] > 0.0])

    @property
    def state(self) -> FloatArray:
        """The state x in double precision, shape (n,)."""
        check_started(self._started, "state")
        return np.array(self._state)

    @property
    def time(self) -> float:
        """The time t [s]."""
        check_started(self._started, "time")
        return self._step * self.settings.control_period

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene: an RGB array, or a window in the mode "human"."""
        if self.render_mode is None:
            said = 'render() was called without a render mode; pass render_mode="rgb_array"'
            gym.logger.warn(f"{said} to gym.make")
            return None
        check_started(self._started, "render()")
        if self._renderer is None:
            self._renderer = self.settings.renderer(self.render_mode, self.metadata["render_fps"])
        nominal = None if self.nominal is None else self.nominal[self._nominal_index()]
        return self._renderer.draw(
            Frame(
                state=self.state,
                goal=self.scenario.goal,
                discs=self.scenario.discs,
                tube_radius=self._now[1],
                disturbance=self._push,
                disturbance_bound=self.disturbance.bound,
                nominal=nominal,
                time=self.time,
            )
        )

    def close(self) -> None:
        """Release the window."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _draw(self, seed: int | None) -> of_task.Start:
        """Draw the disturbance of an episode and return its start."""
        disturbed = not self._calm
        if seed is not None:
            streams = episode_streams(seed)
            if disturbed:
                self._pushes = self.disturbance.realise(
                    streams.disturbance, self._steps, self.settings.control_period
                )
            return of_task.starts_of(self.settings, self.settings.sample(streams.scenario))[0]
        if self._shared is None or self._shared.source is not self.np_random:
            self._shared, self._ready = SharedStreams(self.np_random), []
        if disturbed:
            # Not in advance: an episode of a learner may end after a few steps.
            self._pushes = None
            self._stepwise.begin(np.zeros(1, np.intp), self._shared.disturbance)
        if not self._ready:
            drawn = self.settings.sample_many(self._shared.scenario, _READY)
            self._ready = of_task.starts_of(self.settings, drawn)[::-1]
        return self._ready.pop()

    def _control(self, action: Float32Array) -> tuple[float, ...]:
        if type(action) is np.ndarray and action.shape == self._shape and action.dtype.char in "fd":
            values = action.tolist()
        else:
            values = [math.nan]
        if not math.isfinite(sum(values)):
            # Slower, and with a message.
            shape = (self.settings.system.control_dim,)
            values = checked_actions(action, shape, of_task.meaning_of(self.settings)).tolist()
        control, _ = self._apply.run(values)
        return control

    def _given(self) -> tuple[float, ...]:
        """Return what the rules are given of this step, see `rules.Given`."""
        if not self._discs:
            return (*self._fixed, *self._now, *self._outcome[:3])
        x, y = self.settings.position
        start = self._state[x], self._state[y]
        return (*start, *self._fixed, *self._now, *self._outcome[:4])

    def _advance(self, control: tuple[float, ...]) -> None:
        """Move the state over one control step, whose end `_step` counts already, and judge it."""
        given = self._given() if self._discs else (*self._fixed, *self._now, *self._outcome[:3])
        run = self._hold.run
        try:
            if self._calm:
                state, outcome = run(self._state, control, given)
            else:
                state, outcome = run(self._state, control, self._push.tolist(), given)
        except (OverflowError, ValueError):  # an infinity has no sine
            pass
        else:
            # A comparison with nan is false.
            if outcome[self._size] <= LARGEST_DISTANCE:
                self._state, self._outcome = state, outcome
                return
        self._outcome = self._rules.lost(self._state, control, given, functions)

    def _instant(self, step: int) -> tuple[float, float]:
        time = step * self.settings.control_period
        return time, float(self.settings.success_radius(time))

    def _current_push(self) -> FloatArray:
        if self._pushes is None:
            drawn = self._stepwise.step(self._step, cast(SharedStreams, self._shared).disturbance)[
                :, 0
            ]
        else:
            # Past the time limit (a caller who ignored `truncated`) the last push stays.
            drawn = self._pushes[min(self._step, self._steps - 1)]
        if not self._feedback:
            return drawn
        nominal = None if self.nominal is None else self.nominal[self._nominal_index()]
        return self.disturbance.respond(
            Situation(self.state, nominal, np.asarray(self.time), drawn)
        )

    def _nominal_index(self) -> int:
        return min(self._step, self._steps)

    def _observation(self) -> Float32Array:
        observation = self._blank.copy()
        # One by one: a few floats become an array more slowly than they are stored.
        for index, value in enumerate(self._state):
            observation[index] = value
        observation[self._time_at] = self._now[0]
        return observation

    def _info(self) -> dict[str, Any]:
        known = self._outcome[1:] if self._discs else self._outcome
        effort, effort_to_success, success_time, distance, _, fallen, inside = known[:7]
        success = success_time < math.inf
        if self._discs:
            collided = self._outcome[0] > 0.0
            success = success and not collided
        info = {
            "success": success,
            "is_success": success,
            "success_time": success_time,
            "inside_tube": inside,
            "fallen": fallen,
            "effort": effort,
            "effort_to_success": effort_to_success,
            "disturbance": self._push,
            "tube_radius": self._now[1],
            "goal_distance": distance,
        }
        if self._discs:
            info["collided"] = collided
        if self.nominal is not None:
            nominal = self.nominal[self._nominal_index()].tolist()
            info["tracking_error"] = distance_between(self._state, nominal, functions)
        return info
