"""How well does distributed tube MPC (b) do in the environment, and what does a control input cost?

Flies `DistributedTubeMpcPolicy` in the preset `paper` with six agents under a uniform disturbance.
Rates are per agent, with Wilson intervals that take agents for independent, which those of one
world are not quite. Every agent is asked for its action in a call of its own, and every call is
timed: those that plan and those that only track.

    python benchmarks/studies/spacecraft_distributed.py [--worlds 20] [--bound 0.2,0.6,1.0]
        [--rate 2.0] [--every 2] [--seed 0] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
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
from lagros_policies.tasks.spacecraft.distributed import DistributedTubeMpcPolicy

PRESET, AGENTS = "paper", 6
_WIDTH = 180  # of the table, whatever the terminal
RATES = ("success", "strict_success", "paper_success", "collided")
MEASURES = (*RATES, "effort_to_success")


def fly(
    env: SpacecraftParallelEnv, policy: DistributedTubeMpcPolicy, seed: int
) -> tuple[dict[str, NDArray[Any]], dict[str, int], list[float], list[float]]:
    """Fly one world to its end.

    Returns:
        The measures of its agents, the policy's counters, and the seconds of every call and of
        those that planned.
    """
    observations, _ = env.reset(seed=seed)
    memories: dict[str, Any] = dict.fromkeys(env.agents)
    infos: dict[str, dict[str, Any]] = {}
    calls: list[float] = []
    planning: list[float] = []
    while env.agents:
        actions = {}
        for agent in env.agents:
            before = memories[agent][0].plans if memories[agent] else 0
            begun = time.perf_counter()
            actions[agent], memories[agent] = policy.predict(observations[agent], memories[agent])
            calls.append(time.perf_counter() - begun)
            if memories[agent][0].plans > before:
                planning.append(calls[-1])
        observations, _, _, _, infos = env.step(actions)
    measures = {
        name: np.array([infos[agent][name] for agent in env.possible_agents]) for name in MEASURES
    }
    counted = policy.counters([memory[0] for memory in memories.values()])
    return measures, counted, calls, planning


def study(
    worlds: int, bounds: list[float], rate: float, every: int, seed: int
) -> list[dict[str, Any]]:
    """Fly the same worlds under every bound and return one row for each bound."""
    rows = []
    for bound in bounds:
        env = spacecraft_v0.parallel_env(
            AGENTS, PRESET, disturbance="uniform", disturbance_bound=bound
        )
        policy = DistributedTubeMpcPolicy(
            env.settings, PRESET, AGENTS, bound, contraction_rate=rate, replan_every=every
        )
        flown = [fly(env, policy, one) for one in episode_seeds(seed, worlds, EVALUATION)]
        row: dict[str, Any] = {
            "task": "spacecraft",
            "policy": policy.name,
            "preset": PRESET,
            "agents": AGENTS,
            "worlds": worlds,
            "bound": bound,
            "contraction_rate": rate,
            "replan_every": every,
            "margin_m": policy.margin,
        }
        for name in RATES:
            values = np.concatenate([measures[name] for measures, _, _, _ in flown])
            row[f"{name}_rate"] = float(values.mean())
            row[f"{name}_ci95"] = list(wilson_interval(int(values.sum()), values.size))
        efforts = np.concatenate([measures["effort_to_success"] for measures, _, _, _ in flown])
        row["effort_mean"] = float(efforts.mean())
        for name in flown[0][1]:
            row[name] = sum(counted[name] for _, counted, _, _ in flown)
        for name, index in (("call", 2), ("planning_call", 3)):
            seconds = np.concatenate([part[index] for part in flown])
            median, p99 = np.percentile(seconds, [50.0, 99.0])
            row[f"{name}_median_s"], row[f"{name}_p99_s"] = float(median), float(p99)
            row[f"{name}_max_s"] = float(seconds.max())
            row[f"{name}_late"] = int(np.sum(seconds > env.settings.control_period))
        rows.append(row)
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title=f"(b) distributed tube MPC, {PRESET}, {AGENTS} agents, uniform disturbance")
    for heading in (
        "bound",
        "success %",
        "strict %",
        "paper %",
        "collided %",
        "effort",
        "failed/plans",
        "stuck at end",
        "call ms p50/p99/max",
        "planning call ms p50/p99",
        "late calls",
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        rates = []
        for name in RATES:
            low, high = row[f"{name}_ci95"]
            rates.append(f"{100 * row[f'{name}_rate']:.1f} [{100 * low:.1f}, {100 * high:.1f}]")
        times = {
            name: [1e3 * row[f"{name}_{part}_s"] for part in ("median", "p99", "max")]
            for name in ("call", "planning_call")
        }
        table.add_row(
            f"{row['bound']:g}",
            *rates,
            f"{row['effort_mean']:.2f}",
            f"{row['failed_plans']}/{row['plans']}",
            f"{row['stuck']}",
            "/".join(f"{value:.1f}" for value in times["call"]),
            "/".join(f"{value:.1f}" for value in times["planning_call"][:2]),
            f"{row['call_late']}",
        )
    Console(width=_WIDTH).print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Fly distributed tube MPC against the bound.")
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--bound", default="0.2,0.6,1.0", help="disturbance bounds, by commas")
    parser.add_argument("--rate", type=float, default=2.0, help="contraction rate of u* [1/s]")
    parser.add_argument(
        "--every", type=int, default=2, help="control steps between looks at the plan"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    bounds = [float(part) for part in options.bound.split(",")]
    rows = study(options.worlds, bounds, options.rate, options.every, options.seed)
    show(rows)
    if options.json is not None:
        write_atomic(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
