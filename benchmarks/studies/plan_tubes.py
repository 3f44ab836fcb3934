"""Tubes around plans: up to which d_bar they close and mean something, how tight, in what time.

For every task and bound: the share of plans whose tube closes, the share of episodes of which it
guarantees everything (goal, fall, discs, bounds of the control), its largest widths, and how far a
search for the worst disturbance came to it in some of the episodes. For tasks with discs also the
share that holds after planning with the room of the tube (Theorem 3). The law is that of (b).

    OMP_NUM_THREADS=1 python benchmarks/studies/plan_tubes.py [--tasks cartpole,car]
        [--bounds 0.1,0.25] [--plans 100] [--searched 10]
        [--json benchmarks/results/plan_tubes.json]

With --json, rows of tasks and bounds that are not asked for stay in the file.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from lagros_benchmarks.evidence.guaranteed import coordinates, evidence_of
from lagros_benchmarks.evidence.loops import Loop, loop_named
from lagros_benchmarks.worst_case.search import SearchSettings
from lagros_envs.files import write_atomic
from lagros_envs.registry import find_task
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.task import Task
from lagros_policies.expert import Expert
from lagros_policies.proof.guarantee import guarantees
from lagros_policies.proof.tightened import planned_with_tube

_NAMESPACE = 52
_POLICY = "tube-mpc"
# Of each task, from where its tube is that of the linear error to where few close.
_BOUNDS = {
    "cartpole": (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4),
    "car": (0.05, 0.1, 0.15, 0.2, 0.3, 0.4),
    "pvtol": (0.02, 0.05, 0.1, 0.15, 0.2),
}
_OTHERS = (0.05, 0.1, 0.2, 0.4)
_SEARCH = SearchSettings(budget=600)


def row_of(task: Task, loop: Loop, searched: Loop, bound: float, tightened: int) -> dict[str, Any]:
    """Return the figures of one task and bound."""
    flown = loop.episodes
    assert loop.tubes is not None
    begun = time.process_time()
    tubes = loop.tubes(bound)
    seconds = time.process_time() - begun
    shown = guarantees(task, flown.goals, flown.discs, flown.plans, flown.controls, tubes)
    closed = shown.closed
    row: dict[str, Any] = {
        "task": task.name,
        "bound": bound,
        "plans": len(closed),
        "closed": float(closed.mean()),
        "guaranteed": float(shown.holds.mean()),
        "not_shown": {
            name: int(np.sum(closed & ~getattr(shown, name)))
            for name in ("reaches", "upright", "clear", "within")
        },
        "cpu_seconds_per_plan": round(seconds / len(closed), 3),
    }
    if closed.any():
        widths = tubes.outputs[closed][..., : task.system.state_dim].max(axis=1)
        norms = tubes.norm[closed]
        row["median_widths"] = dict(
            zip(coordinates(task), np.median(widths, axis=0).tolist(), strict=True)
        )
        row["median_norm"] = float(np.median(norms.max(axis=1)))
        row["median_norm_at_the_end"] = float(np.median(norms[:, -1]))
        row["largest_norm_at_the_end"] = float(norms[:, -1].max())
    found = evidence_of(searched, bound, (), _SEARCH)
    assert found.tubes is not None
    kept = found.tubes.closed
    ratios = found.tubes.norm[kept].max(axis=1) / found.worst.error[kept]
    row["searched"] = {
        "episodes": int(kept.sum()),
        "flights_per_episode": found.worst.flights,
        "bound_over_worst": {"median": float(np.median(ratios)), "largest": float(ratios.max())}
        if len(ratios)
        else None,
        "crossed": int(np.sum(found.worst.crossed & kept)),
    }
    if tightened:
        row["room_of_the_tube"] = _with_room(task, bound, tightened)
    return row


def _with_room(task: Task, bound: float, episodes: int) -> dict[str, Any]:
    """Return how many episodes keep discs and controls with a plan of the tube's own room."""
    expert = Expert(task)
    holds, guaranteed, rounds = [], [], []
    for seed in episode_seeds(0, episodes, _NAMESPACE):
        scenario = task.sample(episode_streams(seed).scenario)
        found = planned_with_tube(expert, scenario, bound)
        holds.append(found.holds)
        guaranteed.append(bool(found.guarantees.holds[0]))
        rounds.append(found.rounds)
    return {
        "episodes": episodes,
        "holds": float(np.mean(holds)),
        "guaranteed": float(np.mean(guaranteed)),
        "mean_rounds": float(np.mean(rounds)),
    }


def study(
    name: str, plans: int, searched: int, bounds: Sequence[float] = ()
) -> list[dict[str, Any]]:
    """Return the rows of a task, at its own bounds or at some."""
    task = find_task(name)
    assert isinstance(task, Task)
    seeds = episode_seeds(0, plans, _NAMESPACE)
    loop = loop_named(_POLICY, task, seeds)
    some = loop_named(_POLICY, task, seeds[:searched])
    tightened = min(searched, plans) if task.most_discs else 0
    asked = bounds or _BOUNDS.get(task.name, _OTHERS)
    return [row_of(task, loop, some, bound, tightened) for bound in asked]


def _printed(rows: list[dict[str, Any]]) -> Table:
    table = Table("task", "d̄", "closed", "guaranteed", "‖e‖", "‖e(T)‖", "bound / worst", "s / plan")
    table.add_column("with the tube's room")
    for row in rows:
        ratio = row["searched"]["bound_over_worst"]
        room = row.get("room_of_the_tube")
        table.add_row(
            row["task"],
            f"{row['bound']:g}",
            f"{row['closed']:.0%}",
            f"{row['guaranteed']:.0%}",
            f"{row.get('median_norm', float('inf')):.3g}",
            f"{row.get('median_norm_at_the_end', float('inf')):.3g}",
            f"{ratio['median']:.2f} ({ratio['largest']:.2f})" if ratio else "–",
            f"{row['cpu_seconds_per_plan']:.2f}",
            f"{room['holds']:.0%}, {room['guaranteed']:.0%}" if room else "–",
        )
    return table


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--tasks", default="cartpole,car,pvtol")
    parser.add_argument("--bounds", default="")
    parser.add_argument("--plans", type=int, default=100)
    parser.add_argument("--searched", type=int, default=10)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    for name in options.tasks.split(","):
        bounds = [float(bound) for bound in options.bounds.split(",") if bound]
        rows += study(name, options.plans, options.searched, bounds)
        Console(width=120).print(_printed(rows))
    if options.json:
        kept = json.loads(options.json.read_text())["rows"] if options.json.is_file() else []
        asked = {(row["task"], row["bound"]) for row in rows}
        rows += [row for row in kept if (row["task"], row["bound"]) not in asked]
        rows.sort(key=lambda row: (row["task"], row["bound"]))
        write_atomic(options.json, json.dumps({"policy": _POLICY, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
