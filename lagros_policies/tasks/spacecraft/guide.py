"""What a crowd's agent should do, from what it senses alone: velocities that keep off the others'.

Joint plans are no label for a crowd: they take minutes, and what others plan is not sensed, so that
labels of one observation scatter. Reciprocal velocity obstacles (van den Berg, Guy, Lin and
Manocha, "Reciprocal n-body collision avoidance", 2011) are a function of what is sensed: each body
forbids velocities that meet it within a look-ahead, one half-plane each, of which two agents share
the change; the allowed velocity nearest to the wished one is found exactly (`safety.half_planes`).
Who is obstructed leans to its right. A gain leads to that velocity.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, ComplexArray, FloatArray
from lagros_envs.checks import check_fields
from lagros_policies.safety.half_planes import nearest
from lagros_policies.tasks.spacecraft.receding import SPEED_OF_PACE
from lagros_policies.tasks.spacecraft.sensed import Sensed

_SAME_PLACE = 1e-9  # [m], and speeds that have no direction [m/s]
_ARRIVED = 0.15  # within which there is nothing left to brake for [m]
_MOST = 1.5  # of the wished speed, that an evasion may be


@dataclass(frozen=True)
class Guide:
    """The law and its values.

    Attributes:
        gain: From an error of the velocity to an acceleration [1/s].
        braking: Deceleration with which the goal is reached [m/s^2].
        look: For how long velocities must not meet a body [s].
        part: In which time bodies that are too near are to part [s].
        pair_margin: Room beyond touching between agents [m].
        obstacle_margin: Likewise to obstacles [m].
        lean: By which the wished velocity is turned clockwise where it is obstructed [rad].
        bodies: How many of the nearest bodies count.

    Raises:
        ValueError: A value is out of range.
    """

    gain: float = 2.4
    braking: float = 0.4
    look: float = 2.0
    part: float = 0.5
    pair_margin: float = 0.18
    obstacle_margin: float = 0.14
    lean: float = 0.2
    bodies: int = 8

    def __post_init__(self) -> None:
        margins = ("pair_margin", "obstacle_margin", "lean")
        positive = [item.name for item in fields(self) if item.name not in margins]
        check_fields(self, positive=positive, not_negative=margins)

    def acceleration(
        self, sensed: Sensed, pace: FloatArray, agent_radius: float, core_radius: float
    ) -> ComplexArray:
        """Return what the agents should do, complex, shape (B,) [m/s^2].

        Args:
            sensed: What they sense.
            pace: As of `Receding`, shape (B,); the speed far from the goal is 1.5 times that, as a
                plan's from rest to rest is [m/s].
            agent_radius: Radius of every agent against the others [m].
            core_radius: Radius against obstacles [m].
        """
        velocity = _complex(sensed.velocity)
        wished = self._wished(_complex(sensed.goal), pace)
        others = sensed.neighbour_mask.shape[1]
        apart = np.concatenate([_complex(sensed.neighbours), _complex(sensed.obstacles)], axis=1)
        closing = np.empty_like(apart)
        closing[:, :others] = -_complex(sensed.neighbours[..., 2:])
        closing[:, others:] = velocity[:, None]
        room = np.full(apart.shape, 2.0 * agent_radius + self.pair_margin)
        room[:, others:] = sensed.obstacles[..., 2] + core_radius + self.obstacle_margin
        share = np.where(np.arange(apart.shape[1]) < others, 0.5, 1.0)
        present = np.concatenate([sensed.neighbour_mask, sensed.obstacle_mask], axis=1)
        gap = np.where(present, np.abs(apart) - room, np.inf)
        near = np.argsort(gap, axis=1, kind="stable")[:, : self.bodies]
        apart, closing, room, present = (
            np.take_along_axis(part, near, axis=1) for part in (apart, closing, room, present)
        )
        change, normal = self._changes(apart, closing, room)
        normal = np.where(present, normal, 0.0)
        bounds = _along(velocity[:, None] + share[near] * change, normal)
        bounds = np.where(present, bounds, -1.0)
        obstructed = np.max(bounds - _along(wished[:, None], normal), axis=1) > 0.0
        wished = wished * np.exp(-1j * self.lean * obstructed)
        chosen = nearest(_pair(wished), _pair(normal), bounds).points
        allowed = chosen[:, 0] + 1j * chosen[:, 1]
        most = _MOST * SPEED_OF_PACE * pace
        allowed *= np.minimum(1.0, most / np.maximum(np.abs(allowed), _SAME_PLACE))
        answer: ComplexArray = self.gain * (allowed - velocity)
        return answer

    def _wished(self, goal: ComplexArray, pace: FloatArray) -> ComplexArray:
        """Return the velocity to the goal that can still be braked, (B,) [m/s]."""
        distance = np.abs(goal)
        # Straight through the goal up to twice that distance, from where on it is the root.
        slope = np.sqrt(0.5 * self.braking / _ARRIVED) * distance
        root = np.sqrt(2.0 * self.braking * np.maximum(distance - _ARRIVED, 0.0))
        speed = np.minimum(np.where(distance < 2.0 * _ARRIVED, slope, root), SPEED_OF_PACE * pace)
        wished: ComplexArray = goal * (speed / np.maximum(distance, _SAME_PLACE))
        return wished

    def _changes(
        self, apart: ComplexArray, closing: ComplexArray, room: FloatArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the least change of the relative velocity that leaves each obstacle of velocities.

        The obstacle is a cone of velocities that lead into a disc, cut off by the disc that would
        be met at the end of the look-ahead; of bodies that are too near it is the disc that they
        must have left.

        Args:
            apart: From the agents to the bodies, shape (B, k) [m].
            closing: Velocities of the agents relative to the bodies [m/s].
            room: Radii of the discs [m].

        Returns:
            The changes, and outward normals of length one, (B, k) each.
        """
        inside: BoolArray = np.abs(apart) <= room
        time = np.where(inside, self.part, self.look)
        beyond = closing - apart / time
        length = np.maximum(np.abs(beyond), _SAME_PLACE)
        back = _along(beyond, apart)
        on_disc = inside | ((back < 0.0) & (-back > room * length))
        outward = beyond / length
        square = np.maximum(np.abs(apart) ** 2, _SAME_PLACE)
        tangent = np.sqrt(np.maximum(square - room**2, 0.0))
        left = (apart.conj() * beyond).imag > 0.0
        edge = (
            np.where(left, apart * (tangent + 1j * room), -apart * (tangent - 1j * room)) / square
        )
        to_edge = _along(closing, edge) * edge - closing
        change = np.where(on_disc, (room / time - length) * outward, to_edge)
        return change, np.where(on_disc, outward, 1j * edge)


def _along(vector: ComplexArray, unit: ComplexArray) -> FloatArray:
    along: FloatArray = (vector * unit.conj()).real
    return along


def _pair(vector: ComplexArray) -> FloatArray:
    return np.stack([vector.real, vector.imag], axis=-1)


def _complex(vectors: NDArray[np.float64]) -> ComplexArray:
    value: ComplexArray = vectors[..., 0] + 1j * vectors[..., 1]
    return value
