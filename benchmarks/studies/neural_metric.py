"""A neural contraction metric beside the shipped polynomial one.

Both are for the same rate, region and plans. Printed: chi, nu, the steady tube per unit of
disturbance; on 10,000 fresh triples (x, x_d, u_d) around fresh plans the share at which the
condition of Theorem 2 holds, and at which some held control meets the condition over the hold; how
many of 40,000 more, on which nothing was chosen, break it; in 100 episodes under a uniform
disturbance of bound 0.75 what u* does with it, by least norm and with the preferred feedback.

    OMP_NUM_THREADS=1 python benchmarks/studies/neural_metric.py [--episodes 100]
        [--train lagros_policies/pretrained/cartpole_neural_metric.safetensors]
        [--json benchmarks/results/neural_metric.json]

Without `--train` the network is read; with it, it is trained and written there first.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from studies.rollouts import Episodes, fly, measures, plan_episodes

from lagros_benchmarks.run.metrics import wilson_interval
from lagros_envs.files import write_atomic
from lagros_envs.tasks.cartpole import task
from lagros_policies.contraction import (
    ContractionMetric,
    HeldControl,
    Samples,
    contraction_residual,
    extreme_eigenvalues,
    verify_metric,
)
from lagros_policies.contraction.cvstem import CvStemSettings
from lagros_policies.expert import metric_of
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.metric_design import MetricDesignSettings, tube_samples
from lagros_policies.tasks.cartpole.neural.design import solve_on_pool
from lagros_policies.tasks.cartpole.neural.metric import (
    NeuralMetric,
    load_neural_metric,
    save_neural_metric,
)
from lagros_policies.tasks.cartpole.neural.training import fit_network
from lagros_policies.tasks.cartpole.region import Region

FloatArray = NDArray[np.float64]

_DESIGN, _CHECK, _NAMESPACE = 1, 22, 23
# Sets of triples that no choice of the design was made on: the pool's size was, by the check above.
_FURTHER = (1022, 1023, 1024, 1025)
_PLANS, _POOL, _CHECKS = 300, 12_000, 10_000
_BOUND = 0.75


def train(pool: Samples, settings: task.CartPoleSettings) -> tuple[NeuralMetric, dict[str, float]]:
    """Design at angles, train, and tell how long both took (processor seconds)."""
    region = Region()
    begun = time.process_time()
    solution = solve_on_pool(settings.system, pool, region, CvStemSettings())
    solved = time.process_time()
    metric = fit_network(settings.system, pool, solution, region)
    trained = time.process_time()
    return metric, {
        "program_s": solved - begun,
        "training_s": trained - solved,
        "program_chi": solution.condition_bound,
    }


def certificate(
    metric: ContractionMetric, fresh: Samples, settings: task.CartPoleSettings
) -> dict[str, Any]:
    """Return what was observed of a metric's conditions on fresh triples."""
    residual = contraction_residual(settings.system, metric, fresh)
    law = HeldControl(settings.system, metric, metric.contraction_rate, settings.control_period)
    a, b, c = law.quadratic(fresh.state, fresh.nominal, fresh.nominal_control)
    feasible = b * b - a * c >= 0.0
    holds = int(np.sum(residual <= 0.0))
    least, largest = extreme_eigenvalues(metric)
    return {
        "alpha": metric.contraction_rate,
        "chi": metric.condition_bound,
        "nu": metric.control_weight,
        "scaled_radius": math.sqrt(metric.condition_bound) / metric.contraction_rate,
        "euclidean_radius": math.sqrt(largest / least) / metric.contraction_rate,
        "checked": len(residual),
        "condition_share": holds / len(residual),
        "condition_ci95": list(wilson_interval(holds, len(residual))),
        "condition_worst": float(residual.max()),
        "held_share": float(feasible.mean()),
    }


def further_checks(
    metric: ContractionMetric, sets: Sequence[Samples], settings: task.CartPoleSettings
) -> dict[str, Any]:
    """Return how many triples of further sets break a metric's conditions."""
    checks = [certificate(metric, one, settings) for one in sets]
    checked = sum(one["checked"] for one in checks)
    broken = sum(round((1.0 - one["condition_share"]) * one["checked"]) for one in checks)
    return {
        "further_checked": checked,
        "further_violations": broken,
        "further_ci95": list(wilson_interval(checked - broken, checked)),
        "further_worst": max(one["condition_worst"] for one in checks),
        "further_held_violations": sum(
            round((1.0 - one["held_share"]) * one["checked"]) for one in checks
        ),
    }


