"""o_l(x, o_g): what one agent senses of its world, and the global state of that world."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces

from lagros_envs.arrays import Float32Array
from lagros_envs.tasks.spacecraft.loops import sensed_into
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.slots import Slots
from lagros_envs.tasks.spacecraft.task import STATE_DIM, SpacecraftSettings
from lagros_envs.tasks.spacecraft.world import SpacecraftWorld

NEIGHBOUR_DIM = 4  # relative position and velocity
OBSTACLE_DIM = 3  # relative position and radius


@dataclass(frozen=True)
class Layout:
    """Where each named part of an agent's observation lies.

    The number of slots is fixed; a slot is zero, and so is its mask, unless something is sensed
    there. No order among the slots means anything.

    Attributes:
        neighbours: Slots for other agents.
        obstacles: Slots for obstacles.
        time_limit: The end of an episode [s].
    """

    neighbours: int
    obstacles: int
    time_limit: float

    @classmethod
    def for_preset(cls, preset: Preset, settings: SpacecraftSettings) -> Layout:
        """Return the layout for the worlds of a preset, whose `agents` is their number.

        There is a slot for every body that can be sensed at once while none touch, and always one.
        """
        return cls(
            max(1, min(preset.agents - 1, preset.most_neighbours(settings.sensing_radius))),
            max(1, min(preset.obstacle_count[1], preset.most_obstacles(settings.sensing_radius))),
            settings.time_limit,
        )

    @property
    def shapes(self) -> OrderedDict[str, tuple[int, ...]]:
        """The named parts in the order in which they are flattened."""
        return OrderedDict(
            goal=(2,),
            velocity=(2,),
            heading=(3,),
            spin=(1,),
            time=(1,),
            neighbours=(self.neighbours, NEIGHBOUR_DIM),
            neighbour_mask=(self.neighbours,),
            obstacles=(self.obstacles, OBSTACLE_DIM),
            obstacle_mask=(self.obstacles,),
        )

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each part lies in the flat observation."""
        begin, found = 0, {}
        for name, shape in self.shapes.items():
            end = begin + int(np.prod(shape))
            found[name] = slice(begin, end)
            begin = end
        return found

    @property
    def size(self) -> int:
        """Length of the flat observation."""
        return int(self.slices["obstacle_mask"].stop)

    @property
    def named_space(self) -> spaces.Dict:
        """The parts as a space; `gymnasium.spaces.unflatten` gives them by name."""
        bounds = {
            # cos phi and sin phi have bounds, phi has none.
            "heading": (np.array([-1, -1, -np.inf]), np.array([1, 1, np.inf])),
            "time": (0.0, self.time_limit),
            "neighbour_mask": (0.0, 1.0),
            "obstacle_mask": (0.0, 1.0),
        }
        return _boxes(self.shapes, bounds)


def _boxes(
    shapes: Mapping[str, tuple[int, ...]], bounds: Mapping[str, tuple[Any, Any]]
) -> spaces.Dict:
    """Return a box for each part, in their order; what has no bounds is unbounded."""
    boxes: OrderedDict[str, spaces.Space[Any]] = OrderedDict()
    for name, shape in shapes.items():
        low, high = (
            np.broadcast_to(bound, shape).astype(np.float32)
            for bound in bounds.get(name, (-np.inf, np.inf))
        )
        boxes[name] = spaces.Box(low, high)
    return spaces.Dict(boxes)


