"""The published worst cases: every policy, what `lagros attack` does to it.

    python benchmarks/studies/worst_case.py [--task cartpole|spacecraft] [--json FILE]

Finished attacks are kept in runs/worst_case/ with their sequences (.npz, for `lagros attack TASK
--replay FILE`), and a call that was interrupted goes on. Their names end with a hash of the
settings and of the task's weights and metrics, so that networks that were trained again are
attacked again; `--fresh` begins anew whatever was kept.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from lagros_benchmarks.evidence.calibration import pretrained_hash
from lagros_benchmarks.run.files import plain, write_json
from lagros_benchmarks.worst_case.attack import AttackSettings, run_attack
from lagros_benchmarks.worst_case.replay import save_worst_cases
from lagros_benchmarks.worst_case.search import SearchSettings
from lagros_envs.files import write_atomic

COMMAND = "python benchmarks/studies/worst_case.py"
FOLDER = Path("runs/worst_case")
_CARTPOLE = ("lagros", "tube-mpc", "lqr", "ppo", "learned")
_CARTPOLE_GOALS = (("tube", 0.3), ("success", 0.75), ("clearance", 0.3))
_CARTPOLE_SEARCH = SearchSettings(budget=300)
# Policy, filter, goals, worlds and flights per world: the planners' flights cost seconds each.
_SPACECRAFT: tuple[tuple[str, bool, tuple[str, ...], int, int], ...] = (
    ("centralized", False, ("tube", "success", "clearance"), 3, 58),
    ("lagros", False, ("success", "clearance"), 3, 58),
    ("lagros", True, ("success", "clearance"), 3, 58),
    ("centralized", True, ("success", "clearance"), 3, 42),
    ("tube-mpc", False, ("clearance",), 1, 10),
    ("tube-mpc", True, ("clearance",), 1, 10),
)
_SPACECRAFT_BOUND = 0.4


def attacks(task: str | None) -> list[AttackSettings]:
    """Return all attacks of a task, or of both."""
    cartpole = [
        AttackSettings("cartpole", policy, goal, bound, 8, search=_CARTPOLE_SEARCH)
        for policy in _CARTPOLE
        for goal, bound in _CARTPOLE_GOALS
    ]
    spacecraft = [
        AttackSettings(
            "spacecraft",
            policy,
            goal,
            _SPACECRAFT_BOUND,
            worlds,
            search=SearchSettings(budget=budget, population=16),
            safety_filter=filtered,
        )
        for policy, filtered, goals, worlds, budget in _SPACECRAFT
        for goal in goals
    ]
    return [one for one in [*cartpole, *spacecraft] if task in (None, one.task)]


def stem(settings: AttackSettings) -> str:
    """Return an attack in a word, which the names of its files begin with."""
    worn = "+filter" if settings.safety_filter else ""
    return f"{settings.task}-{settings.policy}{worn}-{settings.goal}-{settings.bound:g}"


def kept(settings: AttackSettings, fresh: bool) -> dict[str, Any]:
    """Return the row of an attack from its file, or attack and write it."""
    name = f"{stem(settings)}-{pretrained_hash(settings.task, settings)}"
    path = FOLDER / f"attack-{name}.json"
    if path.is_file() and not fresh:
        return dict(json.loads(path.read_text()))
    found = run_attack(settings)
    save_worst_cases(found.cases, FOLDER / f"{name}.npz")
    write_atomic(path, json.dumps(plain(found.row)))
    return dict(plain(found.row))


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="searched worst cases: share of episodes broken")
    for heading in ("task", "policy", "goal", "d̄", "flights", "random", "searched", "worst score"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row["task"],
            row["policy"] + ("+filter" if row["safety_filter"] else ""),
            row["goal"],
            f"{row['bound']:g}",
            f"{row['episodes']} × {row['flights_per_episode']}",
            f"{100 * row['random_broken_rate']:.0f} %",
            f"{100 * row['broken_rate']:.0f} %",
            "–" if row["score_worst"] is None else f"{row['score_worst']:.3g}",
        )
    Console(width=110).print(table)


def main() -> None:
    """Run the attacks from the command line."""
    parser = argparse.ArgumentParser(description="Attack every policy.")
    parser.add_argument("--task", choices=("cartpole", "spacecraft"))
    parser.add_argument("--fresh", action="store_true", help="forget the attacks kept")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/worst_case.json"))
    options = parser.parse_args()
    console = Console(stderr=True)
    rows = []
    for settings in attacks(options.task):
        console.print(stem(settings))
        rows.append(kept(settings, options.fresh))
    show(rows)
    write_json(
        options.json,
        {"command": COMMAND + (f" --task {options.task}" if options.task else ""), "rows": rows},
    )


if __name__ == "__main__":
    main()
