"""The nearest point in an intersection of half-planes, exactly and for many rows at once.

`nearest` answers min ||a - a_0||^2 subject to n'a >= b for a few half-planes. In the plane the
answer lies on one line or at the crossing of two: a projection in closed form where one is enough,
else all crossings are tried. Where no point meets all half-planes, the largest violation is made
least first. That is a linear program in three unknowns, whose dual has a solution with at most
three positive multipliers, so that again all can be tried.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray, IntArray

# What counts as met, relative to the largest bound of the row.
_TOLERANCE = 1e-9
# Normals whose cross product is smaller than this count as parallel.
_PARALLEL = 1e-12
# Bound of two half-planes that are added where multipliers are sought, so that any two opposite
# normals belong to three that are not all parallel. Nothing reaches it.
_FAR = -1e9


class Nearest(NamedTuple):
    """The answers of `nearest`.

    Attributes:
        points: Shape (B, 2).
        violation: The least possible t, zero where all half-planes have a point in common; with the
            softness one everywhere, the largest violation. Shape (B,).
    """

    points: FloatArray
    violation: FloatArray


def nearest(
    wanted: FloatArray, normals: FloatArray, bounds: FloatArray, softness: FloatArray | None = None
) -> Nearest:
    """Return the points nearest to those wanted with n'a >= b for every half-plane of their row.

    Where no point meets them all, t is made least in n'a >= b - softness t first.

    Args:
        wanted: a_0, shape (B, 2).
        normals: n, of length one, or zero where there is no half-plane, shape (B, k, 2).
        bounds: b, shape (B, k); those of zero normals are not looked at.
        softness: How much of a violation each of the k half-planes takes, >= 0, the largest of them
            1. Those with zero are never violated, and must have a point in common. Shape (k,); None
            for ones.

    Returns:
        The points and the violations t, in the units of the bounds.
    """
    present = np.any(normals != 0.0, axis=-1)
    used = np.flatnonzero(present.any(axis=0))
    if used.size == 0:
        return Nearest(wanted.copy(), np.zeros(len(wanted)))
    normals = normals[:, used]
    # Met by every point, as the normal is zero.
    bounds = np.where(present[:, used], bounds[:, used], -1.0)
    soft = np.ones(used.size) if softness is None else softness[used]
    points, met = _projection(wanted, normals, bounds)
    violation = np.zeros(len(wanted))
    rows = np.flatnonzero(~met)
    if rows.size:
        points[rows], met[rows] = _crossing(wanted[rows], normals[rows], bounds[rows])
        rows = np.flatnonzero(~met)
    if rows.size:
        wanted, normals, bounds = wanted[rows], normals[rows], bounds[rows]
        least = np.maximum(_least_violation(normals, bounds, soft), 0.0)
        # A hair more than the least, so that rounding leaves points to choose from.
        room = least + 10.0 * _TOLERANCE * _scale(bounds)
        relaxed = bounds - room[:, None] * soft
        on_line, met = _projection(wanted, normals, relaxed)
        at_corner, _ = _crossing(wanted, normals, relaxed)
        points[rows] = np.where(met[:, None], on_line, at_corner)
        violation[rows] = least
    return Nearest(points, violation)


def _scale(bounds: FloatArray) -> FloatArray:
    scale: FloatArray = 1.0 + np.max(np.abs(bounds), axis=1)
    return scale


def _projection(
    wanted: FloatArray, normals: FloatArray, bounds: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Project on the line that lacks most, (B, 2), and tell where that meets every bound.

    Where it does it is the answer: no point that meets this one bound is nearer. A projection on a
    line that lacks less never is, as it leaves this bound violated.
    """
    x, y = normals[..., 0], normals[..., 1]
    lack = bounds - x * wanted[:, :1] - y * wanted[:, 1:]
    index = np.arange(len(lack))
    worst = np.argmax(lack, axis=1)
    step = np.maximum(lack[index, worst], 0.0)[:, None] * normals[index, worst]
    left = np.max(lack - x * step[:, :1] - y * step[:, 1:], axis=1)
    return wanted + step, left <= _TOLERANCE * _scale(bounds)


