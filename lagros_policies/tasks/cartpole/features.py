"""What the cart-pole networks see: the observation in the frame of the goal, mirrored to one side.

The cart-pole is symmetric under reflection and translation. Positions are taken relative to the
start and the goal, and an episode that starts leaning left is mirrored to one that starts leaning
right, so that the network learns each case once. The side is fixed by the initial state, hence
constant over an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import ANGLE, POSITION
from lagros_policies.learning.features import Seen

_STATE, _GOAL, _START = task.STATE.start, task.GOAL.start, task.INITIAL_STATE.start


class CartPoleView:
    """What the networks see, see above; the sign is the side."""

    names = (
        "position - goal [m]",
        "angle [rad]",
        "velocity [m/s]",
        "angular rate [rad/s]",
        "goal - start [m]",
        "initial angle [rad]",
        "time [s]",
    )
    alike = None
    affine = 4

    def __init__(self, settings: task.CartPoleSettings | None = None) -> None:
        """Need nothing."""

    def __call__(self, observation: Sequence[Any], functions: Any) -> Seen:
        """See an observation, given by its components."""
        lean = observation[_START + ANGLE]
        side = functions.where(lean < 0.0, -1.0, 1.0)
        goal = observation[_GOAL + POSITION]
        sided = [
            observation[_STATE + POSITION] - goal,
            *(observation[index] for index in range(_STATE + ANGLE, task.STATE.stop)),
            goal - observation[_START + POSITION],
            lean,
        ]
        return Seen([*(side * number for number in sided), observation[task.TIME]], (side,))
