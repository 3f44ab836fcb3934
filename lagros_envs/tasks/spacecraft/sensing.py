"""o_l(x, o_g): what one agent senses of its world, and the global state of that world."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from gymnasium import spaces

from lagros_envs.arrays import Float32Array, FloatArray, IntArray
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.task import STATE_DIM, SpacecraftSettings
from lagros_envs.tasks.spacecraft.world import SpacecraftWorld

NEIGHBOUR_DIM = 4  # relative position and velocity
OBSTACLE_DIM = 3  # relative position and radius
_APART = 16


@dataclass(frozen=True)
class Layout:
    """Where each named part of an agent's observation lies.

    The number of slots is fixed, and each of the other agents and of the obstacles has one; a slot
    is zero, and so is its mask, unless what it belongs to is sensed. No order among the slots
    means anything.

    Attributes:
        neighbours: Slots for other agents.
        obstacles: Slots for obstacles.
        time_limit: The end of an episode [s].
    """

    neighbours: int
    obstacles: int
    time_limit: float

    @classmethod
    def of(cls, world: SpacecraftWorld) -> Layout:
        """Return the layout for a world; there is always one slot of each kind."""
        return cls(max(1, world.agents - 1), max(1, world.obstacles), world.settings.time_limit)

    @classmethod
    def for_preset(cls, preset: Preset, settings: SpacecraftSettings) -> Layout:
        """Return the layout for the worlds of a preset, whose `agents` is their number."""
        return cls(max(1, preset.agents - 1), max(1, preset.obstacle_count[1]), settings.time_limit)

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


def observation_columns(world: SpacecraftWorld, layout: Layout) -> Float32Array:
    """Return room for the observations of all agents, one row for each entry.

    Rows a multiple of a page apart would share their place in the cache.
    """
    rows = world.worlds * world.agents
    return np.zeros((layout.size, rows + _APART), np.float32)[:, :rows]


def observe(
    world: SpacecraftWorld, layout: Layout, columns: Float32Array | None = None
) -> Float32Array:
    """Return the observation of every agent.

    Another agent is sensed when its centre, and an obstacle when any part of it, is no further from
    the agent's centre than the sensing radius.

    Args:
        world: The worlds.
        layout: `Layout.of(world)`.
        columns: What `observation_columns` returned for them, to be used again and again: fresh
            memory costs as much as the observation.

    Returns:
        Shape (worlds, agents, layout.size), a new array.
    """
    worlds, agents, at = world.worlds, world.agents, layout.slices
    # One entry after the other, each over all agents of all worlds, and turned at the end.
    columns = observation_columns(world, layout) if columns is None else columns
    parts = columns.reshape(-1, worlds, agents)
    x, y, heading, velocity_x, velocity_y, spin = world.parts
    np.subtract(world.goals[0], x, out=parts[0], casting="same_kind")
    np.subtract(world.goals[1], y, out=parts[1], casting="same_kind")
    parts[2], parts[3] = velocity_x, velocity_y
    parts[4], parts[5] = np.cos(heading), np.sin(heading)
    np.subtract(heading, world.start_headings, out=parts[6], casting="same_kind")
    parts[7] = spin
    # A caller who ignores `truncated` goes past the limit.
    parts[at["time"].start] = np.minimum(world.time, layout.time_limit)[:, None]
    if agents > 1:
        places = _places_of_others(worlds, agents)
        seen = tuple(
            part.reshape(-1).take(places) - part for part in (x, y, velocity_x, velocity_y)
        )
        sight = world.settings.sensing_radius**2
        _fill(parts[at["neighbours"]], parts[at["neighbour_mask"]], seen, sight)
    if world.obstacles:
        across, up = world.centres_by_agent[0] - x, world.centres_by_agent[1] - y
        seen = across, up, world.radii_by_agent
        _fill(parts[at["obstacles"]], parts[at["obstacle_mask"]], seen, world.sight_by_agent)
    return np.array(columns.T, order="C").reshape(worlds, agents, -1)


def _fill(
    slots: Float32Array,
    mask: Float32Array,
    seen: tuple[FloatArray, ...],
    sight: float | FloatArray,
) -> None:
    """Write what is sensed, shapes (slots, worlds, agents), to its entries; zero what is not.

    Args:
        slots: The entries of the slots, one after the other.
        mask: The entries of their masks.
        seen: What may be sensed; the first two are its offset.
        sight: Square of the distance up to which it is.
    """
    across, up = seen[:2]
    mask[:] = across * across + up * up <= sight
    for index, values in enumerate(seen):
        np.multiply(values.astype(np.float32), mask, out=slots[index :: len(seen)])


@lru_cache(maxsize=8)
def _places_of_others(worlds: int, agents: int) -> IntArray:
    """Return where in (worlds * agents,) the others of each agent are, (others, worlds, agents)."""
    own = np.arange(agents)
    index = np.arange(agents - 1)[:, None]
    others = np.asarray(index + (index >= own), np.intp)
    return agents * np.arange(worlds)[:, None] + others[:, None]


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
