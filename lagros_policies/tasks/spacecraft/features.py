"""What the spacecraft networks see: what an agent senses, in the frame of its goal.

The task has no preferred direction. Vectors are turned into the frame whose first axis points to
the goal, and what the network answers is turned back, so that no direction has to be learned. In
that frame a plan depends on the body's heading not at all; heading and spin enter for the torque.
Vectors are complex numbers here: a turn is one product.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.learning.deep_set import Elements, SetFeatures
from lagros_policies.tasks.spacecraft.pace import time_to_go
from lagros_policies.tasks.spacecraft.sensed import Sensed

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

SMALL = 1e-9  # [m]
DISTANCES = np.array([np.inf, 0.5])  # up to which the distance to the goal counts [m]
TIMES = np.array([np.inf, 5.0])  # up to which the time to go counts [s]
NEAR = 0.3  # scale of nearness = exp(-gap / NEAR) [m]
FADE = 0.4  # what is sensed counts in full this far inside the sensing radius [m]


def spacecraft_features(
    sensed: Sensed, settings: SpacecraftSettings, agent_radius: float, core_radius: float
) -> SetFeatures:
    """Return the inputs of the networks; the frame is that of the goal.

    Args:
        sensed: The observations.
        settings: The task.
        agent_radius: Radius of every agent against the others [m].
        core_radius: Radius against obstacles [m].
    """
    goal, course = _complex(sensed.goal), _complex(sensed.velocity)
    # A shift that no observation, in single precision, can undo: nothing is divided by zero.
    shifted = goal + SMALL
    distance = np.abs(shifted)
    frame = shifted / distance
    back = frame.conj()
    left = time_to_go(distance, settings.horizon - sensed.time)
    own = np.empty((len(goal), len(OWN)), np.float32)
    np.minimum(distance[:, None], DISTANCES, out=own[:, 0:2])
    own[:, 2:4] = _pairs(course * back)
    np.minimum(left[:, None], TIMES, out=own[:, 4:6])
    np.divide(distance, left + TIMES[1], out=own[:, 6])
    own[:, 7:9] = sensed.own[:, 6:8]  # turn and spin
    # Neighbours first, then obstacles: one table for both.
    whose, slot = sensed.neighbour_mask.nonzero()
    others = sensed.neighbours[whose, slot]
    owner, slot = sensed.obstacle_mask.nonzero()
    discs = sensed.obstacles[owner, slot]
    first, count = len(whose), len(whose) + len(owner)
    # Where each body is and how it moves, relative to the agent.
    moving = np.empty((count, 2), np.complex128)
    moving[:first] = others.view(np.complex128)
    moving[first:, 0] = _complex(discs[:, :2])
    moving[first:, 1] = -course[owner]
    moving *= back[np.concatenate([whose, owner])][:, None]
    apart, motion = moving[:, 0], moving[:, 1]
    # Distances of the centres at touch, and at the rim of what is sensed.
    touch, rim = np.empty(count), np.empty(count)
    touch[:first], rim[:first] = 2.0 * agent_radius, settings.sensing_radius
    np.add(discs[:, 2], core_radius, out=touch[first:])
    np.add(discs[:, 2], settings.sensing_radius, out=rim[first:])
    centre = np.abs(apart) + SMALL
    unit, gap = apart / centre, centre - touch
    table = np.empty((count, len(OBSTACLE)), np.float32)
    table[:, 0:2] = _pairs(unit)
    table[:, 2] = gap
    # Deep inside another body nearness would explode.
    np.exp(np.maximum(gap, -NEAR) * (-1.0 / NEAR), out=table[:, 3])
    table[:, 4:6] = moving.view(np.float64)[:, 2:]
    table[:, 6] = (unit.conj() * -motion).real
    table[:, 7] = touch
    weight = np.minimum((rim - centre) * (1.0 / FADE), 1.0)
    weight = np.maximum(weight, 0.0).astype(np.float32)
    return SetFeatures(
        own,
        Elements(table[:first, : len(NEIGHBOUR)], whose, weight[:first]),
        Elements(table[first:], owner, weight[first:]),
        frame,
    )


def _complex(vectors: FloatArray) -> ComplexArray:
    value: ComplexArray = vectors.view(np.complex128)[..., 0]
    return value


def _pairs(values: ComplexArray) -> FloatArray:
    value: FloatArray = values.view(np.float64).reshape(len(values), 2)
    return value