def _crossing(
    wanted: FloatArray, normals: FloatArray, bounds: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the nearest crossing of two lines that meets every bound, (B, 2), and if one does.

    Where none does, the crossing that violates least; where there is none at all, the point wanted.
    """
    x, y = normals[..., 0], normals[..., 1]
    first, second = _pairs(bounds.shape[1])
    if first.size == 0:
        return wanted.copy(), np.zeros(len(wanted), bool)
    cross = x[:, first] * y[:, second] - y[:, first] * x[:, second]
    crossing: BoolArray = np.abs(cross) > _PARALLEL
    over = crossing / np.where(crossing, cross, 1.0)
    one, other = bounds[:, first], bounds[:, second]
    across = (one * y[:, second] - other * y[:, first]) * over
    up = (other * x[:, first] - one * x[:, second]) * over
    value = across[:, :, None] * x[:, None] + up[:, :, None] * y[:, None]
    excess = np.where(crossing, np.max(bounds[:, None] - value, axis=-1), np.inf)
    feasible: BoolArray = excess <= _TOLERANCE * _scale(bounds)[:, None]
    found: BoolArray = np.any(feasible, axis=1)
    distance = (across - wanted[:, :1]) ** 2 + (up - wanted[:, 1:]) ** 2
    cost = np.where(found[:, None], np.where(feasible, distance, np.inf), excess)
    index, best = np.arange(len(cost)), np.argmin(cost, axis=1)
    points = np.stack([across[index, best], up[index, best]], axis=-1)
    any_crossing: BoolArray = np.any(crossing, axis=1)
    return np.where(any_crossing[:, None], points, wanted), found


def _least_violation(normals: FloatArray, bounds: FloatArray, soft: FloatArray) -> FloatArray:
    """Return min t such that n'a >= b - soft t for some a, shape (B,).

    By duality it is max m'b over multipliers m >= 0 with sum m n = 0 and sum m soft = 1. Of three
    normals, each has the cross product of the other two as its multiplier, up to scale.
    """
    rows = len(bounds)
    normals = np.concatenate([normals, np.broadcast_to(np.eye(2), (rows, 2, 2))], axis=1)
    bounds = np.concatenate([bounds, np.full((rows, 2), _FAR)], axis=1)
    soft = np.concatenate([soft, np.zeros(2)])
    x, y = normals[..., 0], normals[..., 1]
    triples = _triples(bounds.shape[1])
    others = ((triples[1], triples[2]), (triples[2], triples[0]), (triples[0], triples[1]))
    multipliers = np.stack([x[:, i] * y[:, j] - y[:, i] * x[:, j] for i, j in others])
    total = np.sum(multipliers * soft[triples][:, None], axis=0)
    usable = np.abs(total) > _PARALLEL
    multipliers = multipliers / np.where(usable, total, 1.0)
    usable &= np.all(multipliers >= -_PARALLEL, axis=0)
    # A multiplier that is zero but for rounding must not meet the far bound.
    multipliers = np.where(multipliers > _PARALLEL, multipliers, 0.0)
    value = np.sum(multipliers * bounds[:, triples].transpose(1, 0, 2), axis=0)
    least: FloatArray = np.max(np.where(usable, value, -np.inf), axis=1)
    return least


@lru_cache(maxsize=64)
def _pairs(count: int) -> tuple[IntArray, IntArray]:
    first, second = np.triu_indices(count, 1)
    return first, second


@lru_cache(maxsize=64)
def _triples(count: int) -> IntArray:
    """Return all triples of indices below the count, shape (3, triples)."""
    return np.array(list(combinations(range(count), 3)), np.intp).reshape(-1, 3).T
