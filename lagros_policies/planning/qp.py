"""Sparse quadratic programs: PIQP, and Clarabel where PIQP gives up.

Both solve min z'Pz/2 + c'z subject to Az = b and low <= z <= high. Which solver stands first was
measured; see `benchmarks/speed/programs.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import clarabel  # at once: a fallback that is missing must not show in the middle of an episode
import numpy as np
import piqp
from numpy.typing import NDArray
from scipy import sparse

FloatArray = NDArray[np.float64]

# Bounds at least this large are taken for absent by both solvers.
UNBOUNDED = 1e30


@dataclass(frozen=True)
class QuadraticProgram:
    """A convex program with a diagonal cost, sparse equalities and bounds.

    Attributes:
        cost_diagonal: Diagonal of P, shape (z,).
        cost_linear: c, shape (z,).
        equality: A, shape (rows, z), compressed columns.
        target: b, shape (rows,).
        low: Lower bounds, shape (z,); -UNBOUNDED for none.
        high: Upper bounds, shape (z,); UNBOUNDED for none.
    """

    cost_diagonal: FloatArray
    cost_linear: FloatArray
    equality: sparse.csc_matrix
    target: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class QpSolution:
    """What a solver answered.

    Attributes:
        values: z, shape (z,); meaningless unless solved.
        solved: Whether the solver met its tolerance.
        status: The solver's own word, with the solver's name.
    """

    values: FloatArray
    solved: bool
    status: str


def solve_qp(program: QuadraticProgram, tolerance: float) -> QpSolution:
    """Solve with PIQP, and with Clarabel if PIQP does not reach the tolerance."""
    solution = solve_with_piqp(program, tolerance)
    return solution if solution.solved else solve_with_clarabel(program, tolerance)


def solve_with_piqp(program: QuadraticProgram, tolerance: float) -> QpSolution:
    """Solve with PIQP (proximal interior point)."""
    size = program.cost_diagonal.size
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = tolerance
    solver.settings.eps_rel = tolerance
    # The primal and dual residuals are what the plan needs; the gap costs an iteration.
    solver.settings.check_duality_gap = False
    diagonal = sparse.csc_matrix(
        (program.cost_diagonal, np.arange(size), np.arange(size + 1)), shape=(size, size)
    )
    solver.setup(
        diagonal,
        program.cost_linear,
        program.equality,
        program.target,
        None,
        None,
        None,
        program.low,
        program.high,
    )
    status = solver.solve()
    values = np.array(solver.result.x)
    solved = status == piqp.PIQP_SOLVED and bool(np.all(np.isfinite(values)))
    return QpSolution(values, solved, f"PIQP: {status.name}")


def solve_with_clarabel(program: QuadraticProgram, tolerance: float) -> QpSolution:
    """Solve with Clarabel (interior point, homogeneous embedding): slower, hard to upset."""
    size = program.cost_diagonal.size
    above = np.flatnonzero(program.high < UNBOUNDED)
    below = np.flatnonzero(program.low > -UNBOUNDED)
    identity = sparse.eye(size, format="csc")
    rows = sparse.vstack([program.equality, identity[above], -identity[below]], format="csc")
    target = np.concatenate([program.target, program.high[above], -program.low[below]])
    cones = [
        clarabel.ZeroConeT(program.target.size),
        clarabel.NonnegativeConeT(above.size + below.size),
    ]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = tolerance
    diagonal = sparse.diags(program.cost_diagonal, format="csc")
    solver = clarabel.DefaultSolver(diagonal, program.cost_linear, rows, target, cones, settings)
    answer = solver.solve()
    values = np.array(answer.x)
    solved = answer.status == clarabel.SolverStatus.Solved and bool(np.all(np.isfinite(values)))
    return QpSolution(values, solved, f"Clarabel: {answer.status}")
