"""Should policy (b) plan again from the measured state, or keep its plan and track it?

The same episodes, disturbances and tracking law for each way:

- `keep`: one plan; u* deals with the error. What the package ships: the tube surrounds this plan.
- `measured`: plans from the measured state every so many steps, over the horizon that is left; u*
  tracks the newest one. No tube around one plan is about such a flight.

No plan is late here, so that a busy machine changes no flight; how long each step took is counted.

    OMP_NUM_THREADS=1 python benchmarks/studies/replanning.py [--tasks cartpole,pvtol,...]
        [--episodes 100] [--json benchmarks/results/replanning.json]

With --json, rows of tasks that are not asked for stay in the file.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from lagros_benchmarks.run.episodes import EpisodeRecord, added_up, run_episode
from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.env import TaskEnv
from lagros_envs.files import write_atomic
from lagros_envs.registry import find_task
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Task
from lagros_policies.tube_mpc import ReplanningTubeMpcPolicy, TubeMpcPolicy

_NAMESPACE = 51
_KINDS = ("uniform", "constant", "gust", "switching")
# Control steps between plans, and how long before the time limit the last one is made [s].
_WAYS = ((1, 1.0), (5, 1.0))


def ways(task: Task) -> list[tuple[str, TubeMpcPolicy]]:
    """Return the ways of planning that are compared, by name."""
    found: list[tuple[str, TubeMpcPolicy]] = [("keep", TubeMpcPolicy(task, deadline=math.inf))]
    for every, last in _WAYS:
        policy = ReplanningTubeMpcPolicy(
            task, replan_every=every, last_plan=last, deadline=math.inf
        )
        found.append((f"measured, every {every}, last at T - {last:g} s", policy))
    return found


def summary(task: Task, records: Sequence[EpisodeRecord]) -> dict[str, Any]:
    """Return the figures of the episodes of one way."""
    times = 1e3 * np.concatenate([record.step_times for record in records])
    share = {
        name: float(np.mean([getattr(record, name) for record in records]))
        for name in ("success", "strict_success", "fallen", "collided", "effort", "effort_total")
    }
    counted = added_up(record.counters for record in records)
    return {
        **share,
        "plans": counted["plans"],
        "failed_plans": counted["failed_plans"],
        "step_ms": {
            "median": float(np.median(times)),
            "p99": float(np.percentile(times, 99)),
            "mean": float(np.mean(times)),
        },
        "steps": len(times),
        "steps_over_the_period": int(np.sum(times > 1e3 * task.control_period)),
        "raised": sum(record.error is not None for record in records),
    }


def study(name: str, episodes: int, kinds: Sequence[str]) -> list[dict[str, Any]]:
    """Fly all ways of a task under each kind at its bound, and return their rows."""
    task: Any = find_task(name)
    seeds = episode_seeds(0, episodes, _NAMESPACE)
    bound, rows = task.defaults.bound, []
    for kind in kinds:
        env = TaskEnv(kind, bound, task=task)
        for way, policy in ways(task):
            records = [run_episode(env, policy, seed, None) for seed in seeds]
            row = {"task": task.name, "kind": kind, "bound": bound, "way": way}
            rows.append(row | {"episodes": episodes} | summary(task, records))
            show(rows[-1:])
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print rows as a table."""
    table = Table()
    for heading in (
        *(
            "task",
            "kind",
            "d̄",
            "way",
            "success %",
            "strict %",
            "collided %",
            "effort",
            "to the end",
        ),
        *("plans", "failed", "Δt ms", "p99", "late steps"),
    ):
        table.add_column(heading)
    for row in rows:
        table.add_row(
            row["task"],
            row["kind"],
            f"{row['bound']:g}",
            row["way"],
            *(f"{100 * row[key]:.1f}" for key in ("success", "strict_success", "collided")),
            *(f"{row[key]:.4g}" for key in ("effort", "effort_total")),
            *(str(row[key]) for key in ("plans", "failed_plans")),
            *(f"{row['step_ms'][key]:.2f}" for key in ("median", "p99")),
            f"{row['steps_over_the_period']}/{row['steps']}",
        )
    Console(width=170).print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--tasks", default="cartpole,pvtol,car")
    parser.add_argument("--kinds", default=",".join(kind for kind in _KINDS if kind in OPEN_LOOP))
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for name in options.tasks.split(","):
        rows += study(name, options.episodes, options.kinds.split(","))
    show(rows)
    if options.json is not None:
        made = {row["task"] for row in rows}
        kept = json.loads(options.json.read_text()) if options.json.exists() else []
        rows = [row for row in kept if row["task"] not in made] + rows
        write_atomic(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
