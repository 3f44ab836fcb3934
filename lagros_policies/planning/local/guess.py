"""First guesses of one agent's plan: a way around what stands still, a side to pass who moves.

A guess need not obey any constraint. It chooses the side on which the agent passes an obstacle or
another agent, which the quadratic programs that follow cannot change. Every choice is
deterministic. Agents do not tell each other their plans, but two that meet see the same miss
distance: both keep to the right of the other unless it lies clearly on the other side.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse.csgraph import dijkstra

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_policies.planning.grid_path import straighten
from lagros_policies.planning.vectors import segment_distance

# Corners of the polygon around a disc, and how far outside the corners' circle they stand.
_CORNERS = 10
_OUTSIDE = 1.01 / math.cos(math.pi / _CORNERS)
# How many times longer a way through a disc counts.
_CROSSING_COST = 30.0


def way_around(
    start: FloatArray, goal: FloatArray, centres: FloatArray, distance: FloatArray
) -> FloatArray:
    """Return a short way around discs that stand still.

    It is the shortest over the corners of polygons around the discs, straightened. Where no free
    way exists it crosses a disc: what follows will find it infeasible.

    Args:
        start: Position, shape (2,) [m].
        goal: Position, shape (2,) [m].
        centres: Of the discs, shape (m, 2) [m].
        distance: To be kept from each centre, shape (m,) [m]; less where start or goal is nearer.

    Returns:
        Polyline from start to goal, shape (points, 2) [m].
    """
    ends = np.stack([start, goal])
    if len(centres) == 0 or not _crossed(start, goal, centres, distance).any():
        return ends
    angle = np.arange(_CORNERS) * (2.0 * math.pi / _CORNERS)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    corners = centres[:, None] + _OUTSIDE * distance[:, None, None] * circle
    corners = corners.reshape(-1, 2)
    gaps = np.linalg.norm(corners[:, None] - centres, axis=-1)
    points = np.vstack([ends, corners[np.all(gaps >= distance, axis=1)]])
    first, second = np.triu_indices(len(points), 1)
    length = np.linalg.norm(points[first] - points[second], axis=-1)
    crossed = _crossed(points[first], points[second], centres, distance)
    weight = length * (1.0 + _CROSSING_COST * np.sum(crossed, axis=-1))
    graph = np.zeros((len(points), len(points)))
    graph[first, second] = graph[second, first] = weight
    _, before = dijkstra(graph, indices=0, return_predecessors=True)
    chain = [1]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return straighten(points[chain[::-1]], centres, distance)


def _crossed(
    begin: FloatArray, end: FloatArray, centres: FloatArray, distance: FloatArray
) -> BoolArray:
    """Return which discs segments cross, shape (..., m); an end inside a disc may leave it."""
    ends = [np.linalg.norm(point[..., None, :] - centres, axis=-1) for point in (begin, end)]
    allowed = np.minimum(distance, np.minimum(*ends)) - 1e-9
    crossed: BoolArray = segment_distance(begin, end, centres) < allowed
    return crossed


def progress(times: FloatArray, length: float, speed: float) -> FloatArray:
    """Return how far along a way of some length the motion of least effort is, as a share.

    Args:
        times: Instants, from 0 to the arrival at rest, shape (k,) [s].
        length: Of the way [m].
        speed: At the start [m/s]; more than would overshoot is cut.

    Returns:
        Shape (k,), from 0 to 1.
    """
    if length <= 0.0:
        return np.linspace(0.0, 1.0, len(times))
    share = times / times[-1]
    # Cubic with the slopes `speed` and 0 at its ends; it does not overshoot up to slope 3.
    slope = min(max(speed * float(times[-1]) / length, 0.0), 3.0)
    value: FloatArray = share**2 * (3.0 - 2.0 * share) + slope * share * (1.0 - share) ** 2
    return value


def pass_aside(
    guess: FloatArray,
    places: FloatArray,
    required: FloatArray,
    meets: BoolArray,
    deadband: float,
    left: bool = False,
) -> FloatArray:
    """Return a guess that passes those whom it would hit on one side.

    The miss distance is that of the closest approach, measured to the right of the relative motion.
    It is the same seen from either of the two, and so is the side that both choose.

    Args:
        guess: Positions at the instants, shape (K, 2) [m].
        places: Where the others are expected at the instants, shape (K, m, 2) [m].
        required: Distances to keep, shape (K, m) [m].
        meets: When whom to heed, shape (K, m).
        deadband: Keep to the right unless the miss distance is further left than this [m].
        left: Pass on the other side instead.

    Returns:
        Shape (K, 2).
    """
    shifted = guess.copy()
    for other in np.flatnonzero(meets.any(axis=0)):
        relative = shifted - places[:, other]
        room = np.linalg.norm(relative, axis=-1) - required[:, other]
        room = np.where(meets[:, other], room, np.inf)
        nearest = int(np.argmin(room))
        if not room[nearest] < 0.0 or len(guess) < 3:
            continue
        k = min(max(nearest, 1), len(guess) - 2)
        motion = relative[k + 1] - relative[k - 1]
        size = float(np.linalg.norm(motion))
        if size < 1e-9:
            continue
        right = np.array([motion[1], -motion[0]]) / size
        side = 1.0 if relative[nearest] @ right > -deadband else -1.0
        side = -side if left else side
        lateral = relative @ right
        push = side * np.maximum(required[:, other] - side * lateral, 0.0)
        shifted += np.where(room < 0.0, push, 0.0)[:, None] * right
    return shifted
