"""Semidefinite programs in the form that Clarabel takes: symmetric matrices as vectors, cones.

A symmetric n by n matrix is named by its n(n+1)/2 entries on and above the diagonal, by columns.
`symmetric_basis` gives the matrix of each entry; `svec` the vector of a matrix whose dot product is
the trace, sum_ij A_ij B_ij: off-diagonals times sqrt(2) (Boyd and Vandenberghe 2004, section 2.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import sparse

from lagros_envs.arrays import FloatArray


def symmetric_basis(n: int) -> FloatArray:
    """Return the symmetric matrices with ones at (i, j) and (j, i), shape (n(n+1)/2, n, n)."""
    places = [(i, j) for j in range(n) for i in range(j + 1)]
    matrices = np.zeros((len(places), n, n))
    for index, (i, j) in enumerate(places):
        matrices[index, i, j] = matrices[index, j, i] = 1.0
    return matrices


def svec(matrices: FloatArray) -> FloatArray:
    """Return symmetric matrices (..., n, n) as vectors (..., n(n+1)/2) in the order of the cone."""
    n = matrices.shape[-1]
    rows = np.concatenate([np.arange(j + 1) for j in range(n)])
    columns = np.concatenate([np.full(j + 1, j) for j in range(n)])
    weight = np.where(rows == columns, 1.0, math.sqrt(2.0))
    stacked: FloatArray = matrices[..., rows, columns] * weight
    return stacked


def cone_rows(
    by_dual: FloatArray, by_weight: FloatArray | None, by_condition: FloatArray | None
) -> FloatArray:
    """Return the rows of one family of cones: columns for every W_ij, then nu, then chi.

    Args:
        by_dual: Derivatives of each cone's matrix by the entries of each W_i, shape
            (cones, degree + 1, n(n+1)/2, n, n).
        by_weight: Derivatives by nu, shape (cones, n, n); None for zero.
        by_condition: Derivatives by chi, shape (cones, n, n); None for zero.

    Returns:
        Rows, shape (cones n(n+1)/2, (degree + 1) n(n+1)/2 + 2).
    """
    count = len(by_dual)
    dual = svec(by_dual)
    height = dual.shape[-1]
    dual = np.moveaxis(dual, -1, 1).reshape(count * height, -1)
    zero = np.zeros((count * height, 1))
    weight = zero if by_weight is None else svec(by_weight).reshape(-1, 1)
    condition = zero if by_condition is None else svec(by_condition).reshape(-1, 1)
    return np.hstack([dual, weight, condition])


def solve_cones(
    cost: FloatArray,
    blocks: Sequence[FloatArray],
    rights: Sequence[FloatArray],
    n: int,
    tolerance: float | None = None,
) -> tuple[FloatArray | None, str]:
    """Solve `solve_conic`'s program with semidefinite cones alone, all of n by n matrices."""
    import clarabel

    cones = sum(map(len, rights)) // (n * (n + 1) // 2)
    return solve_conic(cost, blocks, rights, [clarabel.PSDTriangleConeT(n)] * cones, tolerance)


def solve_conic(
    cost: FloatArray,
    blocks: Sequence[FloatArray],
    rights: Sequence[FloatArray],
    cones: Sequence[Any],
    tolerance: float | None = None,
) -> tuple[FloatArray | None, str]:
    """Minimise cost'z subject to right - rows z in a product of cones, by Clarabel in one thread.

    An almost solved program counts as solved: every metric and every tube is checked afterwards.

    Args:
        cost: Shape (z,).
        blocks: The rows, above each other, each of shape (r, z).
        rights: The right side, likewise, each of shape (r,).
        cones: Clarabel's, in the order of the rows.
        tolerance: Of the gap; None for the solver's own.

    Returns:
        z, shape (z,), or None where it was not found, and the solver's status.
    """
    import clarabel

    settings: Any = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    if tolerance is not None:
        settings.tol_gap_abs = settings.tol_gap_rel = tolerance
    quadratic = sparse.csc_matrix((cost.size, cost.size))
    rows, right = sparse.csc_matrix(np.vstack(blocks)), np.concatenate(rights)
    answer = clarabel.DefaultSolver(quadratic, cost, rows, right, cones, settings).solve()
    status = str(answer.status)
    return (np.array(answer.x) if status in ("Solved", "AlmostSolved") else None), status
