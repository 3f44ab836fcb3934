"""What the cart-pole networks see: the observation in the frame of the goal, mirrored to one side.

The cart-pole is symmetric under reflection and translation. Positions are taken relative to the
start and the goal, and an episode that starts leaning left is mirrored to one that starts leaning
right, so that the network learns each case once. The side is fixed by the initial state, hence
constant over an episode.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import ANGLE, POSITION

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
_GOAL_POSITION = task.GOAL.start + POSITION
_INITIAL_POSITION = task.INITIAL_STATE.start + POSITION
_INITIAL_ANGLE = task.INITIAL_STATE.start + ANGLE
_SOURCES = np.array([0, 1, 2, 3, _GOAL_POSITION, _INITIAL_ANGLE, task.TIME])


def cartpole_features(observation: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return the features and the side of each observation.

    Args:
        observation: Shape (13,) or (B, 13).

    Returns:
        Features, shape (7,) or (B, 7), and the side +-1, shape () or (B,): the control is the
        network's output times the side.
    """
    features: Float32Array = observation[..., _SOURCES]
    features[..., 0] -= observation[..., _GOAL_POSITION]
    features[..., 4] -= observation[..., _INITIAL_POSITION]
    side: Float32Array = np.where(observation[..., _INITIAL_ANGLE] < 0.0, -1.0, 1.0).astype(
        np.float32
    )
    features[..., :6] *= side[..., None]
    return features, side
