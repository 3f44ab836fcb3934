"""The solvers of the quadratic programs against each other and the conditions of optimality."""

import sys
from typing import get_args

import numpy as np
import pytest
from scipy import sparse

from lagros_policies.planning import qp
from lagros_policies.planning.qp import (
    UNBOUNDED,
    QpSolver,
    QuadraticProgram,
    solve_qp,
    solve_with_clarabel,
    solve_with_osqp,
    solve_with_piqp,
)

SOLVERS = [
    pytest.param(solve_with_piqp, id="PIQP"),
    pytest.param(solve_with_clarabel, id="Clarabel"),
    pytest.param(solve_with_osqp, id="OSQP"),
]
NAMES = {"piqp": "PIQP", "clarabel": "Clarabel", "osqp": "OSQP"}


def random_program(seed, size=30, rows=12):
    """Return a feasible program: some bounds bind, some are absent, one pins its unknown."""
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((rows, size)) * (rng.random((rows, size)) < 0.4)
    inside = rng.uniform(-1.0, 1.0, size)
    low = inside - rng.uniform(0.0, 0.5, size)
    high = inside + rng.uniform(0.0, 0.5, size)
    low[rng.random(size) < 0.3] = -UNBOUNDED
    high[rng.random(size) < 0.3] = UNBOUNDED
    low[0] = high[0] = inside[0]
    return QuadraticProgram(
        cost_diagonal=rng.uniform(0.1, 3.0, size),
        cost_linear=3.0 * rng.standard_normal(size),
        equality=sparse.csc_matrix(matrix),
        target=matrix @ inside,
        low=low,
        high=high,
    )


def kkt_residual(program, values):
    """Return how far the gradient is from the cone of the active constraints at the values."""
    gradient = program.cost_diagonal * values + program.cost_linear
    at_low = values - program.low < 1e-5
    at_high = program.high - values < 1e-5
    free = ~(at_low | at_high)
    matrix = program.equality.toarray()
    # Multipliers of the rows from the unknowns that are free, then the signs at the bounds.
    multiplier = np.linalg.lstsq(matrix.T[free], -gradient[free], rcond=None)[0]
    reduced = gradient + matrix.T @ multiplier
    residual = np.abs(reduced[free]).max(initial=0.0)
    residual = max(residual, np.maximum(-reduced[at_low & ~at_high], 0.0).max(initial=0.0))
    return max(residual, np.maximum(reduced[at_high & ~at_low], 0.0).max(initial=0.0))


@pytest.mark.parametrize("seed", range(12))
def test_all_solvers_find_the_same_optimum(seed):
    program = random_program(seed)
    answers = [solver.values[0](program, 1e-9) for solver in SOLVERS]
    for answer in answers:
        assert answer.solved, answer.status
        values = answer.values
        assert program.equality @ values == pytest.approx(program.target, abs=1e-6)
        assert np.all(values >= program.low - 1e-6)
        assert np.all(values <= program.high + 1e-6)
        assert kkt_residual(program, values) < 1e-3
    # PIQP is asked for its residuals and not for the gap: its optimum is less exact than they are.
    for answer in answers:
        assert answer.values == pytest.approx(answers[1].values, abs=1e-3)


@pytest.mark.parametrize("name", get_args(QpSolver))
def test_a_solver_is_asked_by_its_name(name):
    program = random_program(2)
    answer = solve_qp(program, 1e-9, name)
    assert answer.status.startswith(NAMES[name])
    assert answer.values == pytest.approx(solve_qp(program, 1e-9).values, abs=1e-3)


def test_a_solver_that_is_not_known_is_refused():
    with pytest.raises(ValueError, match=r"solver='pipq' must be one of .* Did you mean 'piqp'"):
        solve_qp(random_program(0), 1e-8, "pipq")


def test_a_solver_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "osqp", None)
    with pytest.raises(ImportError, match=r"pip install 'lagros\[train\]'"):
        solve_qp(random_program(0), 1e-8, "osqp")


def infeasible():
    # z_0 = 1, but z_0 >= 2.
    return QuadraticProgram(
        cost_diagonal=np.ones(2),
        cost_linear=np.zeros(2),
        equality=sparse.csc_matrix(np.array([[1.0, 0.0]])),
        target=np.array([1.0]),
        low=np.array([2.0, -UNBOUNDED]),
        high=np.array([3.0, UNBOUNDED]),
    )


@pytest.mark.parametrize("solver", [*SOLVERS, pytest.param(solve_qp, id="both")])
def test_infeasible_program_is_reported_and_not_raised(solver):
    answer = solver(infeasible(), 1e-8)
    assert not answer.solved
    assert "infeasible" in answer.status.lower()


@pytest.mark.parametrize("solver", SOLVERS)
def test_numbers_that_are_not_finite_are_reported(solver):
    program = random_program(0)
    program.cost_linear[3] = np.nan
    assert not solver(program, 1e-8).solved


@pytest.mark.parametrize("name", ["piqp", "osqp"])
def test_clarabel_answers_where_another_gives_up(monkeypatch, name):
    program = random_program(1)
    sound = solve_qp(program, 1e-9)
    failed = qp.QpSolution(np.full(30, np.nan), False, "gave up")
    monkeypatch.setitem(qp.SOLVERS, name, lambda program, tolerance: failed)
    answer = solve_qp(program, 1e-9, name)
    assert answer.solved
    assert answer.status.startswith("Clarabel")
    assert answer.values == pytest.approx(sound.values, abs=1e-3)
