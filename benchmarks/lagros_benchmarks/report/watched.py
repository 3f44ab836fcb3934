"""What is watched: an environment, the policy in it, and the pictures of both."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

import lagros_envs  # noqa: F401  (registers the environments)
from lagros_benchmarks.report.pictures import SinglePictures
from lagros_benchmarks.report.video import Frame
from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.run.library import make_single_policy
from lagros_benchmarks.worst_case.flights import plan_of
from lagros_policies.planning.planner import planner_of

if TYPE_CHECKING:
    from lagros_benchmarks.report.playback import WatchSettings


class SingleGame:
    """One body and its policy."""

    divisible = True  # There are pictures between the control instants.
    error: str | None = None
    env: Any
    _loop: ClosedLoop
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
        self._loop = ClosedLoop(self.env, make_single_policy(settings.policy, self.env))

    def start(self, render_mode: str, rate: float) -> None:
        """Begin the episode, with its plan, and open the window or what draws without one."""
        plan = plan_of(planner_of(self.env.settings), self.env.scenario)
        options = {"nominal": np.asarray(plan.states)} if plan.solved else {}
        self._loop.begin(self._seed, options)
        # Only now: a window would stand still while this plans.
        self._pictures = SinglePictures(self.env, render_mode, rate)

    def step(self) -> bool:
        """Take a control step; return whether the episode is over."""
        with Attempt() as attempt:
            self._loop.decide()
        self.error = attempt.error
        if self.error is not None:
            return True
        if self.divisible and self._pictures is not None:
            self._pictures.hold(self._loop.action)
        self._loop.move()
        return self._loop.over

    def draw(self, part: float) -> Frame | None:
        """Draw where a part of the last control step has led: a frame, or None in a window."""
        frame: Frame | None = self._pictures.draw(part, self._loop.info["disturbance"])
        return frame

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._pictures is not None:
            self._pictures.close()

    def counters(self) -> dict[str, int]:
        """Return what the policy counts."""
        return self._loop.counters()

    def outcome(self) -> str:
        """Return what the episode came to, in one line."""
        info = self._loop.info
        success = info["success"] and self.error is None
        reached = f"success at {info['success_time']:.1f} s" if success else "no success"
        end = "collided" if info.get("collided") else "fallen" if info["fallen"] else "upright"
        unit = self.env.settings.control_unit
        spent = efforts("effort", info["effort_to_success"], info["effort"], unit)
        return f"{reached}, {end}, {spent}"


def efforts(what: str, to_success: float, to_end: float, unit: str) -> str:
    """Return the effort as tables have it, and to the end of the episode where that is more.

    Args:
        what: What to call it.
        to_success: To the first success, if there was one.
        to_end: To the end of the episode.
        unit: Of the control; "" for none.
    """
    unit = f"({unit})" if "/" in unit else unit
    squared = f" {unit}²s" if unit else ""
    if to_end == to_success:
        return f"{what} {to_end:.2f}{squared}"
    return f"{what} to success {to_success:.2f}{squared}, to the end {to_end:.2f}{squared}"
