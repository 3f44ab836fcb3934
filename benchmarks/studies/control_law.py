"""Which point of the contracting set should u* take, and at which rate?

Runs tracking laws around the same plans, under the same disturbances (uniform in the ball,
d_bar = 0.75), and counts the episodes whose error ever leaves the published tube:

- the continuous law of Theorem 2, least norm, held for 0.1 s;
- the same condition over the hold (`HeldControl`), least norm;
- the same set, preferring the gain-scheduled feedback (what the package ships);

each with metrics of several contraction rates alpha. For every alpha the line search's objective
sqrt(chi)/alpha is printed, in the scaled state of the design and in the Euclidean norm.

    python benchmarks/studies/control_law.py [--episodes 1000] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.dynamics import hold_step
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole import task
from lagros_policies.contraction import (
    InfeasibleError,
    Metric,
    extreme_eigenvalues,
    robust_control,
)
from lagros_policies.tasks.cartpole.expert import CartPoleExpert, TrackedPlans
from lagros_policies.tasks.cartpole.metric_design import (
    MetricDesignSettings,
    design_cartpole_metric,
)

FloatArray = NDArray[np.float64]
# (states, step) -> forces.
Law = Callable[[FloatArray, int], FloatArray]

_NAMESPACE = 11
_BOUND = 0.75
_RATES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8)


def episodes(expert: CartPoleExpert, count: int) -> tuple[TrackedPlans, FloatArray]:
    """Plan random episodes and draw their disturbances."""
    settings = expert.task
    plans, pushes = [], []
    for seed in episode_seeds(0, count, _NAMESPACE):
        streams = episode_streams(seed)
        scenario = settings.sample(streams.scenario)
        plan = expert.planner.plan(scenario.initial_state, scenario.goal)
        if not plan.solved:
            raise RuntimeError(f"episode {seed} has no plan: {plan.status}")
        plans.append(plan)
        pushes.append(
            OPEN_LOOP["uniform"].realise(
                streams.disturbance, settings.steps, 4, settings.control_period
            )
        )
    states = np.stack([plan.states for plan in plans])
    controls = np.stack([plan.controls for plan in plans])
    return expert.track(states, controls), _BOUND * np.stack(pushes)


def roll_out(
    law: Law, plans: TrackedPlans, pushes: FloatArray, settings: task.CartPoleSettings
) -> dict[str, float]:
    """Fly all episodes at once and count."""
    states, period = plans.states, settings.control_period
    state = states[:, 0]
    path, forces = [state], []
    for step in range(settings.steps):
        force = law(state, step)
        state = hold_step(settings.system, state, force, period, pushes[:, step])
        # A pole that has fallen long ago may overflow; it is counted as fallen below.
        state = np.where(np.isfinite(state) & (np.abs(state) < 1e3), state, 1e3)
        path.append(state)
        forces.append(force)
    visited, applied = np.stack(path, axis=1), np.stack(forces, axis=1)
    radius = settings.tube.radius(period * np.arange(settings.steps + 1))
    error = np.linalg.norm(visited - states, axis=-1)
    fallen = np.any(np.abs(visited[..., 1]) > task.FALL_ANGLE, axis=1)
    inside = np.linalg.norm(visited[:, -1] - states[:, -1], axis=-1) <= radius[-1]
    left = np.any(error > radius + 1e-6, axis=1) | fallen
    leaning = np.abs(states[:, 0, 1]) > 0.9
    return {
        "left_tube": float(left.mean()),
        "left_tube_leaning": float(left[leaning].mean()),
        "strict": float(np.mean(inside & ~fallen)),
        "effort": float(np.mean(np.sum(applied**2, axis=(1, 2)) * period)),
        "largest_deviation": float(np.max(np.abs(applied - plans.controls))),
    }


def laws(expert: CartPoleExpert, plans: TrackedPlans) -> dict[str, Law]:
    """Return the tracking laws that are compared."""
    everyone = np.arange(len(plans.states))

    def continuous(state: FloatArray, step: int) -> FloatArray:
        nominal, control = plans.states[:, step], plans.controls[:, step]
        rate = expert.metric.contraction_rate
        return robust_control(expert.task.system, expert.metric, rate, state, nominal, control)

    def held(state: FloatArray, step: int) -> FloatArray:
        return expert.law(state, plans.states[:, step], plans.controls[:, step])

    def preferring(state: FloatArray, step: int) -> FloatArray:
        return expert.control(plans, everyone, np.full(len(everyone), step), state)

    return {"continuous": continuous, "held": held, "preferring": preferring}


def study(count: int, rates: tuple[float, ...] = _RATES) -> list[dict[str, Any]]:
    """Run the laws at every rate and return one row for each."""
    design = MetricDesignSettings()
    rows: list[dict[str, Any]] = []
    flown: tuple[TrackedPlans, FloatArray] | None = None
    for rate in rates:
        try:
            metric: Metric = design_cartpole_metric(
                replace(design, cvstem=replace(design.cvstem, contraction_rate=rate))
            )
        except (InfeasibleError, RuntimeError) as error:
            rows.append({"alpha": rate, "law": "none", "problem": str(error)})
            continue
        expert = CartPoleExpert(metric, law="tuned")
        flown = flown or episodes(expert, count)
        plans, pushes = flown
        least, largest = extreme_eigenvalues(metric)
        common = {
            "alpha": rate,
            "chi": metric.condition_bound,
            "nu": metric.control_weight,
            "scaled_radius": math.sqrt(metric.condition_bound) / rate,
            "euclidean_radius": math.sqrt(largest / least) / rate,
        }
        for name, law in laws(expert, plans).items():
            rows.append({**common, "law": name, **roll_out(law, plans, pushes, expert.task)})
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="u* over the hold, uniform disturbance, bound 0.75")
    for heading in ("alpha", "law", "√χ/α", "left %", "|θ0|>0.9", "strict %", "effort", "max |v|"):
        table.add_column(heading, justify="right")
    for row in rows:
        if row["law"] == "none":
            table.add_row(f"{row['alpha']:g}", "infeasible", "", "", "", "", "", "")
            continue
        table.add_row(
            f"{row['alpha']:g}",
            row["law"],
            f"{row['scaled_radius']:.1f}",
            f"{100 * row['left_tube']:.1f}",
            f"{100 * row['left_tube_leaning']:.1f}",
            f"{100 * row['strict']:.1f}",
            f"{row['effort']:.1f}",
            f"{row['largest_deviation']:.1f}",
        )
    Console().print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Compare tracking laws and contraction rates.")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/control_law.json"))
    options = parser.parse_args()
    rows = study(options.episodes)
    show(rows)
    write_atomic(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
