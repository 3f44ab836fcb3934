"""The pictures of an episode that is watched: at the control instants, and between them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.report.video import Frame
from lagros_envs.draw import Frame as Scene
from lagros_envs.dynamics import hold_step

FloatArray = NDArray[np.float64]


class SinglePictures:
    """Draws a task of one body, also between two control instants.

    Args:
        env: The environment, unwrapped; somebody else resets it and takes its steps.
        render_mode: "human" opens a window; "rgb_array" draws without one.
        rate: Frames per second at which a window plays.

    Raises:
        ImportError: pygame is not installed.
    """

    def __init__(self, env: Any, render_mode: str, rate: float) -> None:
        """Open the window, or what draws without one."""
        self._env = env
        self._renderer = env.settings.renderer(render_mode, max(1, round(rate)))
        self._begun: FloatArray = env.state
        self._control = np.array(env.settings.control_centre)

    def hold(self, action: FloatArray) -> None:
        """Remember where the next control step begins, and the control that is held in it."""
        self._begun = self._env.state
        self._control = self._env.settings.control(np.asarray(action, np.float64))

    def draw(self, part: float, disturbance: FloatArray) -> Frame | None:
        """Draw where a part of the last control step has led.

        Args:
            part: Of the step, in (0, 1]; 1 is its end.
            disturbance: d that was held in it, shape (n,).

        Returns:
            The frame, or None in a window.
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
