"""Collisions between control instants: the closest approach of pieces of straight motion."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray, IntArray


class Path(NamedTuple):
    """How agents moved over one control step.

    Attributes:
        points: Positions at the ends of the substeps, shape (substeps + 1, 2, worlds, agents) [m].
        bulge: How far the true path may leave the straight pieces, shape (worlds, agents) [m].
        reach: Furthest that the path gets from its end, shape (worlds, agents) [m].
    """

    points: FloatArray
    bulge: FloatArray
    reach: FloatArray

    @classmethod
    def through(cls, points: FloatArray, bulge: FloatArray) -> Path:
        """Return the path through these points."""
        offsets = points[:-1] - points[-1]
        squares = offsets[:, 0] * offsets[:, 0] + offsets[:, 1] * offsets[:, 1]
        return cls(points, bulge, np.sqrt(np.max(squares, axis=0)) + bulge)


def swept_agents(path: Path, contact: FloatArray) -> BoolArray:
    """Tell which agents came too close to another agent of their world on the way.

    Args:
        path: How the agents moved.
        contact: Distance of centres at which two agents of a world touch, shape (worlds,) [m].

    Returns:
        Shape (worlds, agents). The bulge of the paths counts as contact: a pass that is closer than
        the straight pieces tell is never missed.
    """
    points, bulge, reach = path
    worlds, agents = bulge.shape
    hit = np.zeros((worlds, agents), bool)
    if agents == 1:
        return hit
    first, second, places, other_places = _pairs(worlds, agents)
    x, y, reaches = (part.reshape(-1) for part in (*points[-1], reach))
    # Who is further apart at the end than both have moved and need cannot have met.
    square = np.square(x.take(other_places) - x.take(places))
    square += np.square(y.take(other_places) - y.take(places))
    limit = reaches.take(places) + reaches.take(other_places)
    limit += contact[:, None]
    world, pair = _places(square <= np.square(limit, out=limit))
    if world.size:
        one, other = first[pair], second[pair]
        offsets = points[:, :, world, other] - points[:, :, world, one]
        limit = contact[world] + bulge[world, one] + bulge[world, other]
        met = closest_approach(offsets) < limit
        hit[world[met], one[met]] = True
        hit[world[met], other[met]] = True
    return hit


def swept_obstacles(path: Path, centres: FloatArray, contact: FloatArray) -> BoolArray:
    """Tell which agents came too close to an obstacle on the way.

    Args:
        path: How the agents moved.
        centres: Of the obstacles, the same for all agents of a world, shape (2, obstacles, worlds,
            agents) [m].
        contact: Distance of centres at which an agent touches, shape (obstacles, worlds, agents)
            [m]; negative where there is no obstacle.

    Returns:
        Shape (worlds, agents).
    """
    points, bulge, reach = path
    hit = np.zeros(bulge.shape, bool)
    x, y = points[-1]
    square = x - centres[0]
    square *= square
    offset = y - centres[1]
    offset *= offset
    square += offset
    # An absent obstacle has the contact -inf; its square must not count.
    limit = np.add(reach, contact, out=offset)
    np.maximum(limit, 0.0, out=limit)
    limit *= limit
    obstacle, world, agent = _places(square <= limit)
    if world.size:
        offsets = points[:, :, world, agent] - centres[:, obstacle, world, agent]
        met = closest_approach(offsets) < contact[obstacle, world, agent] + bulge[world, agent]
        hit[world[met], agent[met]] = True
    return hit


@lru_cache(maxsize=8)
def _pairs(worlds: int, agents: int) -> tuple[IntArray, ...]:
    """Return the two agents of each pair, and where they are in (worlds * agents,)."""
    first, second = np.triu_indices(agents, 1)
    begin = agents * np.arange(worlds)[:, None]
    return first, second, begin + first, begin + second


def _places(mask: BoolArray) -> tuple[IntArray, ...]:
    """Return what `np.nonzero` does; where little is true that takes five times as long."""
    return np.unravel_index(np.flatnonzero(mask), mask.shape)


def closest_approach(offsets: FloatArray) -> FloatArray:
    """Return the least distance from the origin of polylines.

    Args:
        offsets: Corners, shape (corners, 2, ...).

    Returns:
        Shape (...).
    """
    start, way = offsets[:-1], np.diff(offsets, axis=0)
    length = np.einsum("sc...,sc...->s...", way, way)
    along = -np.einsum("sc...,sc...->s...", start, way)
    share = np.clip(along / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    nearest = start + share[:, None] * way
    least: FloatArray = np.min(np.hypot(nearest[:, 0], nearest[:, 1]), axis=0)
    return least
