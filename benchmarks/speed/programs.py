"""The planner's quadratic programs: which solver, alone and in the whole plan; which slopes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lagros_policies.planning import ScpSettings, Trajectory
from lagros_policies.planning.qp import QpSolution, QuadraticProgram, solve_qp, solve_with_clarabel
from lagros_policies.tasks.cartpole.planner import CartPolePlannerSettings
from speed import qp_solvers
from speed.episodes import Bench
from speed.report import Row, Section, timed_row
from speed.timing import Candidate, Times, interleave

# The tolerance of the optimum that the solvers are held against.
_EXACT = 1e-10


def sections(bench: Bench) -> list[Section]:
    """Measure and return the tables."""
    return [_alone(bench), _whole_plans(bench), _slopes(bench)]


def plan_row(label: str, times: Times, reference: Times, exact: Sequence[Trajectory]) -> Row:
    """Return the row of plans: how many are solved, in how many programs, at what effort."""
    plans: list[Trajectory] = times.results
    solved = np.array([plan.solved for plan in plans])
    passes = float(np.mean([plan.iterations for plan in plans]))
    effort = np.array([plan.effort for plan in plans])
    gap = np.abs(effort / np.array([plan.effort for plan in exact]) - 1.0)
    worst = float(np.max(gap[solved], initial=0.0))
    return timed_row(
        label,
        times,
        reference,
        f"{solved.sum()}/{solved.size}, {passes:.1f} QPs, ±{worst:.0e}",
        solved=int(solved.sum()),
        programs_mean=passes,
        effort_gap_max=worst,
    )


def _alone(bench: Bench) -> Section:
    programs = _collect(bench)
    times = interleave(
        {name: _solving(solver, programs) for name, solver in qp_solvers.solvers().items()},
        len(programs),
    )
    exact = [solve_with_clarabel(program, _EXACT).values for program in programs]
    reference = next(iter(times.values()))
    rows = []
    for name, taken in times.items():
        values = [answer.values for answer in taken.results]
        residual = max(qp_solvers.violation(p, z) for p, z in zip(programs, values, strict=True))
        distance = max(float(np.max(np.abs(z - e))) for z, e in zip(values, exact, strict=True))
        rows.append(
            timed_row(
                name,
                taken,
                reference,
                f"residual {residual:.0e}, off by {distance:.0e}",
                solved=sum(answer.solved for answer in taken.results),
                residual_max=residual,
                distance_from_optimum_max=distance,
            )
        )
    return Section(
        f"Quadratic programs alone: all {len(programs)} of {bench.scale.plans} cold plans",
        rows,
        notes=[
            "Residual: worst violation of a constraint. Off by: worst distance from the optimum, "
            f"which is Clarabel's at {_EXACT:g}. PIQP and Clarabel at {qp_solvers.TOLERANCE:g}."
        ],
    )


def _collect(bench: Bench) -> list[QuadraticProgram]:
    programs: list[QuadraticProgram] = []

    def recording(program: QuadraticProgram) -> QpSolution:
        programs.append(program)
        return solve_qp(program, qp_solvers.TOLERANCE)

    plan = bench.cold()
    with qp_solvers.planning_with(recording):
        for index in range(bench.scale.plans):
            plan(index)
    return programs


def _solving(solver: qp_solvers.Solver, programs: Sequence[QuadraticProgram]) -> Candidate:
    return lambda index: solver(programs[index])


def _whole_plans(bench: Bench) -> Section:
    def planning(solver: qp_solvers.Solver) -> Candidate:
        plan = bench.cold()

        def planned(index: int) -> Trajectory:
            with qp_solvers.planning_with(solver):
                return plan(index)

        return planned

    times = interleave(
        {name: planning(solver) for name, solver in qp_solvers.solvers().items()},
        bench.scale.plans,
    )
    reference = next(iter(times.values()))
    return Section(
        "The same solvers in the whole cold plan",
        [plan_row(name, taken, reference, reference.results) for name, taken in times.items()],
        notes=[
            "Remarks: plans solved, mean programs per plan, largest relative gap of the effort of "
            "solved plans to the first row's. No fallback to Clarabel."
        ],
    )


def _slopes(bench: Bench) -> Section:
    in_use = ScpSettings().slope_substeps
    rows: list[Row] = []
    for start, planning in (("cold", bench.cold), ("warm, perturbed", bench.warm)):
        times = interleave(
            {
                count: planning(CartPolePlannerSettings(scp=ScpSettings(slope_substeps=count)))
                for count in sorted((1, 2, 4), key=lambda count: count != in_use)
            },
            bench.scale.plans,
        )
        exact = times[4].results
        rows += [
            plan_row(f"{start}: {count}", taken, times[in_use], exact)
            for count, taken in times.items()
        ]
    return Section(
        "slope_substeps: Runge-Kutta substeps behind the slopes",
        rows,
        notes=[
            "Effort against that of four substeps, whose slopes are those of the dynamics; each "
            "ratio is to the two substeps of the same start."
        ],
    )
