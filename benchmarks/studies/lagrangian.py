"""A known Lyapunov function against the designed metric: who tracks the plans of (d) better?

The same joint plans, worlds and disturbances (preset `paper`, six agents, uniform in the ball) are
flown with u* of the constant metric (`WrenchTracking`, least norm) and with the sliding-variable
law (`SlidingTracking`, lambda = k), each at several rates. Tube: the largest position error of an
agent over the 30 s of the plan, beside the bound that each law comes with.

    python benchmarks/studies/lagrangian.py [--worlds 40] [--bound 0.2,0.6,1.0]
        [--rates 1,2,3,4] [--json benchmarks/results/lagrangian.json]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from lagros_benchmarks.run.metrics import cluster_rate_interval, mean_interval
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.contraction.double_integrator import certified_margin, design_axis
from lagros_policies.remarks.lagrangian import (
    SlidingAxis,
    peak_position_error,
    steady_position_bound,
)
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy, CentralizedState
from lagros_policies.tasks.spacecraft.sliding import SlidingTracking
from lagros_policies.tasks.spacecraft.wrench_control import WrenchTracking

FloatArray = NDArray[np.float64]

AGENTS = 6
STUDY = 5150  # namespace of the worlds of this study
_TURNING_RATE = 0.3
_WIDTH = 150


def tracking_of(law: str, rate: float, env: SpacecraftVectorEnv) -> Any:
    """Return the tracking law of a name and rate [1/s]."""
    body, period = env.settings.system, env.settings.control_period
    if law == "metric":
        turning = design_axis(_TURNING_RATE, period)
        return WrenchTracking(body, design_axis(rate, period), turning)
    turning_axis = SlidingAxis(_TURNING_RATE, _TURNING_RATE, period)
    return SlidingTracking(body, SlidingAxis(rate, rate, period), turning_axis)


def bounds_of(tracking: Any, disturbance: float) -> dict[str, float | None]:
    """Return the bound of the position error that comes with a law, and the exact peak if known."""
    if isinstance(tracking, WrenchTracking):
        return {"bound_m": certified_margin(tracking.plane, disturbance), "peak_m": None}
    return {
        "bound_m": steady_position_bound(tracking.plane, disturbance),
        "peak_m": peak_position_error(tracking.plane, disturbance),
    }


def fly(
    policy: CentralizedPolicy,
    env: SpacecraftVectorEnv,
    seeds: list[int],
    plans: list[CentralizedState] | None,
) -> tuple[dict[str, Any], list[CentralizedState]]:
    """Fly all worlds side by side along their plans, which are made if not given."""
    _, info = env.reset(seed=seeds)
    memory: Any = plans
    largest = np.zeros((len(seeds), AGENTS))
    horizon = round(env.settings.horizon / env.settings.control_period)
    nominal: FloatArray | None = None
    for step in range(env.settings.steps):
        actions, memory = policy.predict(env.state(), memory)
        if nominal is None:
            nominal = np.stack([one.nominal for one in memory])
        _, _, _, _, info = env.step(actions.reshape(env.num_envs, -1))
        if step < horizon:
            error = env.states[..., :2] - nominal[:, step + 1, :, :2]
            largest = np.maximum(largest, np.linalg.norm(error, axis=-1))
    return {**info, "largest_error": largest}, memory


def row(law: str, rate: float, bound: float, flown: dict[str, Any], solved: Any) -> dict[str, Any]:
    """Return the figures of one law at one rate and bound; a world without a plan counts."""
    shape = (len(solved), AGENTS)
    success = flown["success"].reshape(shape) & solved[:, None]
    effort = flown["effort_to_success"].reshape(shape)[solved]
    errors = flown["largest_error"][solved]
    return {
        "task": "spacecraft",
        "law": law,
        "rate": rate,
        "bound": bound,
        "worlds": len(solved),
        "agents": AGENTS,
        "worlds_without_plan": int((~solved).sum()),
        "success_rate": float(success.mean()),
        "success_world_ci95": list(
            cluster_rate_interval(success.sum(axis=1).tolist(), [AGENTS] * len(solved))
        ),
        "collision_rate": float(flown["collided"].mean()),
        "effort_mean": float(effort.mean()),
        "effort_ci95": mean_interval(effort.mean(axis=1)),
        "position_error_max_p95_m": float(np.quantile(errors, 0.95)),
        "position_error_max_m": float(errors.max()),
    }


def study(worlds: int, bounds: list[float], rates: list[float]) -> list[dict[str, Any]]:
    """Fly every law at every rate under every bound along the same plans."""
    seeds = episode_seeds(0, worlds, STUDY)
    rows = []
    for bound in bounds:
        env = SpacecraftVectorEnv(
            worlds * AGENTS,
            AGENTS,
            "paper",
            "uniform",
            bound,
            compiled=False,
            autoreset_mode="disabled",
        )
        policy = CentralizedPolicy(env.settings, "paper", AGENTS, disturbance_bound=bound)
        plans: list[CentralizedState] | None = None
        for law in ("metric", "sliding"):
            for rate in rates:
                policy.tracking = tracking_of(law, rate, env)
                flown, plans = fly(policy, env, seeds, plans)
                solved = np.array([plan.solved for plan in plans])
                certified = bounds_of(policy.tracking, bound)
                rows.append({**row(law, rate, bound, flown, solved), **certified})
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="plans of (d), uniform disturbance, per agent")
    headings = ("d̄", "law", "rate", "success %", "collided %", "effort")
    for heading in (*headings, "error p95 [m]", "error max [m]", "peak [m]", "bound [m]"):
        table.add_column(heading, justify="right")
    for item in rows:
        low, high = item["success_world_ci95"]
        peak = item["peak_m"]
        table.add_row(
            f"{item['bound']:g}",
            item["law"],
            f"{item['rate']:g}",
            f"{100 * item['success_rate']:.1f} ({100 * low:.1f}-{100 * high:.1f})",
            f"{100 * item['collision_rate']:.1f}",
            f"{item['effort_mean']:.3f}",
            f"{item['position_error_max_p95_m']:.3f}",
            f"{item['position_error_max_m']:.3f}",
            "-" if peak is None else f"{peak:.2f}",
            f"{item['bound_m']:.2f}",
        )
    Console(width=_WIDTH).print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Metric or known Lyapunov function.")
    parser.add_argument("--worlds", type=int, default=40)
    parser.add_argument("--bound", default="0.2,0.6,1.0", help="disturbance bounds, by commas")
    parser.add_argument("--rates", default="1,2,3,4", help="rates [1/s], by commas")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/lagrangian.json"))
    options = parser.parse_args()
    bounds, rates = (
        [float(part) for part in text.split(",")] for text in (options.bound, options.rates)
    )
    rows = study(options.worlds, bounds, rates)
    show(rows)
    write_atomic(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
