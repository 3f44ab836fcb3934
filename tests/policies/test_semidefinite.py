"""Symmetric matrices as vectors, held against traces; programs, against closed forms."""

import numpy as np
import pytest

from lagros_policies.contraction.semidefinite import (
    cone_rows,
    solve_cones,
    svec,
    symmetric_basis,
)


def symmetric(rng, *shape):
    parts = rng.normal(size=shape)
    return parts + np.swapaxes(parts, -1, -2)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_dot_product_of_vectors_is_the_trace_of_matrices(n):
    rng = np.random.default_rng(n)
    first, second = symmetric(rng, 5, n, n), symmetric(rng, 5, n, n)
    traces = np.trace(first @ second, axis1=1, axis2=2)
    assert np.sum(svec(first) * svec(second), axis=-1) == pytest.approx(traces)


@pytest.mark.parametrize("n", [1, 3])
def test_every_symmetric_matrix_is_one_sum_over_the_basis(n):
    matrix = symmetric(np.random.default_rng(0), n, n)
    basis = symmetric_basis(n)
    assert len(basis) == n * (n + 1) // 2
    upper = [matrix[i, j] for j in range(n) for i in range(j + 1)]
    assert np.tensordot(upper, basis, axes=1) == pytest.approx(matrix)


def test_rows_give_the_vector_of_the_combined_matrix():
    rng = np.random.default_rng(1)
    cones, powers, n = 3, 2, 4
    by_dual = symmetric(rng, cones, powers, 10, n, n)
    by_weight = symmetric(rng, cones, n, n)
    rows = cone_rows(by_dual, by_weight, None)
    entries, nu, chi = rng.normal(size=(powers, 10)), 0.7, 5.0
    expected = np.einsum("kpeab,pe->kab", by_dual, entries) + nu * by_weight
    assert rows @ [*entries.ravel(), nu, chi] == pytest.approx(svec(expected).ravel())


@pytest.mark.parametrize("n", [2, 4])
def test_the_least_bound_of_a_matrix_is_its_largest_eigenvalue(n):
    matrix = symmetric(np.random.default_rng(2), n, n)
    values, status = solve_cones(np.ones(1), [-svec(np.eye(n))[:, None]], [-svec(matrix)], n)
    assert status == "Solved"
    assert values[0] == pytest.approx(np.linalg.eigvalsh(matrix)[-1], abs=1e-6)


def test_what_has_no_solution_has_no_values():
    # x >= 1 and -x >= 1.
    rows = np.array([[-1.0], [1.0]])
    values, status = solve_cones(np.ones(1), [rows], [np.full(2, -1.0)], 1)
    assert values is None
    assert "Infeasible" in status
