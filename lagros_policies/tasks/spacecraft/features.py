"""What the spacecraft networks see: what an agent senses, in the frame of its goal.

The task has no preferred direction. Vectors are turned into the frame whose first axis points to
the goal, and what the network answers is turned back, so that no direction has to be learned. In
that frame a plan depends on the body's heading not at all; heading and spin enter for the torque.
Vectors are complex numbers here: a turn is one product. The features themselves are functions over
the kinds of number: of arrays for NumPy, of recorded numbers for `lagros export`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lagros_envs.arrays import ComplexArray, Float32Array, FloatArray
from lagros_envs.numbers.functions import exp, maximum, minimum
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.learning.deep_set import Elements, SetFeatures
from lagros_policies.tasks.spacecraft.pace import time_to_go
from lagros_policies.tasks.spacecraft.receding import Receding
from lagros_policies.tasks.spacecraft.sensed import Sensed

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
CLOSE, SOON = 0.5, 5.0  # up to which distance [m] and time to go [s] count once more
NEAR = 0.3  # scale of nearness = exp(-gap / NEAR) [m]
FADE = 0.4  # what is sensed counts in full this far inside the sensing radius [m]


def own_features(
    goal: Any, velocity: Any, turn: Any, spin: Any, left: Any, receding: Receding | None = None
) -> tuple[Any, Any]:
    """Return `OWN` and the unit vector to the goal.

    Args:
        goal: Relative to the agent, a vector [m].
        velocity: A vector [m/s].
        turn: Of the heading since the start [rad].
        spin: [rad/s].
        left: Until the horizon [s].
        receding: How far goals are shown; None for all the way.
    """
    pace = None
    if receding is not None:
        pace, goal = receding.pace_of(abs(goal), left), receding.shown(goal)
    # A shift that no observation, in single precision, can undo: nothing is divided by zero.
    shifted = goal + SMALL
    distance = abs(shifted)
    frame = shifted / distance
    course = velocity * frame.conj()
    time = time_to_go(distance, left) if receding is None else receding.time_to_go(distance, pace)
    near, soon = minimum(distance, CLOSE), minimum(time, SOON)
    over = distance / (time + SOON)
    return (distance, near, course.real, course.imag, time, soon, over, turn, spin), frame


def body_features(apart: Any, motion: Any, touch: Any, rim: Any) -> tuple[Any, Any]:
    """Return `OBSTACLE` of a body, all but the last of which are `NEIGHBOUR`, and its weight.

    Args:
        apart: Where it is, relative to the agent in the frame of the goal [m].
        motion: How it moves, likewise [m/s].
        touch: Distance of the centres at touch [m].
        rim: Distance of the centres from which on it is not sensed [m].
    """
    centre = abs(apart) + SMALL
    unit, gap = apart / centre, centre - touch
    # Deep inside another body nearness would explode.
    nearness = exp(maximum(gap, -NEAR) * (-1.0 / NEAR))
    closing = (unit.conj() * -motion).real
    weight = maximum(minimum((rim - centre) * (1.0 / FADE), 1.0), 0.0)
    values = (unit.real, unit.imag, gap, nearness, motion.real, motion.imag, closing, touch)
    return values, weight


def spacecraft_features(
    sensed: Sensed,
    settings: SpacecraftSettings,
    agent_radius: float,
    core_radius: float,
    receding: Receding | None = None,
) -> SetFeatures:
    """Return the inputs of the networks; the frame is that of the goal.

    Args:
        sensed: The observations.
        settings: The task.
        agent_radius: Radius of every agent against the others [m].
        core_radius: Radius against obstacles [m].
        receding: As for `own_features`.
    """
    course, left = _complex(sensed.velocity), settings.horizon - sensed.time
    own, frame = own_features(
        _complex(sensed.goal), course, sensed.heading_change, sensed.spin, left, receding
    )
    back = frame.conj()
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
    touch, rim = np.empty(count), np.empty(count)
    touch[:first], rim[:first] = 2.0 * agent_radius, settings.sensing_radius
    np.add(discs[:, 2], core_radius, out=touch[first:])
    np.add(discs[:, 2], settings.sensing_radius, out=rim[first:])
    bodies, weight = body_features(moving[:, 0], moving[:, 1], touch, rim)
    table, weight = _table(bodies, count), weight.astype(np.float32)
    return SetFeatures(
        _table(own, len(left)),
        Elements(table[:first, : len(NEIGHBOUR)], whose, weight[:first]),
        Elements(table[first:], owner, weight[first:]),
        frame,
    )


def _table(columns: Any, rows: int) -> Float32Array:
    table = np.empty((rows, len(columns)), np.float32)
    for place, column in enumerate(columns):
        table[:, place] = column
    return table


def _complex(vectors: FloatArray) -> ComplexArray:
    value: ComplexArray = vectors.view(np.complex128)[..., 0]
    return value
