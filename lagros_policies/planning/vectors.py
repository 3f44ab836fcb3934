"""Lengths, directions and distances of many plane vectors."""

from __future__ import annotations

import numpy as np

from lagros_envs.arrays import FloatArray


def lengths(vectors: FloatArray) -> FloatArray:
    """Return the lengths (...) of vectors (..., 2); several times as fast as NumPy's norm."""
    x, y = vectors[..., 0], vectors[..., 1]
    value: FloatArray = np.sqrt(x * x + y * y)
    return value


def unit_vectors(vectors: FloatArray, length: FloatArray) -> FloatArray:
    """Return unit vectors (r, 2) for vectors (r, 2) of lengths (r,); (0, 1) for vanishing ones."""
    small = length < 1e-9
    unit: FloatArray = vectors / np.where(small, 1.0, length)[:, None]
    unit[small] = (0.0, 1.0)
    return unit


def segment_distance(begin: FloatArray, end: FloatArray, points: FloatArray) -> FloatArray:
    """Return the distances from segments to points.

    Args:
        begin: Ends of the segments, shape (..., 2).
        end: Other ends, shape (..., 2).
        points: Shape (m, 2).

    Returns:
        Shape (..., m).
    """
    along = (end - begin)[..., None, :]
    delta = points - begin[..., None, :]
    length = np.sum(along * along, axis=-1)
    share = np.sum(delta * along, axis=-1) / np.where(length > 0.0, length, 1.0)
    nearest = delta - np.clip(share, 0.0, 1.0)[..., None] * along
    value: FloatArray = np.linalg.norm(nearest, axis=-1)
    return value
