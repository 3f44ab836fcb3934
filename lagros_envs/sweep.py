"""Collisions between control instants: the closest approach of pieces of straight motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.cells import Offsets, all_beside, all_pairs


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


def swept_agents(path: Path, contact: FloatArray, near: Offsets | None = None) -> BoolArray:
    """Tell which agents came too close to another agent of their world on the way.

    Args:
        path: How the agents moved.
        contact: Distance of centres at which two agents of a world touch, shape (worlds,) [m].
        near: Pairs of agents, each both ways, as they lie at the end, among which all are that can
            have met; None for all pairs.

    Returns:
        Shape (worlds, agents). The bulge of the paths counts as contact: a pass that is closer than
        the straight pieces tell is never missed.
    """
    points, bulge, reach = path
    worlds, agents = bulge.shape
    hit = np.zeros(worlds * agents, bool)
    flat = points.reshape(len(points), 2, -1)
    if near is None:
        near = Offsets.between(all_pairs(worlds, agents), flat[-1], flat[-1])
    # Who is further apart at the end than both have moved and need cannot have met; first for all
    # as for the fastest and widest.
    most = 2.0 * float(reach.max()) + float(contact.max())
    met = np.flatnonzero(near.square <= most * most)
    if not met.size:
        return hit.reshape(worlds, agents)
    one, other = near.one[met], near.other[met]
    touch, reaches, curves = np.repeat(contact, agents), reach.reshape(-1), bulge.reshape(-1)
    limit = reaches[one] + reaches[other] + touch[one]
    kept = near.square[met] <= limit * limit
    if kept.any():
        one, other = one[kept], other[kept]
        offsets = flat[:, :, other] - flat[:, :, one]
        close = closest_approach(offsets) < touch[one] + curves[one] + curves[other]
        hit[one[close]] = True
    return hit.reshape(worlds, agents)


def swept_obstacles(
    path: Path, centres: FloatArray, contact: FloatArray, near: Offsets | None = None
) -> BoolArray:
    """Tell which agents came too close to an obstacle on the way.

    Args:
        path: How the agents moved.
        centres: Of the obstacles, shape (2, worlds, obstacles) [m].
        contact: Distance of centres at which an agent touches, shape (worlds, obstacles) [m];
            -inf where there is no obstacle.
        near: Pairs of an agent and an obstacle, as they lie at the end, among which all are that
            can have met; None for all pairs.

    Returns:
        Shape (worlds, agents).
    """
    points, bulge, reach = path
    worlds, agents = bulge.shape
    hit = np.zeros(worlds * agents, bool)
    flat, discs = points.reshape(len(points), 2, -1), centres.reshape(2, -1)
    if near is None:
        pairs = all_beside(worlds, agents, contact.shape[1])
        near = Offsets.between(pairs, flat[-1], discs)
    touch = contact.reshape(-1)
    # An absent obstacle has the contact -inf; its square must not count.
    most = max(0.0, float(reach.max()) + float(touch.max()))
    met = np.flatnonzero(near.square <= most * most)
    if not met.size:
        return hit.reshape(worlds, agents)
    agent, disc = near.one[met], near.other[met]
    limit = np.maximum(touch[disc] + reach.reshape(-1)[agent], 0.0)
    kept = near.square[met] <= limit * limit
    if kept.any():
        agent, disc = agent[kept], disc[kept]
        offsets = flat[:, :, agent] - discs[:, disc]
        close = closest_approach(offsets) < touch[disc] + bulge.reshape(-1)[agent]
        hit[agent[close]] = True
    return hit.reshape(worlds, agents)


def closest_approach(offsets: FloatArray) -> FloatArray:
    """Return the least distance from the origin of polylines.

    Args:
        offsets: Corners, shape (corners, 2, ...).

    Returns:
        Shape (...).
    """
    start, way = offsets[:-1], offsets[1:] - offsets[:-1]
    length = np.einsum("sc...,sc...->s...", way, way)
    along = -np.einsum("sc...,sc...->s...", start, way)
    share = np.minimum(np.maximum(along / np.where(length > 0.0, length, 1.0), 0.0), 1.0)
    nearest = start + share[:, None] * way
    least: FloatArray = np.min(np.hypot(nearest[:, 0], nearest[:, 1]), axis=0)
    return least
