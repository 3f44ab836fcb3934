"""How well does the centralised planner (d) do in the environment, against the disturbance bound?

Flies `CentralizedPolicy` in the preset `paper` with six agents under a uniform disturbance. Rates
are per agent, with Wilson intervals that take agents for independent, which those of one world are
not quite. A world without a plan counts with all its agents as failures, and is listed.

    python benchmarks/studies/spacecraft_centralized.py [--worlds 20] [--bound 0.2,0.6,1.0]
        [--rate 2.0] [--law gain] [--seed 0] [--json FILE]
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

from lagros_benchmarks.run.metrics import wilson_interval
from lagros_envs import spacecraft_v0
from lagros_envs.files import write_atomic
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.spacecraft.parallel import SpacecraftParallelEnv
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy, CentralizedState

PRESET, AGENTS = "paper", 6
_WIDTH = 180  # of the table, whatever the terminal
RATES = ("success", "strict_success", "paper_success", "collided")


def fly(
    env: SpacecraftParallelEnv, policy: CentralizedPolicy, seed: int
) -> tuple[dict[str, NDArray[Any]], CentralizedState]:
    """Fly one world to its end; return the measures of its agents and what the policy planned."""
    env.reset(seed=seed)
    memory: Any = None
    infos: dict[str, dict[str, Any]] = {}
    while env.agents:
        actions, memory = policy.predict(env.state(), memory)
        _, _, _, _, infos = env.step(dict(zip(env.agents, actions, strict=True)))
    names = (*RATES, "effort", "effort_to_success", "collision_time")
    measures = {
        name: np.array([infos[agent][name] for agent in env.possible_agents]) for name in names
    }
    return measures, memory[0]


def study(
    worlds: int, bounds: list[float], rate: float, seed: int, law: str
) -> list[dict[str, Any]]:
    """Fly the same worlds under every bound and return one row for each bound."""
    seeds = episode_seeds(seed, worlds, EVALUATION)
    rows = []
    for bound in bounds:
        env = spacecraft_v0.parallel_env(
            AGENTS, PRESET, disturbance="uniform", disturbance_bound=bound
        )
        policy = CentralizedPolicy(
            env.settings, PRESET, AGENTS, disturbance_bound=bound, contraction_rate=rate, law=law
        )
        flown = [fly(env, policy, one) for one in seeds]
        rows.append({**_row(policy, seeds, flown), "bound": bound, "contraction_rate": rate})
    return rows


def _row(
    policy: CentralizedPolicy,
    seeds: list[int],
    flown: list[tuple[dict[str, NDArray[Any]], CentralizedState]],
) -> dict[str, Any]:
    """Return the figures of one bound."""
    memories = [memory for _, memory in flown]
    plans = [memory.plan for memory in memories if memory.plan is not None]
    solved = np.array([memory.solved for memory in memories])
    per_agent = {name: np.stack([part[name] for part, _ in flown]) for name in flown[0][0]}
    for name in RATES[:-1]:
        # Agents that hold their position have not arrived; whatever drifted there counts for none.
        per_agent[name] &= solved[:, None]
    row: dict[str, Any] = {
        "task": "spacecraft",
        "policy": policy.name,
        "preset": PRESET,
        "agents": AGENTS,
        "worlds": len(flown),
        "margins_m": list(policy.planner.settings.margins),
        "worlds_by_margin": [
            sum(plan.solved and plan.margin == margin for plan in plans)
            for margin in policy.planner.settings.margins
        ],
        "failed_plans": policy.counters(memories)["failed_plans"],
        "failed_worlds": [
            {"seed": seed, "status": "no time" if memory.plan is None else memory.plan.status}
            for seed, memory in zip(seeds, memories, strict=True)
            if not memory.solved
        ],
        "worlds_with_collision": [
            seed
            for seed, (measures, _) in zip(seeds, flown, strict=True)
            if bool(measures["collided"].any())
        ],
    }
    for name in RATES:
        values = per_agent[name]
        row[f"{name}_rate"] = float(values.mean())
        row[f"{name}_ci95"] = list(wilson_interval(int(values.sum()), values.size))
    if solved.any():
        row["success_rate_where_planned"] = float(per_agent["success"][solved].mean())
        row["effort_mean"] = float(per_agent["effort_to_success"][solved].mean())
        row["effort_to_end_mean"] = float(per_agent["effort"][solved].mean())
        row["plan_effort_mean"] = float(np.mean([plan.effort for plan in plans if plan.solved]))
    seconds = np.array([plan.seconds for plan in plans])
    row["plan_time_median_s"], row["plan_time_p99_s"] = (
        float(value) for value in np.percentile(seconds, [50.0, 99.0])
    )
    return row


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table, and the worlds without a plan."""
    console = Console(width=_WIDTH)
    table = Table(title=f"(d) centralised, {PRESET}, {AGENTS} agents, uniform disturbance")
    for heading in (
        "bound",
        "success %",
        "strict %",
        "paper %",
        "collided %",
        "effort",
        "plan effort",
        "plan s p50/p99",
        "worlds by margin",
        "no plan",
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        rates = []
        for name in RATES:
            low, high = row[f"{name}_ci95"]
            rates.append(f"{100 * row[f'{name}_rate']:.1f} [{100 * low:.1f}, {100 * high:.1f}]")
        kept = zip(row["margins_m"], row["worlds_by_margin"], strict=True)
        table.add_row(
            f"{row['bound']:g}",
            *rates,
            f"{row.get('effort_mean', np.nan):.2f}",
            f"{row.get('plan_effort_mean', np.nan):.2f}",
            f"{row['plan_time_median_s']:.2f}/{row['plan_time_p99_s']:.2f}",
            " ".join(f"{count}@{margin:.2f}" for margin, count in kept if count),
            f"{row['failed_plans']}/{row['worlds']}",
        )
    console.print(table)
    for row in rows:
        for world in row["failed_worlds"]:
            console.print(f"bound {row['bound']:g}, seed {world['seed']}: {world['status']}")


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Fly the centralised planner against the bound.")
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--bound", default="0.2,0.6,1.0", help="disturbance bounds, by commas")
    parser.add_argument("--rate", type=float, default=2.0, help="contraction rate of u* [1/s]")
    parser.add_argument("--law", default="gain", help="how u* answers an error")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    bounds = [float(part) for part in options.bound.split(",")]
    rows = study(options.worlds, bounds, options.rate, options.seed, options.law)
    show(rows)
    if options.json is not None:
        write_atomic(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
