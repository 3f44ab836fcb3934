"""The part of the suite that searches: the worst disturbance found for every policy of a task."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lagros_benchmarks.run.experiment import Row
from lagros_benchmarks.run.fingerprints import fingerprint
from lagros_benchmarks.run.keeping import Kept
from lagros_benchmarks.run.library import SetupError, Toolbox
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.run.workers import Progress, gather
from lagros_benchmarks.worst_case.attack import AttackSettings, run_attack
from lagros_envs.task import Task
from lagros_policies.backends import running

# What is to be broken: the success of an episode, and how near the plan it stays.
SUCCESS, ERROR = "success", "error"
GOALS = (SUCCESS, ERROR)


def search_worst(
    run: BenchmarkSettings,
    task: Task,
    flights: int,
    folder: Path,
    progress: Progress | None = None,
) -> list[Row]:
    """Search the worst disturbance of every policy of a run, at its bound and for both goals.

    Every goal is searched and kept on its own, on episodes of `lagros attack`.

    Args:
        run: Policies, bound, seed, number of episodes, and where the work runs.
        task: Its task.
        flights: Budget of each episode.
        folder: Keeps what is finished.
        progress: Called after every search.

    Returns:
        A row for each policy and goal; of a policy that a search cannot fly it says why.

    Raises:
        BackendError: The backend is not there, or loses its workers.
    """
    attacks = [
        AttackSettings.for_task(
            task.name,
            "hybrid",
            flights,
            policy=policy,
            goal=goal,
            bound=run.bounds[0],
            episodes=run.episodes,
            seed=run.seed,
        )
        for policy in run.policies
        for goal in GOALS
    ]
    key = hashlib.sha256(
        repr([fingerprint(run, Toolbox()), *map(asdict, attacks)]).encode()
    ).hexdigest()
    kept = Kept.named(folder, task.name, key)
    with running(run.backend, run.jobs):
        return gather("worst found", searched, attacks, run.jobs, progress, run.backend, kept)


def searched(settings: AttackSettings) -> Row:
    """Return what one search came to, or why there is none."""
    row: Row = {
        "task": settings.task,
        "policy": settings.policy,
        "goal": settings.goal,
        "bound": settings.bound,
        "episodes": settings.episodes,
        "refused": None,
    }
    try:
        found = run_attack(settings).row
    except (SetupError, ValueError) as error:  # such as of a policy that keeps a memory
        return {**row, "refused": str(error)}
    return row | _figures(found)


def _figures(found: Row) -> dict[str, Any]:
    low, high = found["broken_ci95"]
    return {
        "flights_per_episode": found["flights_per_episode"],
        "success_rate": 1.0 - found["broken_rate"],
        "success_ci95": [1.0 - high, 1.0 - low],
        "error_per_bound": found.get("max_tracking_error_per_bound"),
        "errors": found["errors"],
        "seeds": [one["seed"] for one in found["outcomes"]],
        "scores": [one["score"] for one in found["outcomes"]],
    }


def worst_of(rows: Sequence[Row], task: str, policy: str, goal: str) -> Row | None:
    """Return the row of a search that flew; None where there is none."""
    wanted = task, policy, goal
    for row in rows:
        if (row["task"], row["policy"], row["goal"]) == wanted and row["refused"] is None:
            return row
    return None
