"""The general planner on a car and a planar quadrotor among discs: solved, how well, how fast.

Every plan is checked by equations and an integrator of its own on a grid ten times as fine as the
nodes: distances from the discs between the nodes, bounds, ends and defects.

    OMP_NUM_THREADS=1 python benchmarks/studies/planner_general.py [--episodes 500] [--others 10]
        [--json benchmarks/results/planner_general.json]
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from studies.planar import GRAVITY, car_problem, pvtol_problem

from lagros_envs.files import write_atomic
from lagros_policies.planning import PlannerSettings, Problem, Trajectory, plan_trajectory
from lagros_policies.planning.qp import QpSolver

FloatArray = NDArray[np.float64]
Rates = Callable[[FloatArray, FloatArray], FloatArray]

_SEED = 20210226
_FINE = 10
# What the project asks for: share solved, largest defect, median of a cold plan [ms].
_SHARE, _DEFECT = 0.99, 1e-6


@dataclass(frozen=True)
class Case:
    """A family of episodes.

    Attributes:
        name: What the table calls it.
        draw: Problem of a random episode.
        rates: The equations of motion, written again for the check.
        limit_ms: Median that a cold plan is to take [ms], if there is one to reach.
    """

    name: str
    draw: Callable[[np.random.Generator], Problem]
    rates: Rates
    limit_ms: float | None


def car_rates(state: FloatArray, control: FloatArray) -> FloatArray:
    """Return dx/dt of the car, shape (..., 4)."""
    heading, speed = state[..., 2], state[..., 3]
    along = speed * np.exp(1j * heading)
    return np.stack([along.real, along.imag, control[..., 0], control[..., 1]], axis=-1)


def pvtol_rates(state: FloatArray, control: FloatArray) -> FloatArray:
    """Return dx/dt of the planar quadrotor, shape (..., 6), with the velocity as one number."""
    turn = np.exp(1j * state[..., 2])
    rate = state[..., 5]
    velocity = state[..., 3] + 1j * state[..., 4]
    motion = velocity * turn
    # In axes that turn, dv/dt loses what their turning adds; gravity points down in the world's.
    change = -1j * rate * velocity - 1j * GRAVITY / turn + 1j * control.sum(axis=-1) / 0.486
    torque = 0.25 * (control[..., 0] - control[..., 1]) / 0.00383
    parts = motion.real, motion.imag, rate, change.real, change.imag, torque
    return np.stack(parts, axis=-1)


CASES = (
    Case("car, 0.1 s", car_problem, car_rates, 60.0),
    Case("car, 0.03 s", lambda rng: car_problem(rng, 0.03), car_rates, None),
    Case("pvtol, 0.1 s", pvtol_problem, pvtol_rates, 300.0),
)


def checked(problem: Problem, plan: Trajectory, rates: Rates) -> dict[str, float]:
    """Return the largest violations of a plan, between the nodes too."""
    state, path = plan.states[:-1], [plan.states[:-1]]
    h = problem.period / _FINE
    for _ in range(_FINE):
        k1 = rates(state, plan.controls)
        k2 = rates(state + 0.5 * h * k1, plan.controls)
        k3 = rates(state + 0.5 * h * k2, plan.controls)
        k4 = rates(state + h * k3, plan.controls)
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        path.append(state)
    places = np.stack(path)
    discs = problem.discs
    assert discs is not None
    gaps = np.linalg.norm(places[..., None, list(discs.position)] - discs.centres, axis=-1)
    required = discs.required(problem.steps)[0]
    beyond = np.maximum(problem.state_low - plan.states[1:], plan.states[1:] - problem.state_high)
    force = np.maximum(problem.control_low - plan.controls, plan.controls - problem.control_high)
    return {
        "defect": float(np.max(np.abs(state - plan.states[1:]))),
        "clearance": float(np.min(gaps - required)),
        "bounds": float(max(np.max(beyond), np.max(force), 0.0)),
        "end": float(np.max(np.abs(plan.states[-1] - problem.terminal_state))),
    }


def measure(case: Case, episodes: int, settings: PlannerSettings) -> dict[str, Any]:
    """Plan the episodes of a case from nothing and return the row."""
    plans, checks, wall, cpu = [], [], [], []
    for episode in range(episodes):
        problem = case.draw(np.random.default_rng([_SEED, episode]))
        begun = time.perf_counter(), time.process_time()
        plan = plan_trajectory(problem, settings)
        wall.append(time.perf_counter() - begun[0])
        cpu.append(time.process_time() - begun[1])
        plans.append(plan)
        if plan.solved:
            checks.append(checked(problem, plan, case.rates))
    found = [plan for plan in plans if plan.solved]
    return {
        "case": case.name,
        "solver": settings.scp.qp_solver,
        "episodes": episodes,
        "solved": len(found),
        "failed": dict(Counter(plan.status for plan in plans if not plan.solved)),
        "limit_ms": case.limit_ms,
        "plan_cpu_ms": _spread(1e3 * np.array(cpu)),
        "plan_wall_ms": _spread(1e3 * np.array(wall)),
        "programs": _spread(np.array([plan.iterations for plan in plans], dtype=np.float64)),
        # Of the plans that hold; none without one.
        "effort_median": float(np.median([plan.effort for plan in found])) if found else None,
        "own_defect_max": max((plan.defect for plan in found), default=None),
        "defect_max": max((check["defect"] for check in checks), default=None),
        "clearance_min": min((check["clearance"] for check in checks), default=None),
        "bounds_max": max((check["bounds"] for check in checks), default=None),
        "end_max": max((check["end"] for check in checks), default=None),
    }


def _spread(values: FloatArray) -> dict[str, float]:
    return {
        "median": float(np.median(values)),
        "p99": float(np.percentile(values, 99)),
        "max": float(np.max(values)),
    }


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="plans among discs, from nothing")
    for heading in (
        *("case", "solver", "solved", "CPU ms", "p99", "QPs", "defect", "same, finer"),
        *("clearance [m]", "bounds", "end"),
    ):
        table.add_column(heading)
    for row in rows:
        limit = "" if row["limit_ms"] is None else f" (≤ {row['limit_ms']:g})"
        table.add_row(
            row["case"],
            row["solver"],
            f"{row['solved']}/{row['episodes']}",
            f"{row['plan_cpu_ms']['median']:.0f}{limit}",
            f"{row['plan_cpu_ms']['p99']:.0f}",
            f"{row['programs']['median']:g}",
            *(
                "" if row[name] is None else f"{row[name]:.0e}"
                for name in (
                    "own_defect_max",
                    "defect_max",
                    "clearance_min",
                    "bounds_max",
                    "end_max",
                )
            ),
        )
    Console(width=140).print(table)
    for row in rows:
        holds = row["solved"] >= max(_SHARE * row["episodes"], 1)
        holds = holds and row["own_defect_max"] <= _DEFECT
        if row["limit_ms"] is not None:
            holds &= row["plan_cpu_ms"]["median"] <= row["limit_ms"]
        Console().print(f"{row['case']}, {row['solver']}: {'reached' if holds else 'MISSED'}")
        for status, count in row["failed"].items():
            Console().print(f"  {count} x {status}")


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument(
        "--others", type=int, default=10, help="episodes by Clarabel and by OSQP; 0 for none"
    )
    parser.add_argument("--cases", default="", help="only those whose names hold this")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    usual = PlannerSettings()
    for solver in get_args(QpSolver):
        episodes = arguments.episodes if solver == usual.scp.qp_solver else arguments.others
        settings = replace(usual, scp=replace(usual.scp, qp_solver=solver))
        cases = [case for case in CASES if arguments.cases in case.name] if episodes > 0 else []
        rows += [measure(case, episodes, settings) for case in cases]
    show(rows)
    if arguments.json is not None:
        write_atomic(arguments.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
