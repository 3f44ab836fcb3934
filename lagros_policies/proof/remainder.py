"""Bounds of quadratic and cubic forms over the unit ball, with what is linear in them taken out.

A form of one sign has a middle, and a cubic follows a line: y^3 lies within 1/4 of 3/4 y. Only what
is left after middle and line counts as a remainder of a linear error.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.proof.error_set import WIDER

# Eigenvalues, rotations and sums of a few hundred products, relative to the norm of a form.
_ROUNDING = 1e-12
# Room for the rounding of a sum of balls, which the ellipsoid of a domain has as well.
_ROOM = 1e-8
# Ellipsoids that are turned one after the other.
_PASSES = 3
# Of the mean weight, what a ball across the direction of an ellipsoid keeps at least.
_SHARE = 0.01
# Slices of the ball along one coordinate, and halvings of the slope of the line.
_SLICES = 48
_HALVINGS = 7


def quadratic_forms(parts: FloatArray, members: Sequence[tuple[int, ...]], size: int) -> FloatArray:
    """Return symmetric matrices H (..., size, size), of coefficients (..., k) of k monomials."""
    forms = np.zeros((*parts.shape[:-1], size, size))
    for place, (i, j) in enumerate(members):
        forms[..., i, j] += 0.5 * parts[..., place]
        forms[..., j, i] += 0.5 * parts[..., place]
    return forms


def cubic_forms(parts: FloatArray, members: Sequence[tuple[int, ...]], size: int) -> FloatArray:
    """Return symmetric tensors T (..., size, size, size), of coefficients (..., k)."""
    forms = np.zeros((*parts.shape[:-1], size, size, size))
    for place, row in enumerate(members):
        orders = set(itertools.permutations(row))
        for i, j, k in orders:
            forms[..., i, j, k] = parts[..., place] / len(orders)
    return forms


def quadratic_range(forms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Enclose y'H y over ||y|| <= 1.

    Args:
        forms: H, symmetric, shape (..., r, r).

    Returns:
        Middle and radius of the range, each (...).
    """
    values = np.linalg.eigvalsh(forms)
    slack = _ROUNDING * np.sqrt((forms * forms).sum(axis=(-1, -2)))
    low = np.minimum(values[..., 0], 0.0) - slack
    high = np.maximum(values[..., -1], 0.0) + slack
    return 0.5 * (low + high), 0.5 * (high - low) * WIDER


