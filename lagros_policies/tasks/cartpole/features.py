"""What the cart-pole networks see: the observation in the frame of the goal, mirrored to one side.

The cart-pole is symmetric under reflection and translation. Positions are taken relative to the
start and the goal, and an episode that starts leaning left is mirrored to one that starts leaning
right, so that the network learns each case once. The side is fixed by the initial state, hence
constant over an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import ANGLE, POSITION
from lagros_policies.learning.features import Seen, seen

Float32Array = NDArray[np.float32]

FEATURES = (
    "position - goal [m]",
    "angle [rad]",
    "velocity [m/s]",
    "angular rate [rad/s]",
    "goal - start [m]",
    "initial angle [rad]",
    "time [s]",
)
_STATE, _GOAL, _START = task.STATE.start, task.GOAL.start, task.INITIAL_STATE.start


def see(observation: Sequence[Any], functions: Any) -> Seen:
    """Return `FEATURES` and the side of an observation."""
    lean = observation[_START + ANGLE]
    side = functions.where(-lean > 0.0, -1.0, 1.0)
    goal = observation[_GOAL + POSITION]
    sided = [
        observation[_STATE + POSITION] - goal,
        *(observation[index] for index in range(_STATE + ANGLE, task.STATE.stop)),
        goal - observation[_START + POSITION],
        lean,
    ]
    return Seen([*(side * number for number in sided), observation[task.TIME]], (side,))


def cartpole_features(observation: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return the features and the side of each observation.

    Args:
        observation: Shape (13,) or (B, 13).

    Returns:
        Features, shape (7,) or (B, 7), and the side +-1, shape () or (B,): the control is the
        network's output times the side.
    """
    features, signs = seen(see, observation)
    return features, cast("Float32Array", signs)[..., 0]
