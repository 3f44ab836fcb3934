"""What is decided of matrices of intervals: products and definiteness."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lagros_envs.arrays import BoolArray
from lagros_envs.numbers import Interval
from lagros_envs.numbers.interval import ordered

# What rounding may add to an entry of a product of three 4 by 4 matrices, relative to the product
# of their magnitudes: it is below 16 units, of 1.1e-16 each.
_PRODUCT_ERROR = 64 * 2.0**-52
# The sums and products of the test itself; a bound this near to failing counts as failed.
_SLACK = 1e-9


def matmul(left: Interval, right: Interval) -> Interval:
    """Enclose the matrix products of (..., i, j) and (..., j, k), shape (..., i, k)."""
    total = left[..., :, 0, None] * right[..., 0, None, :]
    for index in range(1, left.shape[-1]):
        total = total + left[..., :, index, None] * right[..., index, None, :]
    return total


def transpose(matrix: Interval) -> Interval:
    """Return the transposes of matrices (..., i, j), shape (..., j, i)."""
    return ordered(np.swapaxes(matrix.lower, -1, -2), np.swapaxes(matrix.upper, -1, -2))


def negative_definite(matrices: Interval, added: Sequence[Interval] = ()) -> BoolArray:
    """Return which interval matrices (..., n, n) hold only negative definite symmetric ones.

    With Q from the eigenvectors of the midpoint, Q' F Q is near -I: Q' F Q = -I + E, |E| <= R. It
    is negative definite if the spectral radius of R is below one, for which R d < d with some
    d > 0 suffices; and then Q is regular and F is negative definite.

    Args:
        matrices: The matrices, shape (..., n, n).
        added: Further symmetric matrices, which broadcast against these: any multiples of their
            members by numbers from -1 to 1 may be added to the members of `matrices`.

    Returns:
        Whether that is shown, shape (...).
    """
    middle = matrices.midpoint
    middle = 0.5 * (middle + np.swapaxes(middle, -1, -2))
    usable = np.all(np.isfinite(middle), axis=(-1, -2))
    values, vectors = np.linalg.eigh(np.where(usable[..., None, None], middle, 0.0))
    usable &= values[..., -1] < 0.0
    size = np.where(values < 0.0, -values, 1.0)
    basis = vectors / np.sqrt(size)[..., None, :]
    turned = np.swapaxes(basis, -1, -2)
    # The radius is taken about this midpoint, whatever rounding made of it.
    reach = np.maximum(matrices.upper - middle, middle - matrices.lower)
    reach = np.maximum(reach, np.swapaxes(reach, -1, -2)) * (1.0 + _SLACK)
    reach = reach + _PRODUCT_ERROR * np.abs(middle)
    error = np.abs(turned @ middle @ basis + np.eye(middle.shape[-1]))
    for part in added:
        centre, radius = part.midpoint, part.radius
        error = error + np.abs(turned @ centre @ basis)
        reach = reach + radius * (1.0 + _SLACK) + _PRODUCT_ERROR * np.abs(centre)
    error = error + np.abs(turned) @ reach @ np.abs(basis)
    # What is not symmetric by rounding alone may count on either side.
    error = np.maximum(error, np.swapaxes(error, -1, -2))
    weight = np.ones(error.shape[:-1])
    for _ in range(4):
        weight = np.einsum("...ij,...j->...i", error, weight) + 1e-3 * weight
        weight /= weight.max(axis=-1, keepdims=True)
    bound = np.einsum("...ij,...j->...i", error, weight)
    proved: BoolArray = usable & np.all(bound < weight * (1.0 - _SLACK), axis=-1)
    return proved
