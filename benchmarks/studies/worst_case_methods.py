"""Which search finds the worst disturbance of the cart-pole, at the same number of flights?

CMA-ES, the cross-entropy method and random search over four parametrisations of a sequence, the
projected (conditional) gradient through the closed loop, and explorers followed by the gradient.
All attack policy (c) in the same episodes and spend the same flights per episode; the flights that
the gradient's differences cost are counted.

    python benchmarks/studies/worst_case_methods.py [--episodes 4] [--budget 600] [--json FILE]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from lagros_benchmarks.run.files import write_json
from lagros_benchmarks.worst_case.flights import draw_episodes, policy_law
from lagros_benchmarks.worst_case.optimisers import OPTIMISERS
from lagros_benchmarks.worst_case.search import SearchSettings, search
from lagros_benchmarks.worst_case.seeds import ATTACK
from lagros_benchmarks.worst_case.single import SingleTarget, energy_adversary
from lagros_envs.seeding import episode_seeds
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.tasks.cartpole.expert import CartPoleExpert

COMMAND = "python benchmarks/studies/worst_case_methods.py"
# Another run than the published attack, whose episodes must not choose its method.
_SEED = 1
_PROBLEMS = (("tube", 0.3), ("tube", 0.75), ("success", 0.75))
_SHAPES = (("segments", 6), ("segments", 15), ("knots", 6), ("switching", 6))


def methods(budget: int) -> list[SearchSettings]:
    """Return every method that is compared."""
    alone = [
        SearchSettings(name, parametrisation=shape, pieces=pieces, budget=budget)
        for shape, pieces in _SHAPES
        for name in OPTIMISERS
    ]
    mixed = [
        SearchSettings("hybrid", name, shape, pieces, budget)
        for shape, pieces in (("segments", 6), ("switching", 6))
        for name in OPTIMISERS
    ]
    return [*alone, SearchSettings("gradient", budget=budget), *mixed]


def study(episodes: int, budget: int, runs: int = 1) -> list[dict[str, Any]]:
    """Run all methods on all problems and return one row for each pair."""
    expert = CartPoleExpert()
    flown = draw_episodes(expert, episode_seeds(_SEED, episodes, ATTACK))
    law = policy_law(LagrosPolicy(expert.task), flown)
    rows = []
    for goal, bound in _PROBLEMS:
        target = SingleTarget(flown, law, goal, bound, energy_adversary(expert.metric))
        for settings in methods(budget):
            begun = perf_counter()
            found = [one for run in range(runs) for one in search(target, settings, run)]
            scores = np.array([one.score for one in found])
            rows.append(
                {
                    "goal": goal,
                    "bound": bound,
                    "method": settings.method,
                    "explorer": settings.optimiser if settings.method == "hybrid" else None,
                    "parametrisation": None
                    if settings.method == "gradient"
                    else f"{settings.parametrisation} {settings.pieces}",
                    "flights": max(one.flights for one in found),
                    "score_mean": float(scores.mean()),
                    "scores": scores.tolist(),
                    "seconds": perf_counter() - begun,
                }
            )
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print one table per problem, the best method first."""
    for goal, bound in dict.fromkeys((row["goal"], row["bound"]) for row in rows):
        table = Table(title=f"worst case of (c), goal {goal}, bound {bound:g}: larger is worse")
        for heading in ("method", "explorer", "parametrisation", "mean", "least", "s"):
            table.add_column(heading)
        own = [row for row in rows if (row["goal"], row["bound"]) == (goal, bound)]
        for row in sorted(own, key=lambda row: -row["score_mean"]):
            table.add_row(
                row["method"],
                row["explorer"] or "",
                row["parametrisation"] or "",
                f"{row['score_mean']:.3f}",
                f"{min(row['scores']):.3f}",
                f"{row['seconds']:.0f}",
            )
        Console().print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Compare searches for the worst disturbance.")
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--budget", type=int, default=600)
    parser.add_argument(
        "--json", type=Path, default=Path("benchmarks/results/worst_case_methods.json")
    )
    options = parser.parse_args()
    rows = study(options.episodes, options.budget)
    show(rows)
    write_json(options.json, {"command": COMMAND, "rows": rows})


if __name__ == "__main__":
    main()
