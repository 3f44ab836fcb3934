"""The PPO agent that all spacecraft share: what it sees, and its actor as a policy in NumPy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, ComplexArray, Float32Array, FloatArray
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_policies.learning.networks import Mlp
from lagros_policies.policy import PolicyState
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftActor
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.thrusters import allocate

NEAREST = 3  # neighbours, and obstacles, that the agent looks at
WRENCH = 3  # what it chooses: a force and a torque
_OWN, _EACH = 5, 8
FEATURES = _OWN + 2 * _EACH * NEAREST
# Of an agent [m], and how far beyond a touch it senses a neighbour and an obstacle.
_RADIUS = 0.25
_ROOM = (1.5, 1.75)
# Numbers of the order of one, from metres and metres per second.
_GOAL_SCALE, _SPEED_SCALE, _RELATIVE_SPEED_SCALE = 0.5, 3.0, 2.0
# The pull of the goal, one far away, fades within this distance [m].
_FADE = 0.3
_SMALLEST = 1e-9


class Seen(NamedTuple):
    """What B agents see, and in which axes.

    Attributes:
        features: Shape (B, 53).
        axes: Turns a vector of the frame of the goal into the axes of the body, complex, shape
            (B,): a force there is this times the network's.
    """

    features: Float32Array
    axes: ComplexArray


def look(layout: Layout, observation: NDArray[np.floating]) -> Seen:
    """Return what the agents see: the nearest bodies in the frame whose first axis is to the goal.

    The task has no preferred direction; in this frame each case is learnt once, whatever the
    heading. Neighbours and obstacles are sorted by distance, so that their order in the observation
    changes nothing, and the number of features depends neither on that of the agents nor on that of
    the obstacles.

    Args:
        layout: Of the environment.
        observation: Shape (B, layout.size), or (layout.size,) for one.

    Returns:
        Features, float32: the goal's distance, twice, the velocity (2), the spin; then for each of
        the three nearest neighbours, and for each of the three nearest obstacles, its direction
        (2), the same times its nearness (2), its relative velocity (2), its nearness and that times
        the closing speed. Nearness falls from 1 at a touch of 0.25 m agents to 0 where sensing
        ends. What is not sensed is zero.

    Raises:
        ValueError: The observation is not of this layout.
    """
    sensed = Sensed.of(layout, observation)
    # A vector as a complex number is turned by one product.
    goal: ComplexArray = _complex(sensed.goal) + _SMALLEST
    way: FloatArray = np.abs(goal)
    forward: ComplexArray = goal / way
    turn: ComplexArray = forward.conj()[:, None]
    velocity = _complex(sensed.velocity) * turn[:, 0]
    own = [
        way / (way + _FADE),
        _GOAL_SCALE * way,
        *_pair(_SPEED_SCALE * velocity),
        sensed.spin,
    ]
    others = _complex(sensed.neighbours[..., :2]) * turn
    passing = _complex(sensed.neighbours[..., 2:]) * turn
    centres = _complex(sensed.obstacles[..., :2]) * turn
    standing = np.broadcast_to(-velocity[:, None], centres.shape)
    rims = np.abs(centres) - sensed.obstacles[..., 2]
    bodies = (
        (others, passing, np.abs(others) - 2.0 * _RADIUS, sensed.neighbour_mask),
        (centres, standing, rims - _RADIUS, sensed.obstacle_mask),
    )
    features = np.zeros((len(goal), FEATURES), np.float32)
    features[:, :_OWN] = np.stack(own, axis=1)
    begin = _OWN
    for kind, room in zip(bodies, _ROOM, strict=True):
        nearest = _nearest(*kind, room)
        features[:, begin : begin + nearest.shape[1]] = nearest
        begin += _EACH * NEAREST
    # The body's axes are (cos phi, -sin phi) and (sin phi, cos phi).
    return Seen(features, np.exp(1j * sensed.heading) * forward)


def _nearest(
    places: ComplexArray, motions: ComplexArray, gaps: FloatArray, mask: BoolArray, room: float
) -> FloatArray:
    """Return the features of the nearest bodies of one kind, fewer where there are fewer slots."""
    order = np.argsort(np.where(mask, gaps, np.inf), axis=1, kind="stable")[:, :NEAREST]
    place = np.take_along_axis(places, order, axis=1)
    gap = np.take_along_axis(gaps, order, axis=1)
    seen = np.take_along_axis(mask, order, axis=1)
    direction: ComplexArray = place / np.maximum(np.abs(place), _SMALLEST)
    nearness: FloatArray = np.where(seen, np.maximum(1.0 - gap / room, 0.0), 0.0)
    motion: ComplexArray = np.take_along_axis(motions, order, axis=1)
    motion = seen * _RELATIVE_SPEED_SCALE * motion
    closing = -(direction.conj() * motion).real
    each = [
        *_pair(direction),
        *_pair(direction * nearness),
        *_pair(motion),
        nearness,
        closing * nearness,
    ]
    table: FloatArray = np.stack(each, axis=-1).reshape(len(places), -1)
    return table


def _complex(vectors: FloatArray) -> ComplexArray:
    value: ComplexArray = vectors[..., 0] + 1j * vectors[..., 1]
    return value


def _pair(values: ComplexArray) -> tuple[FloatArray, FloatArray]:
    return values.real, values.imag


def thrust_of(
    settings: task.SpacecraftSettings, axes: ComplexArray, action: NDArray[np.floating]
) -> Float32Array:
    """Return the thrusts of least norm for a force in the frame of the goal and a torque.

    Args:
        settings: The task.
        axes: Of `look`, shape (B,).
        action: Force (2) and torque, shape (B, 3), in units of 1 N and 1 N m, each clipped to one.

    Returns:
        The action of the environment, shape (B, 8), in units of `settings.thrust_scale`.
    """
    wrench = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
    wrench[:, :2] = np.stack(_pair(axes * _complex(wrench[:, :2])), axis=1)
    return (allocate(settings.system, wrench) / settings.thrust_scale).astype(np.float32)


class SpacecraftPpoPolicy(SpacecraftActor):
    """The trained actor, its mean action, for any number of agents.

    `lagros train spacecraft --algo ppo` trains it, with six agents in the preset `paper`; another
    has learned the task of `gcbf`, with eight.
    """

    name = recorded_as = "ppo"
    kind = Mlp
    maps = FEATURES, WRENCH
    maker = "lagros train spacecraft"
    trained_in = ("paper",)  # the features count on the radii of its bodies
    weights_file = "spacecraft_ppo.safetensors"
    network: Mlp

    def _shipped(self) -> str:
        anchor = dict(self.preset.task) == dict(PRESETS["gcbf"].task)
        return "spacecraft_ppo_gcbf.safetensors" if anchor else self.weights_file

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Choose the mean thrusts of one agent (o,) or of many (B, o); see `Policy.predict`."""
        seen = look(self.layout, observation)
        thrust = thrust_of(self.settings, seen.axes, self.network(seen.features))
        return (thrust if np.ndim(observation) == 2 else thrust[0]), state
