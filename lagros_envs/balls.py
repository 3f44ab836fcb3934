"""Vectors within a ball or on a sphere, whatever their size."""

from __future__ import annotations

import numpy as np

from lagros_envs.arrays import FloatArray

# Rounding must not carry a vector of norm one over the bound.
INSIDE = 1.0 - 4.0 * np.finfo(np.float64).eps


def _rays(vectors: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return largest entry, vector over it and norm of that, which can neither over- nor underflow.

    Args:
        vectors: Shape (..., n).

    Returns:
        Shapes (..., 1), (..., n) and (..., 1); ones in place of the norm of a zero vector.
    """
    largest = np.maximum.reduce(np.abs(vectors), axis=-1, keepdims=True)
    rays: FloatArray = vectors / np.where(largest > 0.0, largest, 1.0)
    # What linalg.norm does, without its overhead.
    lengths = np.sqrt(np.add.reduce(rays * rays, axis=-1, keepdims=True))
    return largest, rays, np.maximum(lengths, 1.0)


def into_ball(vectors: FloatArray, radius: float) -> FloatArray:
    """Shorten the vectors (..., n) that are longer than the radius to the radius."""
    largest, rays, lengths = _rays(vectors)
    limit = (INSIDE * radius) / lengths
    return np.where(largest <= limit, vectors, rays * limit)


def into_unit_ball(vectors: FloatArray) -> FloatArray:
    """Shorten the vectors (..., n) that are longer than one to length one."""
    return into_ball(vectors, 1.0)


def onto_unit_sphere(vectors: FloatArray, fallback: FloatArray) -> FloatArray:
    """Scale the vectors (..., n) to length one; where one is zero take the fallback."""
    largest, rays, lengths = _rays(vectors)
    return np.where(largest > 0.0, rays * (INSIDE / lengths), fallback)
