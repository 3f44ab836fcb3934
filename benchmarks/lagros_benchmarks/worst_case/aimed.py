"""Sequences aimed at one direction of the error: the worst of the linearised loop, in closed form.

Along a plan the error of a closed loop obeys e_{k+1} = A_k e_k + E_k d_k, to first order. For
||d_j|| <= d_bar the largest l'e_k is d_bar sum_j ||E_j' A_{j+1..k-1}' l||, and the sequence that
reaches it pushes along each of these vectors (support functions).
"""

from __future__ import annotations

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.balls import onto_unit_sphere

# Rounds that turn the direction of the norm towards where the error can be driven.
_TURNS = 6


def supports(
    by_state: FloatArray, by_push: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how far the linearised error can be driven, and by which pushes.

    Args:
        by_state: A_k of the closed loop, shape (b, N, n, n).
        by_push: E_k, shape (b, N, n, n).
        directions: l, shape (b, q, n).

    Returns:
        The largest l'e per unit of d_bar over all instants, shape (b, q), and d/d_bar that drives
        it there, shape (b, q, N, n).
    """
    count, steps, n, _ = by_state.shape
    asked = directions.shape[1]
    # Row k of the pulls is l at the instant k + 1, carried back to the instant in hand.
    pulls = np.zeros((count, steps, asked, n))
    reached = np.zeros((count, steps, asked))
    for index in range(steps - 1, -1, -1):
        pulls[:, index] = directions
        reached[:, index:] += np.linalg.norm(pulls[:, index:] @ by_push[:, index, None], axis=-1)
        pulls[:, index:] = pulls[:, index:] @ by_state[:, index, None]
    instant = np.argmax(reached, axis=1)
    pull, pushes = np.zeros((count, asked, n)), np.zeros((count, asked, steps, n))
    for index in range(steps - 1, -1, -1):
        pull = np.where((instant == index)[..., None], directions, pull)
        pushes[:, :, index] = pull @ by_push[:, index]
        pull = pull @ by_state[:, index]
    rows, columns = np.ogrid[:count, :asked]
    # What comes after the instant is free.
    return reached[rows, instant, columns], onto_unit_sphere(pushes, np.eye(n)[0])


def aimed_sequences(by_state: FloatArray, by_push: FloatArray) -> FloatArray:
    """Return d/d_bar aimed at every coordinate and at the norm of e, of both signs.

    Args:
        by_state: A_k of the closed loop, shape (b, N, n, n).
        by_push: E_k, shape (b, N, n, n).

    Returns:
        Shape (b, 2 (n + 1), N, n).
    """
    count, _, n, _ = by_state.shape
    pushes = supports(by_state, by_push, np.broadcast_to(np.eye(n), (count, n, n)))[1]
    longest, columns = pushes, np.arange(n)
    for _ in range(_TURNS):
        # ||e|| is largest along the direction in which e itself lies: alternate between the two.
        errors = _driven(by_state, by_push, longest)
        last = np.argmax(np.linalg.norm(errors, axis=-1), axis=-1)
        ends = errors[np.arange(count)[:, None], columns, last]
        reached, longest = supports(by_state, by_push, onto_unit_sphere(ends, np.eye(n)[0]))
    best = longest[np.arange(count), np.argmax(reached, axis=1)]
    found = np.concatenate([pushes, best[:, None]], axis=1)
    return np.concatenate([found, -found], axis=1)


def _driven(by_state: FloatArray, by_push: FloatArray, pushes: FloatArray) -> FloatArray:
    """Return the linear error that pushes (b, q, N, n) drive, of their shape."""
    error = np.zeros((*pushes.shape[:2], pushes.shape[-1]))
    errors = np.empty(pushes.shape)
    for index in range(pushes.shape[2]):
        error = np.einsum("bij,bqj->bqi", by_state[:, index], error)
        error = error + np.einsum("bij,bqj->bqi", by_push[:, index], pushes[:, :, index])
        errors[:, :, index] = error
    return errors
