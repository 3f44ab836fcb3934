"""`lagros/CartPole-v0`: bring a cart with a falling pole to a place, under bounded disturbance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lagros_envs.conventions import (
    RENDER_MODES,
    Conforming,
    End,
    check_render_mode,
    check_started,
    plain_seed,
    settings_of,
    warned_after,
)
from lagros_envs.disturbances import Disturbance, Situation, channel_mask
from lagros_envs.dynamics.held import HeldStep
from lagros_envs.numbers import functions
from lagros_envs.options import checked_actions, known_options
from lagros_envs.seeding import SharedStreams, episode_streams
from lagros_envs.stepwise import StepwiseDisturbance
from lagros_envs.tasks.cartpole import task

FloatArray = NDArray[np.float64]

_READY = 64  # starts that are drawn in advance


class _Start(NamedTuple):
    """How an episode begins.

    Attributes:
        state: x(0).
        goal: x_f.
        blank: The observation but for state and time, shape (13,), not to be written to.
    """

    state: tuple[float, ...]
    goal: tuple[float, ...]
    blank: NDArray[np.float32]


class CartPoleEnv(Conforming, gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Cart-pole with a continuous force, held for 0.1 s, and a bounded disturbance of the state.

    ## Action
    One number, `Box(-1, 1, (1,))`: the force on the cart in units of `settings.force_scale`
    (40 N). Actions beyond +-1 are applied as they are, unless `settings.force_limit` is set, up to
    `cartpole_task.LARGEST_FORCE`.

    ## Observation
    A flat float32 vector of 13; `gymnasium.spaces.unflatten(env.unwrapped.named_space, obs)` names
    its parts:

    | index | part            | content                                            |
    |-------|-----------------|----------------------------------------------------|
    | 0-3   | `state`         | x = [p, theta, dp/dt, dtheta/dt] [m, rad, m/s, rad/s] |
    | 4-7   | `goal`          | x_f = [p_f, 0, 0, 0]                               |
    | 8-11  | `initial_state` | x(0)                                               |
    | 12    | `time`          | t [s]                                              |

    ## Dynamics
    dx/dt = f(x) + B(x) u + d, Runge-Kutta in four substeps, u and d held over the control step,
    ||d|| <= `disturbance_bound`.

    ## Reward
    `lagros_envs.tasks.cartpole.task.reward`: minus effort and distance to the goal, plus a bonus
    for every step upright and one for the first success.

    ## Starting state
    theta_0 uniform in +-60 degrees at rest, goal p_f uniform in +-5 m. `reset(options=...)` takes
    `initial_state`, `goal` and `nominal` (x_d at every control instant, shape (91, 4)). A reset
    that is refused leaves the environment as it was.

    ## Episode end
    `terminated` when |theta| > pi/2 (a fall; so is a force too large to integrate, which leaves the
    state as it was); `truncated` at 9 s. The episode goes on after success: the paper counts the
    first entry, the strict measure looks at the end. `gym.make(..., max_episode_steps=20)` ends
    episodes sooner; longer ones need a longer `settings.time_limit` and a `max_episode_steps` to
    match.

    ## Info
    `success` (the paper's: at some control instant so far ||x - x_f|| <= r(t)), `is_success` (the
    same, by the name that other libraries read), `success_time` [s] (inf before), `inside_tube`
    (||x - x_f|| <= r(t) at this instant), `fallen`, `effort` (the integral of ||u||^2 so far),
    `effort_to_success` (the same, frozen at the first success), `disturbance` (d of the step),
    `tube_radius` r(t), `goal_distance` and, where the episode has a nominal, `tracking_error`
    ||x - x_d||.

    Args:
        disturbance: Kind of disturbance, one of `lagros_envs.disturbances.KINDS`, or a function of
            a `Situation`.
        disturbance_bound: d_bar, in units of the state per second.
        disturbance_channels: "all", "rates", or a mask of the four states.
        metric: Contraction metric M for the kind "worst": (4, 4), or a function of the state.
        settings: The task: a `CartPoleSettings`, or a dictionary of those fields that differ from
            the defaults.
        compiled: Whether numba (the extra "fast") compiles the equation of motion; the trajectories
            stay the same, bit for bit.
        render_mode: None, "human" or "rgb_array".

    Raises:
        ValueError: A setting is not valid.
        ImportError: `compiled` was asked for and numba is not installed.
    """

    settings: task.CartPoleSettings
    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}

    def __init__(
        self,
        disturbance: str | Any = "none",
        disturbance_bound: float = 0.75,
        disturbance_channels: Literal["all", "rates"] | Sequence[bool] = "all",
        metric: Any = None,
        settings: task.CartPoleSettings | Mapping[str, Any] | None = None,
        compiled: bool = False,
        render_mode: str | None = None,
    ) -> None:
        """Build the environment; see the class for the arguments."""
        self.render_mode = check_render_mode(render_mode)
        self.settings = settings_of(task.CartPoleSettings(), settings)
        self.disturbance = Disturbance(
            disturbance, disturbance_bound, channel_mask(disturbance_channels, task.RATES), metric
        )
        self._feedback = self.disturbance.is_feedback
        self._calm = self.disturbance.kind == "none"
        self._rules = task.StepRules(self.settings)
        self._hold = HeldStep(
            self.settings.system,
            self.settings.control_period,
            compiled,
            measure=self._rules,
            given=self._rules.GIVEN,
            pushed=not self._calm,
        )
        self._steps = self.settings.steps
        # t and r(t) at every control instant.
        self._clock = [self._instant(step) for step in range(self._steps + 1)]
        # Drawn in advance if the episode has a seed of its own.
        self._pushes: FloatArray | None = None
        self._stepwise = StepwiseDisturbance(self.disturbance, 1, self.settings.control_period)
        self._shared: SharedStreams | None = None
        # Starts that are drawn in advance, the next one last: to draw many takes little longer than
        # to draw one.
        self._ready: list[_Start] = []
        self.named_space = task.named_space(self.settings)
        self.observation_space = cast(
            "spaces.Space[NDArray[np.float32]]", spaces.flatten_space(self.named_space)
        )
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._renderer: Any = None
        self._started = False
        self.nominal: FloatArray | None = None
        self._end = End.NOT_YET

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the episode; the scenario and the disturbance have a stream each. None
                goes on drawing from the generator that the last seed has left.
            options: `initial_state` (4,), `goal` (4,) or p_f, `nominal` (steps + 1, 4).

        Returns:
            The observation and the info.

        Raises:
            ValueError: The seed is none, or an option is unknown or has a wrong shape or value.
        """
        options = known_options(options, task.OPTIONS)
        given = task.start_and_goal(options, (task.STATE_DIM,)) if options else {}
        nominal = task.nominal_from_options(options, self.settings) if options else None
        if self.disturbance.kind == "worst" and nominal is None:
            raise ValueError(
                'disturbance="worst" needs the nominal trajectory of the episode: pass '
                'reset(options={"nominal": array of shape (steps + 1, 4)})'
            )
        seed = plain_seed(seed)
        super().reset(seed=seed)
        start = self._draw(seed)
        self._start = _starts(replace(_scenario(start), **given))[0] if given else start
        self.nominal = nominal
        self._state, self._goal, self._blank = self._start
        self._step = 0
        self._now = self._clock[0]
        distance = task.goal_distance(self._state, self._goal, math.sqrt)
        inside = distance <= self._now[1]
        first = 0.0 if inside else math.inf
        # A `task.Outcome` as a plain tuple, which is several times faster.
        self._outcome: tuple[Any, ...] = (0.0, 0.0, first, distance, 0.0, False, inside)
        self._push = np.zeros(task.STATE_DIM)
        self._started = True
        self._end = End.NOT_YET
        if self.render_mode == "human":
            self.render()
        return self._observation(), self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold the force for one control step.

        Args:
            action: Force in units of `settings.force_scale`, shape (1,).

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            ValueError: The action is not one finite number.
            RuntimeError: The environment was not reset.
        """
        check_started(self._started, "step()")
        force = self._force(action)
        if self._end is not End.NOT_YET:
            self._end = warned_after(self._end)
        self._push = self._current_push()
        step = self._step = self._step + 1
        self._now = self._clock[step] if step <= self._steps else self._instant(step)
        self._advance(force)
        _, _, _, _, reward, fallen, _ = self._outcome
        if self.render_mode == "human":
            self.render()
        truncated = step >= self._steps
        if (fallen or truncated) and self._end is End.NOT_YET:
            self._end = End.REACHED
        return self._observation(), reward, fallen, truncated, self._info()

    @property
    def scenario(self) -> task.CartPoleScenario:
        """The scenario of the episode."""
        check_started(self._started, "scenario")
        return _scenario(self._start)

    @property
    def state(self) -> FloatArray:
        """The state x in double precision, shape (4,)."""
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
            gym.logger.warn(
                "render() was called without a render mode; "
                'pass render_mode="rgb_array" to gym.make'
            )
            return None
        check_started(self._started, "render()")
        if self._renderer is None:
            from lagros_envs.tasks.cartpole.draw import CartPoleRenderer

            self._renderer = CartPoleRenderer(self.render_mode, self.metadata["render_fps"])
        nominal = None if self.nominal is None else self.nominal[self._nominal_index()]
        frame: NDArray[np.uint8] | None = self._renderer.draw(
            state=self.state,
            goal=self.scenario.goal,
            tube_radius=self.settings.tube.radius(self.time),
            disturbance=self._push,
            disturbance_bound=self.disturbance.bound,
            nominal=nominal,
            time=self.time,
            half_length=self.settings.system.half_length,
        )
        return frame

    def close(self) -> None:
        """Release the window."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _draw(self, seed: int | None) -> _Start:
        """Draw the disturbance of an episode and return its start."""
        disturbed = not self._calm
        if seed is not None:
            streams = episode_streams(seed)
            if disturbed:
                self._pushes = self.disturbance.realise(
                    streams.disturbance, self._steps, self.settings.control_period
                )
            return _starts(task.sample_scenario(streams.scenario, self.settings))[0]
        if self._shared is None or self._shared.source is not self.np_random:
            self._shared, self._ready = SharedStreams(self.np_random), []
        if disturbed:
            # Not in advance: an episode of a learner may end after a few steps.
            self._pushes = None
            self._stepwise.begin(np.zeros(1, np.intp), self._shared.disturbance)
        if not self._ready:
            shares = task.draw_shares(self._shared.scenario, (_READY,))
            self._ready = _starts(task.scenario_of_shares(shares, self.settings))[::-1]
        return self._ready.pop()

    def _force(self, action: NDArray[np.float32]) -> float:
        if type(action) is np.ndarray and action.shape == (1,) and action.dtype.char in "fd":
            value = action.item()
        else:
            value = math.nan
        if not math.isfinite(value):
            # Slower, and with a message.
            value = checked_actions(action, (1,), "the force").item()
        force: float = task.applied_force(self.settings, value, _clip)
        return force

    def _advance(self, force: float) -> None:
        """Move the state over one control step, whose end `_step` counts already, and judge it."""
        # By name: starred arguments would go through a list and a tuple.
        x0, x1, x2, x3 = self._state
        g0, g1, g2, g3 = self._goal
        spent, frozen, first, _, _, _, _ = self._outcome
        t, r = self._now
        run = self._hold.run
        try:
            if self._calm:
                results = run(x0, x1, x2, x3, force, g0, g1, g2, g3, t, r, spent, frozen, first)
            else:
                push = self._push.tolist()
                results = run(
                    x0, x1, x2, x3, force, *push, g0, g1, g2, g3, t, r, spent, frozen, first
                )
        except (OverflowError, ValueError):  # an infinity has no sine
            pass
        else:
            # The distance; a comparison with nan is false.
            if results[7] <= task.LARGEST_DISTANCE:
                self._state, self._outcome = results[:4], results[4:]
                return
        given = (*self._goal, t, r, spent, frozen, first)
        self._outcome = self._rules.lost(self._state, (force,), given, functions)

    def _instant(self, step: int) -> tuple[float, float]:
        time = step * self.settings.control_period
        return time, self.settings.tube.radius(time)

    def _current_push(self) -> FloatArray:
        if self._calm:
            return np.zeros(task.STATE_DIM)
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

    def _observation(self) -> NDArray[np.float32]:
        observation = self._blank.copy()
        # One by one: four floats become an array more slowly than they are stored.
        observation[0], observation[1], observation[2], observation[3] = self._state
        observation[task.TIME] = self._now[0]
        return observation

    def _info(self) -> dict[str, Any]:
        effort, effort_to_success, success_time, distance, _, fallen, inside = self._outcome
        success = success_time != math.inf
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
        if self.nominal is not None:
            nominal = self.nominal[self._nominal_index()].tolist()
            info["tracking_error"] = task.goal_distance(self._state, nominal, math.sqrt)
        return info


def _starts(scenarios: task.CartPoleScenario) -> list[_Start]:
    """Return the starts of one scenario or of several."""
    states, goals = np.atleast_2d(scenarios.initial_state, scenarios.goal)
    blanks = np.zeros((len(states), task.OBSERVATION_DIM), np.float32)
    blanks[:, task.GOAL], blanks[:, task.INITIAL_STATE] = goals, states
    pairs = zip(map(tuple, states.tolist()), map(tuple, goals.tolist()), blanks, strict=True)
    return [_Start(*one) for one in pairs]


def _scenario(start: _Start) -> task.CartPoleScenario:
    return task.CartPoleScenario(np.array(start.state), np.array(start.goal))


def _clip(value: float, low: float, high: float) -> float:
    # Comparisons: calling min and max takes three times as long.
    return value if low <= value <= high else high if value > high else low