def narrower_range(
    forms: FloatArray, middle: FloatArray, radius: FloatArray, blocks: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Enclose y'H y over a sum of balls and segments inside ||y|| <= 1 more closely.

    Around the sum lie many ellipsoids {y: |l'y|^2 <= l'P l}, P = (sum_j w_j) sum_j G_j G_j' / w_j;
    for each end of the range one is turned to where the form is largest in the last one.

    Args:
        forms: H, symmetric, shape (p, k, r, r).
        middle: Of the range over the ball, shape (p, k).
        radius: Likewise.
        blocks: G_j G_j' of each ball and segment, shape (p, j, r, r).

    Returns:
        Middle and radius of the range, each (p, k).
    """
    flat = blocks.reshape(*blocks.shape[:2], -1)
    slack = _ROOM * np.sqrt((forms * forms).sum(axis=(-1, -2)))
    ends = []
    for side, known in ((forms, middle + radius), (-forms, radius - middle)):
        lengths = np.trace(blocks, axis1=-2, axis2=-1)[:, None]
        for _ in range(_PASSES):
            root, spread = _turned(flat, lengths)
            values, vectors = np.linalg.eigh(np.swapaxes(root, -1, -2) @ side @ root)
            known = np.minimum(known, np.maximum(values[..., -1], 0.0) + slack * spread)
            # The longest y is supported along P^-1 y.
            lengths = _lengths(flat, np.linalg.solve(np.swapaxes(root, -1, -2), vectors[..., -1:]))
        ends.append(known)
    high, low = ends
    return 0.5 * (high - low), 0.5 * (high + low) * WIDER


def narrower_lines(
    forms: FloatArray, lines: FloatArray, left: FloatArray, blocks: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Enclose T[y, y, y] over a sum of balls and segments inside ||y|| <= 1 more closely by lines.

    Args:
        forms: T, symmetric, shape (p, k, r, r, r).
        lines: a of lines over the ball, shape (p, k, r).
        left: b of these, shape (p, k).
        blocks: As in `narrower_range`.

    Returns:
        a and b of the narrower ones.
    """
    flat = blocks.reshape(*blocks.shape[:2], -1)
    wide = forms.reshape(*forms.shape[:-2], -1)
    _, vectors = np.linalg.eigh(wide @ np.swapaxes(wide, -1, -2))
    root, spread = _turned(flat, _lengths(flat, vectors[..., -1:]))
    turned = np.einsum("pkabc,pkcf->pkabf", forms, root)
    turned = np.einsum("pkabf,pkbe->pkaef", turned, root)
    turned = np.einsum("pkaef,pkad->pkdef", turned, root)
    slopes, found = cubic_lines(turned)
    found = found + _ROOM * spread * np.sqrt((forms * forms).sum(axis=(-1, -2, -3)) * spread)
    back = np.linalg.solve(np.swapaxes(root, -1, -2), slopes[..., None])[..., 0]
    better = found < left
    return np.where(better[..., None], back, lines), np.where(better, found, left)


def _turned(flat: FloatArray, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a root of P for squared lengths of blocks (p, k, j), and one and the trace of P."""
    size = math.isqrt(flat.shape[-1])
    weights = np.sqrt(np.maximum(lengths, 0.0))
    weights = weights + (_SHARE / flat.shape[1]) * weights.sum(axis=-1, keepdims=True) + 1e-100
    shape = (1.0 / weights) @ flat * weights.sum(axis=-1, keepdims=True)
    shape = shape.reshape(*shape.shape[:2], size, size) + _ROOM * np.eye(size)
    return np.linalg.cholesky(shape), 1.0 + np.trace(shape, axis1=-2, axis2=-1)


def _lengths(flat: FloatArray, along: FloatArray) -> FloatArray:
    """Return l'G_j G_j'l for directions l (p, k, r, 1), shape (p, k, j)."""
    pairs = along * np.swapaxes(along, -1, -2)
    lengths: FloatArray = pairs.reshape(*pairs.shape[:2], -1) @ np.swapaxes(flat, -1, -2)
    return lengths


def cubic_lines(forms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Enclose T[y, y, y] over ||y|| <= 1 by lines: |T[y, y, y] - a'y| <= b.

    In coordinates that follow the largest slopes the form is sum_i y_i q_i(y), q_i of y_i and those
    after it; each q_i is bounded by y_i, for a slope a_i that leaves least of y_i (q_i - a_i).

    Args:
        forms: T, symmetric, shape (..., r, r, r).

    Returns:
        a, shape (..., r), and b, shape (...).
    """
    size = forms.shape[-1]
    flat = forms.reshape(*forms.shape[:-2], -1)
    _, vectors = np.linalg.eigh(flat @ np.swapaxes(flat, -1, -2))
    # From the largest to the smallest.
    turn = vectors[..., ::-1]
    turned = np.einsum("...abc,...ck->...abk", forms, turn)
    turned = np.einsum("...abk,...bj->...ajk", turned, turn)
    turned = np.einsum("...ajk,...ai->...ijk", turned, turn)
    slopes = np.zeros(forms.shape[:-2])
    left = _ROUNDING * np.sqrt((forms * forms).sum(axis=(-1, -2, -3)))
    for first in range(size):
        rest = turned[..., first:, first:, first:]
        slopes[..., first], more = _one_line(rest)
        left = left + more
    return np.einsum("...ij,...j->...i", turn, slopes), left * WIDER


def _one_line(form: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Enclose the part t q(y) of a form that has its first coordinate t: |t q - a t| <= b."""
    own = form[..., 0, 0, 0]
    mixed = 3.0 * np.sqrt((form[..., 0, 0, 1:] ** 2).sum(axis=-1))
    low, high = np.zeros((2, *own.shape))
    if form.shape[-1] > 1:
        values = np.linalg.eigvalsh(3.0 * form[..., 0, 1:, 1:])
        low, high = np.minimum(values[..., 0], 0.0), np.maximum(values[..., -1], 0.0)
    # Slices in t^2, so that t sqrt(1 - t^2) is resolved at both ends.
    ends = np.sin(np.linspace(0.0, 0.5 * np.pi, _SLICES + 1))
    ends[0], ends[-1] = 0.0, 1.0
    near, far = (part.reshape(-1, *[1] * own.ndim) for part in (ends[:-1], ends[1:]))
    around = 1.0 - near * near
    square = (
        np.where(own >= 0.0, far * far, near * near),
        np.where(own >= 0.0, near * near, far * far),
    )
    cross = mixed * far * np.sqrt(around)
    above = own * square[0] + cross + high * around
    below = own * square[1] - cross + low * around
    # What is left above the line falls with its slope, what is left below rises.
    least, most = below.min(axis=0), above.max(axis=0)
    for _ in range(_HALVINGS):
        slope = 0.5 * (least + most)
        over, under = (far * (above - slope)).max(axis=0), (far * (slope - below)).max(axis=0)
        least, most = np.where(over > under, slope, least), np.where(over > under, most, slope)
    return slope, np.maximum(np.maximum(over, under), 0.0)