def closed_loop(metric: ContractionMetric, episodes: Episodes) -> dict[str, dict[str, Any]]:
    """Fly u* with a metric, by least norm and with the preferred feedback."""
    expert = CartPoleExpert(metric, law="tuned")
    plans = expert.track(episodes.states, episodes.controls)
    everyone = np.arange(len(episodes.states))

    def least(state: FloatArray, step: int) -> FloatArray:
        return expert.law(state, episodes.states[:, step], episodes.controls[:, step])

    def preferring(state: FloatArray, step: int) -> FloatArray:
        return expert.control(plans, everyone, np.full(len(everyone), step), state)

    found = {}
    for name, law in (("least norm", least), ("preferring", preferring)):
        flown = fly(episodes, law, expert.task.system, expert.task, _BOUND)
        found[name] = measures(episodes, flown, expert.task)
    return found


def evaluation_time(metric: ContractionMetric) -> float:
    """Return the median time of M and dM/dt of one state [s]."""
    state, times = np.array([0.0, 0.4, 0.2, -0.5]), np.empty(400)
    motion = np.array([0.2, -0.5, 0.0, 0.0])
    for call in range(len(times)):
        begun = time.perf_counter()
        metric.matrix(state)
        metric.matrix_rate(state, motion)
        times[call] = time.perf_counter() - begun
    return float(np.median(times))


def study(count: int, weights: Path | None) -> list[dict[str, Any]]:
    """Return one row for each metric."""
    settings = task.CartPoleSettings()
    design = MetricDesignSettings(plans=_PLANS)
    fresh = tube_samples(design, settings, _CHECK, _CHECKS)
    spent: dict[str, float] = {}
    if weights is not None:
        pool = tube_samples(design, settings, _DESIGN, _POOL)
        trained, spent = train(pool, settings)
        checked = verify_metric(settings.system, trained, fresh, design.seed)
        save_neural_metric(checked, weights)
    metrics: dict[str, ContractionMetric] = {
        "neural": load_neural_metric(weights),
        "degree 4 (shipped)": metric_of(task.CartPoleSettings()),
    }
    sets = [tube_samples(design, settings, seed, _CHECKS) for seed in _FURTHER]
    rows = []
    episodes = plan_episodes(CartPoleExpert(), count, _NAMESPACE)
    for name, metric in metrics.items():
        row = {"metric": name, **certificate(metric, fresh, settings)}
        row |= further_checks(metric, sets, settings)
        row["evaluation_s"] = evaluation_time(metric)
        row |= spent if name == "neural" else {}
        rows.append({**row, "closed_loop": closed_loop(metric, episodes)})
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print the tables."""
    console = Console(width=150)
    table = Table(title="conditions on fresh triples (observed), alpha = 0.3")
    for heading in (
        "metric",
        "χ",
        "ν",
        "√χ/α",
        "Eucl.",
        "holds %",
        "worst",
        "held %",
        "broken elsewhere",
        "M, Ṁ [µs]",
    ):
        table.add_column(heading, justify="right")
    loop = Table(title=f"u* with it, uniform disturbance, bound {_BOUND}")
    for heading in ("metric", "law", "left tube %", "strict %", "effort", "rms error"):
        loop.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row["metric"],
            f"{row['chi']:.1f}",
            f"{row['nu']:.0f}",
            f"{row['scaled_radius']:.1f}",
            f"{row['euclidean_radius']:.0f}",
            f"{100 * row['condition_share']:.2f}",
            f"{row['condition_worst']:+.3f}",
            f"{100 * row['held_share']:.2f}",
            f"{row['further_violations']} of {row['further_checked']}",
            f"{1e6 * row['evaluation_s']:.0f}",
        )
        for law, seen in row["closed_loop"].items():
            loop.add_row(
                row["metric"],
                law,
                f"{100 * seen['tube_violation_rate']:.1f}",
                f"{100 * seen['strict_success_rate']:.1f}",
                f"{seen['effort_mean']:.1f}",
                f"{seen['tracking_error_rms']:.3f}",
            )
    console.print(table)
    console.print(loop)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Neural and polynomial metric.")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--train", type=Path, help="train the network and write it there")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/neural_metric.json"))
    options = parser.parse_args()
    rows = study(options.episodes, options.train)
    show(rows)
    write_atomic(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
