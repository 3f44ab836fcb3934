"""What the spacecraft networks see: what an agent senses, in the frame of its goal.

The task has no preferred direction. Vectors are turned into the frame whose first axis points to
the goal, and what the network answers is turned back, so that no direction has to be learned. In
that frame a plan depends on the body's heading not at all; heading and spin enter for the torque.
Vectors are complex numbers here: a turn is one product.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from lagros_envs.spacecraft_task import SpacecraftSettings
from lagros_policies.sensed import Sensed

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

OWN = (
    "distance to the goal [m]",
    "the same up to 0.5 m [m]",
    "velocity towards the goal [m/s]",
    "velocity across [m/s]",
    "time to go [s]",
    "the same up to 5 s [s]",
    "distance over time to go plus 5 s [m/s]",
    "turn since the start [rad]",
    "spin [rad/s]",
)
NEIGHBOUR = (
    "direction towards the goal",
    "direction across",
    "gap between the bodies [m]",
    "nearness",
    "relative velocity towards the goal [m/s]",
    "relative velocity across [m/s]",
    "closing speed [m/s]",
)
OBSTACLE = (*NEIGHBOUR, "distance of the centres at touch [m]")

_SMALL = 1e-9  # [m]
_NEAR = 0.3  # scale of nearness = exp(-gap / _NEAR) [m]
_FADE = 0.4  # what is sensed counts in full this far inside the sensing radius [m]


@dataclass(frozen=True)
class SpacecraftFeatures:
    """Inputs of a network for B agents.

    Attributes:
        own: Shape (B, len(OWN)).
        neighbours: Shape (e, len(NEIGHBOUR)), one row for each neighbour that is sensed.
        neighbour_owner: Whose neighbour each row is, ascending, shape (e,).
        neighbour_weight: From 0 at the rim of what is sensed to 1, shape (e,).
        obstacles: Shape (f, len(OBSTACLE)), and likewise owners and weights.
        obstacle_owner: Shape (f,).
        obstacle_weight: Shape (f,).
        frame: Unit vectors to the goals as complex numbers, shape (B,); a force of the world is the
            network's times this.
    """

    own: Float32Array
    neighbours: Float32Array
    neighbour_owner: NDArray[np.intp]
    neighbour_weight: Float32Array
    obstacles: Float32Array
    obstacle_owner: NDArray[np.intp]
    obstacle_weight: Float32Array
    frame: ComplexArray


def spacecraft_features(
    sensed: Sensed, settings: SpacecraftSettings, agent_radius: float, core_radius: float
) -> SpacecraftFeatures:
    """Return the inputs of the networks.

    Args:
        sensed: The observations.
        settings: The task.
        agent_radius: Radius of every agent against the others [m].
        core_radius: Radius against obstacles [m].
    """
    goal = _complex(sensed.goal)
    distance = np.abs(goal)
    far = distance > _SMALL
    frame = cast(ComplexArray, np.where(far, goal, 1.0) / np.where(far, distance, 1.0))
    back = frame.conj()
    velocity = _complex(sensed.velocity) * back
    left = np.maximum(settings.horizon - sensed.time, 0.0)
    own = np.empty((len(goal), len(OWN)), np.float32)
    own[:, 0] = distance
    own[:, 1] = np.minimum(distance, 0.5)
    own[:, 2:4] = _pairs(velocity)
    own[:, 4] = left
    own[:, 5] = np.minimum(left, 5.0)
    own[:, 6] = distance / (left + 5.0)
    own[:, 7] = sensed.heading_change
    own[:, 8] = sensed.spin
    # Neighbours first, then obstacles: one table for both.
    whose, slot = np.nonzero(sensed.neighbour_mask)
    others = sensed.neighbours[whose, slot]
    owner, slot = np.nonzero(sensed.obstacle_mask)
    discs = sensed.obstacles[owner, slot]
    turn = back[np.concatenate([whose, owner])]
    apart = _complex(np.concatenate([others[:, :2], discs[:, :2]])) * turn
    motion = np.concatenate([_complex(others[:, 2:]) * turn[: len(whose)], -velocity[owner]])
    reach = np.concatenate([np.zeros(len(whose)), discs[:, 2]])
    touch = reach + core_radius
    touch[: len(whose)] = 2.0 * agent_radius
    centre = np.maximum(np.abs(apart), _SMALL)
    unit, gap = apart / centre, centre - touch
    table = np.empty((len(gap), len(OBSTACLE)), np.float32)
    table[:, 0:2] = _pairs(unit)
    table[:, 2] = gap
    # Deep inside another body nearness would explode.
    table[:, 3] = np.exp(np.maximum(gap, -_NEAR) * (-1.0 / _NEAR))
    table[:, 4:6] = _pairs(motion)
    table[:, 6] = -(unit.conj() * motion).real
    table[:, 7] = touch
    weight = np.minimum((settings.sensing_radius + reach - centre) * (1.0 / _FADE), 1.0)
    weight = np.maximum(weight, 0.0).astype(np.float32)
    first = len(whose)
    return SpacecraftFeatures(
        own,
        table[:first, : len(NEIGHBOUR)],
        whose,
        weight[:first],
        table[first:],
        owner,
        weight[first:],
        frame,
    )


def _complex(vectors: FloatArray) -> ComplexArray:
    value: ComplexArray = np.ascontiguousarray(vectors).view(np.complex128)[..., 0]
    return value


def _pairs(values: ComplexArray) -> FloatArray:
    value: FloatArray = values.view(np.float64).reshape(len(values), 2)
    return value