def observe(world: SpacecraftWorld, layout: Layout) -> Float32Array:
    """Return the observation of every agent.

    Another agent is sensed when its centre, and an obstacle when any part of it, is no further from
    the agent's centre than the sensing radius.

    Args:
        world: The worlds.
        layout: That of their preset.

    Returns:
        Shape (worlds, agents, layout.size), a new array.
    """
    worlds, agents, at = world.worlds, world.agents, layout.slices
    rows = np.zeros((worlds * agents, layout.size), np.float32)
    own = rows[:, : at["neighbours"].start].reshape(worlds, agents, -1)
    x, y, heading, velocity_x, velocity_y, spin = world.parts
    own[..., 0], own[..., 1] = world.goals[0] - x, world.goals[1] - y
    own[..., 2], own[..., 3] = velocity_x, velocity_y
    own[..., 4], own[..., 5] = np.cos(heading), np.sin(heading)
    own[..., 6], own[..., 7] = heading - world.start_headings, spin
    # A caller who ignores `truncated` goes past the limit.
    own[..., 8] = np.minimum(world.time, layout.time_limit)[:, None]
    near, radius = world.near, world.settings.sensing_radius
    others = Slots.between(at["neighbours"], at["neighbour_mask"], agents - 1)
    discs = Slots.between(at["obstacles"], at["obstacle_mask"], world.obstacles)
    if world.compiled:
        if sensed_into(rows, world.parts, radius, world.obstacle_radii, near, others, discs):
            return rows.reshape(worlds, agents, -1)
        # Somebody senses more than there are slots for.
        rows[:, others.begin :] = 0.0
    if agents > 1:
        pairs = near.agents
        seen = np.flatnonzero(pairs.square <= radius**2)
        whose, whom = pairs.one.take(seen), pairs.other.take(seen)
        values = np.empty((len(seen), NEIGHBOUR_DIM), np.float32)
        values[:, 0], values[:, 1] = pairs.x.take(seen), pairs.y.take(seen)
        for column, speed in ((2, velocity_x.reshape(-1)), (3, velocity_y.reshape(-1))):
            values[:, column] = speed.take(whom) - speed.take(whose)
        number = np.arange(worlds * agents) % agents
        which = number.take(whom) - (whom > whose)
        others.fill(rows, whose, which, values, pairs.square.take(seen))
    if world.obstacles:
        pairs, radii = near.obstacles, world.obstacle_radii.reshape(-1)
        # -inf where there is no obstacle: its square must not count.
        reach = np.maximum(radii + radius, -1.0)
        seen = np.flatnonzero(pairs.square <= (reach * np.abs(reach)).take(pairs.other))
        whose, disc = pairs.one.take(seen), pairs.other.take(seen)
        size = radii.take(disc)
        values = np.empty((len(seen), OBSTACLE_DIM), np.float32)
        values[:, 0], values[:, 1], values[:, 2] = pairs.x.take(seen), pairs.y.take(seen), size
        rims = np.sqrt(pairs.square.take(seen)) - size
        discs.fill(rows, whose, disc % world.obstacles, values, rims)
    return rows.reshape(worlds, agents, -1)


def named_state_space(agents: int, obstacles: int, time_limit: float) -> spaces.Dict:
    """Return the named parts of the global state of one world, in the order of flattening.

    The parts are `time` t, (1,) [s]; `states` x, (agents, 6); `goals`, (agents, 2) [m]; `obstacles`
    with centre and radius, (obstacles, 3) [m]; and `obstacle_mask`, (obstacles,).
    """
    slots = max(1, obstacles)
    shapes = OrderedDict(
        time=(1,),
        states=(agents, STATE_DIM),
        goals=(agents, 2),
        obstacles=(slots, OBSTACLE_DIM),
        obstacle_mask=(slots,),
    )
    return _boxes(shapes, {"time": (0.0, time_limit), "obstacle_mask": (0.0, 1.0)})


def global_state(world: SpacecraftWorld) -> Float32Array:
    """Return the global state of every world, shape (worlds, size), laid out as the space says."""
    worlds = world.worlds
    present = np.isfinite(world.obstacle_radii)
    radii = np.where(present, world.obstacle_radii, 0.0)
    obstacles = np.zeros((worlds, max(1, world.obstacles), OBSTACLE_DIM))
    mask = np.zeros(obstacles.shape[:2])
    obstacles[:, : world.obstacles, :2] = np.moveaxis(world.obstacle_centres, 0, -1)
    obstacles[:, : world.obstacles, 2] = radii
    mask[:, : world.obstacles] = present
    parts = (
        np.minimum(world.time, world.settings.time_limit),
        world.states,
        np.moveaxis(world.goals, 0, -1),
        obstacles,
        mask,
    )
    return np.concatenate([part.reshape(worlds, -1) for part in parts], axis=1).astype(np.float32)
