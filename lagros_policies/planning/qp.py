"""Sparse quadratic programs, by the solver of one's choice, and Clarabel where that gives up.

All solve min z'Pz/2 + c'z subject to Az = b and low <= z <= high. Which solver stands first was
measured; see `benchmarks/speed/programs.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import clarabel  # at once: a fallback that is missing must not show in the middle of an episode
import numpy as np
import piqp
from scipy import sparse

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_name

QpSolver = Literal["piqp", "clarabel", "osqp"]

# Bounds at least this large are taken for absent by both solvers.
UNBOUNDED = 1e30
# A first-order method needs thousands where interior points need a dozen.
_MOST_OSQP_ITERATIONS = 50_000


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


def solve_qp(program: QuadraticProgram, tolerance: float, solver: QpSolver = "piqp") -> QpSolution:
    """Solve with a solver by name, and with Clarabel if that does not reach the tolerance.

    Args:
        program: The program.
        tolerance: Residual that counts as none.
        solver: "piqp", "clarabel" or "osqp".

    Raises:
        ValueError: There is no such solver.
        ImportError: OSQP is asked for and not installed.
    """
    if solver not in SOLVERS:
        check_name("solver", solver, SOLVERS)
    solution = SOLVERS[solver](program, tolerance)
    if solution.solved or solver == "clarabel":
        return solution
    return solve_with_clarabel(program, tolerance)


def solve_with_piqp(program: QuadraticProgram, tolerance: float) -> QpSolution:
    """Solve with PIQP (proximal interior point)."""
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = tolerance
    solver.settings.eps_rel = tolerance
    # The primal and dual residuals are what the plan needs; the gap costs an iteration.
    solver.settings.check_duality_gap = False
    solver.setup(
        _diagonal(program),
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


def solve_with_osqp(program: QuadraticProgram, tolerance: float) -> QpSolution:
    """Solve with OSQP (operator splitting, first order): cheap where little precision is asked.

    Raises:
        ImportError: OSQP is not installed.
    """
    return read_osqp(osqp_solver(program, *osqp_rows(program), tolerance))


SOLVERS: dict[QpSolver, Callable[[QuadraticProgram, float], QpSolution]] = {
    "piqp": solve_with_piqp,
    "clarabel": solve_with_clarabel,
    "osqp": solve_with_osqp,
}


def osqp_rows(program: QuadraticProgram) -> tuple[sparse.csc_matrix, FloatArray, FloatArray]:
    """Return equalities and bounds as rows with a lower and an upper limit."""
    bounded = np.flatnonzero((program.low > -UNBOUNDED) | (program.high < UNBOUNDED))
    identity = sparse.eye(program.cost_diagonal.size, format="csc")
    rows = sparse.vstack([program.equality, identity[bounded]], format="csc")
    low = np.concatenate([program.target, program.low[bounded]])
    return rows, low, np.concatenate([program.target, program.high[bounded]])


def osqp_solver(
    program: QuadraticProgram,
    rows: sparse.csc_matrix,
    low: FloatArray,
    high: FloatArray,
    tolerance: float,
) -> Any:
    """Return OSQP, set up for a program with the rows of `osqp_rows`.

    Raises:
        ImportError: OSQP is not installed.
    """
    try:
        import osqp
    except ImportError as error:
        raise ImportError(
            "the solver 'osqp' is not installed: pip install 'lagros[train]'"
        ) from error
    solver = osqp.OSQP()
    solver.setup(
        _diagonal(program),
        program.cost_linear,
        rows,
        low,
        high,
        eps_abs=tolerance,
        eps_rel=tolerance,
        max_iter=_MOST_OSQP_ITERATIONS,
        verbose=False,
    )
    return solver


def read_osqp(solver: Any) -> QpSolution:
    """Run OSQP and return its answer."""
    result = solver.solve(raise_error=False)
    values = np.array(result.x)
    solved = result.info.status == "solved" and bool(np.all(np.isfinite(values)))
    return QpSolution(values, solved, f"OSQP: {result.info.status}")


def _diagonal(program: QuadraticProgram) -> sparse.csc_matrix:
    size = program.cost_diagonal.size
    return sparse.csc_matrix(
        (program.cost_diagonal, np.arange(size), np.arange(size + 1)), shape=(size, size)
    )
