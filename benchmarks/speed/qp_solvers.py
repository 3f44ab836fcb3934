"""Solvers of one and the same quadratic program, with what `planning/qp.py` could call instead."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import piqp
from numpy.typing import NDArray
from scipy import sparse

from lagros_policies.planning import scp
from lagros_policies.planning.qp import (
    QpSolution,
    QuadraticProgram,
    osqp_rows,
    osqp_solver,
    read_osqp,
    solve_with_clarabel,
    solve_with_osqp,
    solve_with_piqp,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

FloatArray = NDArray[np.float64]
Solver = Callable[[QuadraticProgram], QpSolution]

# The default of ScpSettings.
TOLERANCE = 1e-8


def solvers() -> dict[str, Solver]:
    """Return the candidates by name, the one in use first."""
    return {
        "PIQP (in use)": lambda program: solve_with_piqp(program, TOLERANCE),
        "PIQP, workspace kept": KeptPiqp(),
        "PIQP, multistage": solve_with_multistage,
        "Clarabel": lambda program: solve_with_clarabel(program, TOLERANCE),
        "OSQP 1e-4": lambda program: solve_with_osqp(program, 1e-4),
        "OSQP 1e-6": lambda program: solve_with_osqp(program, 1e-6),
        "OSQP 1e-4, workspace kept": KeptOsqp(1e-4),
        "OSQP 1e-6, workspace kept": KeptOsqp(1e-6),
    }


@contextmanager
def planning_with(solver: Solver) -> Iterator[None]:
    """Let the planner solve its quadratic programs with another solver."""
    original = scp.solve_qp
    scp.solve_qp = lambda program, *_: solver(program)
    try:
        yield
    finally:
        scp.solve_qp = original


class KeptPiqp:
    """PIQP with one workspace per sparsity: setting up is not repeated."""

    def __init__(self) -> None:
        """Begin without a workspace."""
        self._kept: dict[int, Any] = {}

    def __call__(self, program: QuadraticProgram) -> QpSolution:
        """Solve."""
        solver = self._kept.get(program.cost_diagonal.size)
        if solver is None:
            solver = self._kept[program.cost_diagonal.size] = _piqp()
            _set_up(solver, program)
        else:
            solver.update(
                P=_diagonal(program),
                c=program.cost_linear,
                A=program.equality,
                b=program.target,
                x_l=program.low,
                x_u=program.high,
            )
        return _answer(solver)


class KeptOsqp:
    """OSQP with one workspace per sparsity, which also starts from the last solution."""

    def __init__(self, tolerance: float) -> None:
        """Begin without a workspace."""
        self._tolerance = tolerance
        self._kept: dict[int, Any] = {}

    def __call__(self, program: QuadraticProgram) -> QpSolution:
        """Solve."""
        rows, low, high = osqp_rows(program)
        solver = self._kept.get(program.cost_diagonal.size)
        if solver is None:
            solver = osqp_solver(program, rows, low, high, self._tolerance)
            self._kept[program.cost_diagonal.size] = solver
        else:
            solver.update(
                q=program.cost_linear, l=low, u=high, Px=program.cost_diagonal, Ax=rows.data
            )
        return read_osqp(solver)


def solve_with_multistage(program: QuadraticProgram) -> QpSolution:
    """Solve with PIQP's factorisation for problems in stages."""
    solver = _piqp()
    solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    _set_up(solver, program)
    return _answer(solver)


def objective(program: QuadraticProgram, values: FloatArray) -> float:
    """Return z'Pz/2 + c'z."""
    return float(values @ (0.5 * program.cost_diagonal * values + program.cost_linear))


def violation(program: QuadraticProgram, values: FloatArray) -> float:
    """Return the largest violation of an equality or bound."""
    equality = np.max(np.abs(program.equality @ values - program.target))
    bounds = np.max(np.maximum(program.low - values, values - program.high))
    return float(max(equality, bounds, 0.0))


def _diagonal(program: QuadraticProgram) -> sparse.csc_matrix:
    size = program.cost_diagonal.size
    return sparse.csc_matrix(
        (program.cost_diagonal, np.arange(size), np.arange(size + 1)), shape=(size, size)
    )


def _piqp() -> Any:
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = TOLERANCE
    solver.settings.check_duality_gap = False
    return solver


def _set_up(solver: Any, program: QuadraticProgram) -> None:
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


def _answer(solver: Any) -> QpSolution:
    status = solver.solve()
    return QpSolution(np.array(solver.result.x), status == piqp.PIQP_SOLVED, status.name)
