"""What is watched: an environment, the policy in it, and the pictures of both."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

import lagros_envs  # noqa: F401  (registers the environments)
from lagros_benchmarks.report.video import Frame
from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.run.library import make_single_policy
from lagros_benchmarks.worst_case.flights import plan_of
from lagros_envs.arrays import FloatArray
from lagros_envs.draw import Frame as Scene
from lagros_envs.dynamics import hold_step
from lagros_policies.planning.planner import planner_of

if TYPE_CHECKING:
    from lagros_benchmarks.report.playback import WatchSettings


class SingleGame:
    """One body and its policy."""

    divisible = True  # There are pictures between the control instants.
    error: str | None = None
    env: Any
    loop: ClosedLoop
    _pictures: Any = None

    def __init__(self, settings: WatchSettings) -> None:
        self._seed = settings.seed
        self.env = gym.make(
            settings.described.env_id,
            disturbance=settings.disturbance,
            disturbance_bound=settings.disturbance_bound,
            disable_env_checker=True,
        ).unwrapped
        name = f"policy {settings.policy!r}"
        first = ClosedLoop(self.env, make_single_policy(settings.policy, self.env))
        first.rehearse(name, settings.seed)
        # Another one flies: a policy may count its calls without being told.
        self.loop = ClosedLoop(self.env, make_single_policy(settings.policy, self.env))

    def begin(self) -> None:
        """Begin the episode, with its plan."""
        plan = plan_of(planner_of(self.env.settings), self.env.scenario)
        options = {"nominal": np.asarray(plan.states)} if plan.solved else {}
        self.loop.begin(self._seed, options)

    def open(self, render_mode: str, rate: float) -> None:
        """Open the window, or what draws without one."""
        self._pictures = SinglePictures(self.env, render_mode, rate)

    def step(self) -> bool:
        """Take a control step; return whether the episode is over."""
        with Attempt() as attempt:
            self.loop.decide()
        self.error = attempt.error
        if self.error is not None:
            return True
        if self.divisible and self._pictures is not None:
            self._pictures.hold(self.loop.action)
        self.loop.move()
        return self.loop.over

    def draw(self, part: float) -> Frame | None:
        """Draw where a part of the last control step has led: a frame, or None in a window."""
        frame: Frame | None = self._pictures.draw(part, self.loop.info["disturbance"])
        return frame

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._pictures is not None:
            self._pictures.close()

    def counters(self) -> dict[str, int]:
        """Return what the policy counts."""
        return self.loop.counters()

    def outcome(self) -> str:
        """Return what the episode came to, in one line."""
        return outcome(self.loop.info, self.error, self.env.settings.squared_unit)


def outcome(info: Mapping[str, Any], error: str | None, unit: str) -> str:
    """Return what an episode came to by its last info, in one line.

    Args:
        info: Of the environment.
        error: The exception that ended it, or None.
        unit: Of the control, squared; "" for none.
    """
    success = info["success"] and error is None
    reached = f"success at {info['success_time']:.1f} s" if success else "no success"
    end = "collided" if info.get("collided") else "fallen" if info["fallen"] else "not fallen"
    spent = efforts("effort", info["effort_to_success"], info["effort"], unit)
    return f"{reached}, {end}, {spent}"


def efforts(what: str, to_success: float, to_end: float, unit: str) -> str:
    """Return an effort as tables have it, and to the end of the episode where that is more.

    The unit is that of the control, squared; "" for none.
    """
    squared = f" {unit}s" if unit else ""
    if to_end == to_success:
        return f"{what} {to_end:.2f}{squared}"
    return f"{what} to success {to_success:.2f}{squared}, to the end {to_end:.2f}{squared}"


class SinglePictures:
    """Draws a task of one body, also between two control instants.

    Args:
        env: The environment, unwrapped; somebody else resets it and takes its steps.
        render_mode: "human" opens a window; "rgb_array" draws without one.
        rate: Frames per second at which a window plays.
    """

    def __init__(self, env: Any, render_mode: str, rate: float) -> None:
        self._env = env
        self._renderer = env.settings.renderer(render_mode, max(1, round(rate)))
        self._begun: FloatArray = env.state
        self._control = np.array(env.settings.control_centre)

    def hold(self, action: FloatArray) -> None:
        """Remember where the next control step begins, and the control that is held in it."""
        self._begun = self._env.state
        self._control = self._env.settings.control(np.asarray(action, np.float64))

    def draw(self, part: float, disturbance: FloatArray) -> Frame | None:
        """Draw where a part of the last control step, in (0, 1], has led, under d of shape (n,).

        Returns the frame, or None in a window.
        """
        env, task = self._env, self._env.settings
        steps = env.time / task.control_period - (1.0 - part)
        state = env.state
        if part < 1.0:
            # What the environment does in the whole step, for a part of it.
            span = part * task.control_period
            state = hold_step(task.system, self._begun, self._control, span, disturbance)
        frame: Frame | None = self._renderer.draw(
            Scene(
                state=state,
                goal=env.scenario.goal,
                discs=env.scenario.discs,
                tube_radius=float(task.success_radius(steps * task.control_period)),
                disturbance=disturbance,
                disturbance_bound=env.disturbance.bound,
                nominal=None if env.nominal is None else _between(env.nominal, steps),
                time=steps * task.control_period,
            )
        )
        return frame

    def close(self) -> None:
        """Close the window, if there is one."""
        self._renderer.close()


def _between(nominal: FloatArray, steps: float) -> FloatArray:
    """Return x_d after so many control steps, on the line between two of them."""
    last = len(nominal) - 1
    before = min(math.floor(steps + 1e-9), last)
    share = max(0.0, steps - before)
    between: FloatArray = (1.0 - share) * nominal[before] + share * nominal[min(before + 1, last)]
    return between
