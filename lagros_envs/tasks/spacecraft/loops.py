"""Loops over pairs that numba compiles: what `sweep` and `sensing` do with arrays, bit for bit.

With a few hundred bodies most of the time of a step goes into calls of NumPy, not into numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray, IntArray
from lagros_envs.sweep import Path
from lagros_envs.tasks.spacecraft.nearby import Near
from lagros_envs.tasks.spacecraft.slots import Slots


def touched(
    path: Path, contact: FloatArray, centres: FloatArray, touch: FloatArray, near: Near
) -> BoolArray:
    """Return who came too close to an agent or an obstacle on the way, shape (worlds, agents).

    It is `sweep.swept_agents(path, contact, near.agents)` or `sweep.swept_obstacles(path, centres,
    touch, near.obstacles)`, with the arguments of these.
    """
    points, bulge, reach = path
    flat = points.reshape(len(points), 2, -1)
    discs = centres.reshape(1, 2, -1), touch.reshape(-1)
    hit: BoolArray = _compiled(_touched)(
        *(_compiled(_closest), flat, bulge.reshape(-1), reach.reshape(-1), contact, bulge.shape[1]),
        *(*discs, *near.pairs, *near.beside),
    )
    return hit.reshape(bulge.shape)


def sensed_into(
    rows: Float32Array,
    parts: FloatArray,
    radius: float,
    radii: FloatArray,
    near: Near,
    neighbours: Slots,
    obstacles: Slots,
) -> bool:
    """Write what every agent senses into observations in which nothing is sensed yet.

    Args:
        rows: The observations, shape (worlds * agents, size).
        parts: The states, shape (6, worlds, agents).
        radius: The sensing radius [m].
        radii: Of the obstacles, shape (worlds, obstacles) [m]; -inf where there is none.
        near: Who is near whom, and what.
        neighbours: The slots of other agents.
        obstacles: The slots of obstacles.

    Returns:
        Whether all that is sensed found a slot; if not, the rows hold a part of it.
    """
    flat, discs = parts.reshape(len(parts), -1), (near.centres, radii.reshape(-1))
    where = tuple(neighbours), tuple(obstacles)
    loop = _compiled(_sensed_into)
    return bool(loop(rows, flat, radius, parts.shape[2], *discs, *near.pairs, *near.beside, *where))


@lru_cache(maxsize=8)
def _compiled(loop: Callable[..., Any]) -> Any:
    import numba

    # Neither fused nor reordered: the numbers are those of the arrays.
    return numba.njit(error_model="numpy")(loop)


def _closest(points: FloatArray, i: int, others: FloatArray, j: int) -> float:
    """Return how close the way of one comes to the way of another, as `sweep.closest_approach`."""
    least, moves = math.inf, len(others) > 1
    for piece in range(len(points) - 1):
        at = piece if moves else 0
        after = at + 1 if moves else 0
        x, y = others[at, 0, j] - points[piece, 0, i], others[at, 1, j] - points[piece, 1, i]
        end_x = others[after, 0, j] - points[piece + 1, 0, i]
        end_y = others[after, 1, j] - points[piece + 1, 1, i]
        way_x, way_y = end_x - x, end_y - y
        length = way_x * way_x + way_y * way_y
        along = -(x * way_x + y * way_y)
        share = min(max(along / (length if length > 0.0 else 1.0), 0.0), 1.0)
        least = min(least, math.hypot(x + share * way_x, y + share * way_y))
    return least


def _touched(
    closest: Callable[..., float],
    points: FloatArray,
    bulge: FloatArray,
    reach: FloatArray,
    contact: FloatArray,
    agents: int,
    discs: FloatArray,
    touch: FloatArray,
    one: IntArray,
    other: IntArray,
    agent: IntArray,
    disc: IntArray,
) -> BoolArray:
    hit, (x, y) = np.zeros(len(bulge), np.bool_), points[-1]
    for k in range(len(one)):
        i, j = one[k], other[k]
        if i > j:
            continue  # each pair is there both ways
        across, up, room = x[j] - x[i], y[j] - y[i], contact[i // agents]
        limit = reach[i] + reach[j] + room
        if across * across + up * up > limit * limit:
            continue  # what is so far apart at the end cannot have met
        if closest(points, i, points, j) < room + bulge[i] + bulge[j]:
            hit[i] = hit[j] = True
    for k in range(len(agent)):
        i, j = agent[k], disc[k]
        across, up = discs[0, 0, j] - x[i], discs[0, 1, j] - y[i]
        limit = max(touch[j] + reach[i], 0.0)
        if across * across + up * up > limit * limit:
            continue
        if closest(points, i, discs, j) < touch[j] + bulge[i]:
            hit[i] = True
    return hit


def _sensed_into(
    rows: Float32Array,
    parts: FloatArray,
    radius: float,
    agents: int,
    centres: FloatArray,
    radii: FloatArray,
    one: IntArray,
    other: IntArray,
    agent: IntArray,
    disc: IntArray,
    neighbours: tuple[int, int, int, int],
    obstacles: tuple[int, int, int, int],
) -> bool:
    begin, mask, room, most = neighbours
    last, count = -1, 0
    for k in range(len(one)):
        i, j = one[k], other[k]
        across, up = parts[0, j] - parts[0, i], parts[1, j] - parts[1, i]
        if across * across + up * up > radius * radius:
            continue
        count = count + 1 if i == last else 0
        last = i
        slot = count if room < most else j % agents - (j > i)
        if slot >= room:
            return False
        place = begin + 4 * slot
        rows[i, mask + slot] = 1.0
        rows[i, place], rows[i, place + 1] = across, up
        rows[i, place + 2] = parts[3, j] - parts[3, i]
        rows[i, place + 3] = parts[4, j] - parts[4, i]
    begin, mask, room, most = obstacles
    last = -1
    for k in range(len(agent)):
        i, j = agent[k], disc[k]
        across, up = centres[0, j] - parts[0, i], centres[1, j] - parts[1, i]
        # -inf where there is no obstacle: its square must not count.
        far = max(radii[j] + radius, -1.0)
        if across * across + up * up > far * abs(far):
            continue
        count = count + 1 if i == last else 0
        last = i
        slot = count if room < most else j % most
        if slot >= room:
            return False
        place = begin + 3 * slot
        rows[i, mask + slot] = 1.0
        rows[i, place], rows[i, place + 1], rows[i, place + 2] = across, up, radii[j]
    return True
