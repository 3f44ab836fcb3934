"""Half-planes by general solvers, to hold `half_planes` and what uses it against."""

import numpy as np
import osqp
from scipy import sparse
from scipy.optimize import linprog


def least_violation_by_program(normals, bounds, soft):
    """Return min t with n'a + soft t >= b, by a general solver."""
    answer = linprog(
        [0.0, 0.0, 1.0],
        A_ub=-np.column_stack([normals, soft]),
        b_ub=-bounds,
        bounds=[(None, None), (None, None), (0.0, None)],
    )
    assert answer.status == 0
    return answer.fun


def nearest_by_program(wanted, normals, bounds):
    """Return the nearest point by OSQP."""
    solver = osqp.OSQP()
    solver.setup(
        sparse.eye(2, format="csc"),
        -wanted,
        sparse.csc_matrix(normals),
        bounds,
        np.full(len(bounds), np.inf),
        verbose=False,
        eps_abs=1e-9,
        eps_rel=1e-9,
        max_iter=100_000,
    )
    return solver.solve(raise_error=True).x
