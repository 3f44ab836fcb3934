"""What the cart-pole's networks may fly: nearer goals and smaller leans than in training, too."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.tasks.cartpole.physics import ANGLE, POSITION
from lagros_envs.tasks.cartpole.task import GOAL, INITIAL_STATE, CartPoleSettings
from lagros_policies.trained_for import EpisodeCheck, Range, Training, body_values

# Where the observation says what its episode asks for.
_GOAL, _START = GOAL.start + POSITION, INITIAL_STATE.start + POSITION
_LEAN = INITIAL_STATE.start + ANGLE


class CartPoleTraining(Training):
    """What a network that was trained for a task may fly."""

    task: CartPoleSettings

    def range(self, timed: bool) -> Range:
        """Return the range of the settings; see `Training.range`."""
        task = self.task
        equal = body_values(task.system)
        equal |= {name: getattr(task, name) for name in ("control_period", "force_limit")}
        at_most = {name: getattr(task, name) for name in ("initial_angle", "goal_range")}
        (equal if timed else at_most)["time_limit"] = task.time_limit
        return {"equal": equal, "at_most": at_most}

    def episodes(self, policy: str, trained_for: Range) -> EpisodeCheck:
        """Return the check of way and lean; see `Training.episodes`."""
        # Of single precision, a hair wider than trained for.
        farthest, steepest = (
            (1.0 + 1e-6) * float(trained_for.get("at_most", {}).get(name, math.inf))
            for name in ("goal_range", "initial_angle")
        )
        return EpisodeRange(policy, farthest, steepest)


@dataclass(frozen=True)
class EpisodeRange:
    """Which episodes a network may fly: those like the ones of its training.

    Attributes:
        policy: Whose network it is, for the message.
        farthest: Largest distance from the start to the goal [m].
        steepest: Largest angle at the start [rad].
    """

    policy: str
    farthest: float
    steepest: float

    def __call__(self, rows: NDArray[Any]) -> None:
        """Check observations (13,) or (B, 13); a single one costs a microsecond.

        Raises:
            ValueError: A goal is farther away, or a start leans more, than in the training.
        """
        if rows.ndim == 1:
            way, lean = abs(rows.item(_GOAL) - rows.item(_START)), abs(rows.item(_LEAN))
        else:
            way = float(np.abs(rows[:, _GOAL] - rows[:, _START]).max(initial=0.0))
            lean = float(np.abs(rows[:, _LEAN]).max(initial=0.0))
        if way > self.farthest or lean > self.steepest:
            raise ValueError(
                f"the episode goes {way:.3g} m from a lean of {lean:.3g} rad; "
                f"{self.policy} was trained for at most {self.farthest:.3g} m and "
                f"{self.steepest:.3g} rad: pass allow_other_settings=True to fly outside of that"
            )
