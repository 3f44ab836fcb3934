"""How success, effort and time of policy (c) depend on the number of agents.

Flies (c) in every cell of `CELLS` (preset, agents, bound, with or without the safety filter) under
uniform disturbance, in the first worlds of seed 1 that the benchmark flies too, as many as hold 640
agents. Rates are per agent, collisions are counted to the end. `gcbf` presets are measured as the
authors of GCBF+ do: safe (never touched), reached (at the goal, ever) and both. The time is that of
one call for all agents, policy and filter, over their number: median of the calls, processor time.
A cell that the file has is not flown again.

    python benchmarks/studies/swarms.py [--cells swarm,gcbf] [--agents 32,128] [--plot FILE]
        [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from lagros_benchmarks.run.metrics import wilson_interval
from lagros_envs.files import write_atomic
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftLagrosPolicy
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter

SEED = 1
AGENTS = 640  # that make a cell, at least
BATCH = 1024  # agents that fly side by side at most
# GCBF+, arXiv 2401.14554 and its released network, double integrator: reached and never touched
# [%] by number of agents, N obstacles and free; and at the density of `swarm` with obstacles.
ANCHOR = {
    "gcbf": {8: 98.8, 32: 99.4, 128: 98.1},
    "gcbf-free": {8: 100.0, 32: 100.0, 128: 99.7},
    "swarm": {128: 53.5},
}
ANCHOR_TIME = (100.0, 180.0)  # of an agent and step [us]
# Colours that the colour-blind tell apart (Okabe and Ito), and marks for who sees none.
STYLES = {
    "swarm": ("#0072b2", "o"),
    "swarm-45": ("#56b4e9", "X"),
    "gcbf": ("#d55e00", "s"),
    "gcbf-free": ("#009e73", "^"),
    "paper": ("#000000", "D"),
}


class Cell(NamedTuple):
    """What is flown together.

    Attributes:
        preset: Name of the preset.
        agents: N.
        bound: d_bar.
        filtered: Whether the safety filter flies along.
        crowds: Whether the network of crowds flies where it is not the usual one.
    """

    preset: str
    agents: int
    bound: float
    filtered: bool
    crowds: bool = False


CELLS = tuple(
    Cell(preset, agents, bound, filtered, crowds)
    for preset, numbers, bound, filtered in (
        ("swarm", (32, 128, 512, 1024), 0.4, True),
        ("swarm", (32, 128), 0.4, False),
        ("swarm-45", (32,), 0.4, True),
        ("gcbf", (8, 32, 128, 512, 1024), 0.4, True),
        ("gcbf", (8, 32, 128, 512, 1024), 1.0, True),
        ("gcbf", (8,), 0.4, False),
        ("gcbf-free", (8, 32, 128, 512, 1024), 0.4, True),
        *(("paper", (6,), bound, True) for bound in (0.2, 0.4, 1.0)),
        *(("paper", (6,), bound, False) for bound in (0.2, 0.4, 1.0)),
    )
    for agents in numbers
    for crowds in ((False, True) if preset == "paper" else (False,))
)


_PAPER = Cell("paper", 6, 0.4, True)  # what is drawn of that preset


def worlds_of(cell: Cell) -> int:
    """Return how many worlds make a cell."""
    return -(-AGENTS // cell.agents)


def fly(cell: Cell) -> dict[str, Any]:
    """Fly a cell and return its row."""
    count = worlds_of(cell)
    seeds = episode_seeds(SEED, count, EVALUATION)
    most = max(1, BATCH // cell.agents)
    parts = [_batch(cell, seeds[begin : begin + most]) for begin in range(0, count, most)]
    agents = {name: np.concatenate([part[0][name] for part in parts]) for name in parts[0][0]}
    success, collided = agents["success"], agents["collided"]
    counters = {name: sum(part[1][name] for part in parts) for name in parts[0][1]}
    row: dict[str, Any] = cell._asdict() | {
        "worlds": count,
        "horizon_s": parts[0][3],
        "time_limit_s": parts[0][4],
        "success_rate": float(success.mean()),
        "success_ci95": list(wilson_interval(int(success.sum()), success.size)),
        "safe_rate": float(1.0 - collided.mean()),
        "reached_rate": float(agents["reached"].mean()),
        "safe_reached_rate": float((agents["reached"] & ~collided).mean()),
        "late_rate": float((~success & ~collided).mean()),
        "effort_mean": float(agents["effort_to_success"].mean()),
        "step_time_per_agent_us": float(np.median(np.concatenate([part[2] for part in parts]))),
        "counters": counters,
    }
    return row


def _batch(
    cell: Cell, seeds: list[int]
) -> tuple[dict[str, Any], dict[str, int], list[float], float, float]:
    env = SpacecraftVectorEnv(
        *(len(seeds) * cell.agents, cell.agents, cell.preset, "uniform", cell.bound),
        compiled=False,
        autoreset_mode="disabled",
    )
    receding = True if cell.crowds else None
    policy: Any = SpacecraftLagrosPolicy(env.settings, env.preset, receding=receding)
    if cell.filtered:
        policy = SafetyFilter(policy, env.settings, env.preset, disturbance_bound=cell.bound)
    observation, info = env.reset(seed=seeds)
    state, times = None, []
    for _ in range(env.settings.steps):
        begun = time.thread_time()
        action, state = policy.predict(observation, state)
        times.append(1e6 * (time.thread_time() - begun) / len(observation))
        observation, _, _, _, info = env.step(action)
    names = ("success", "collided", "reached", "effort_to_success")
    ends = env.settings.horizon, env.settings.time_limit
    return {name: info[name] for name in names}, policy.counters(state), times, *ends


def _cell_of(row: dict[str, Any]) -> Cell:
    return Cell(*(row[name] for name in Cell._fields))


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="(c) in worlds of many, uniform disturbance")
    for heading in (
        *("preset", "N", "d̄", "filter", "T, limit s", "success % [95 %]"),
        *("safe, reached, both %", "effort", "µs", "detours / agent"),
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        low, high = row["success_ci95"]
        rates = (row["safe_rate"], row["reached_rate"], row["safe_reached_rate"])
        detours = row["counters"].get("detours")
        table.add_row(
            row["preset"] + (" (crowds)" if row["crowds"] else ""),
            str(row["agents"]),
            f"{row['bound']:g}",
            "yes" if row["filtered"] else "no",
            f"{row['horizon_s']:.0f}, {row['time_limit_s']:.0f}",
            f"{100 * row['success_rate']:.1f} [{100 * low:.1f}, {100 * high:.1f}]",
            " ".join(f"{100 * rate:.1f}" for rate in rates),
            f"{row['effort_mean']:.2f}",
            f"{row['step_time_per_agent_us']:.1f}",
            "–" if detours is None else f"{detours / (row['worlds'] * row['agents']):.2f}",
        )
    Console(width=140).print(table)


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw success, effort and time against the number of agents."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(10.0, 3.4), layout="constrained")
    rows = [row for row in rows if row["preset"] != "paper" or _cell_of(row) == _PAPER]
    for kind in dict.fromkeys((row["preset"], row["bound"], row["filtered"]) for row in rows):
        preset, bound, filtered = kind
        line = [row for row in rows if (row["preset"], row["bound"], row["filtered"]) == kind]
        colour, marker = STYLES[preset]
        style: dict[str, Any] = {
            "label": f"{preset}, d̄ = {bound:g}" + ("" if filtered else ", no filter"),
            "color": colour,
            "marker": marker,
            "linestyle": ":" if not filtered else "--" if bound == 1.0 else "-",
            "fillstyle": "full" if filtered else "none",
        }
        rate = "safe_reached_rate" if preset.startswith("gcbf") else "success_rate"
        numbers = [row["agents"] for row in line]
        axes[0].plot(numbers, [100 * row[rate] for row in line], **style)
        axes[1].plot(numbers, [row["effort_mean"] for row in line], **style)
        axes[2].plot(numbers, [row["step_time_per_agent_us"] for row in line], **style)
    for preset, published in ANCHOR.items():
        marker = STYLES[preset][1]
        label = f"GCBF+, {preset}, d̄ = 0"
        style = {"color": "grey", "marker": marker, "linestyle": "-.", "fillstyle": "none"}
        axes[0].plot(list(published), list(published.values()), label=label, **style)
    axes[2].axhspan(*ANCHOR_TIME, color="grey", alpha=0.3, label="GCBF+")
    titles = ("success [%]", "effort to success [N²s]", "Δt per agent [µs]")
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xscale="log", xlabel="agents", title=title)
    axes[2].set_yscale("log")
    axes[2].legend(*(part[-1:] for part in axes[2].get_legend_handles_labels()), fontsize=7)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Fly (c) in worlds of many.")
    parser.add_argument("--cells", help="presets to fly, by commas; all if left out")
    parser.add_argument("--agents", help="numbers of agents to fly, by commas; all if left out")
    parser.add_argument("--json", type=Path, help="keep the rows there")
    parser.add_argument("--plot", type=Path, help="draw all rows there")
    options = parser.parse_args()
    presets = None if options.cells is None else options.cells.split(",")
    numbers = None if options.agents is None else list(map(int, options.agents.split(",")))
    kept = options.json is not None and options.json.exists()
    rows = json.loads(options.json.read_text())["rows"] if kept else []
    done = {_cell_of(row) for row in rows}
    for cell in CELLS:
        wanted = (presets is None or cell.preset in presets) and (
            numbers is None or cell.agents in numbers
        )
        if not wanted or cell in done:
            continue
        rows.append(fly(cell))
        rows.sort(key=lambda row: CELLS.index(_cell_of(row)))
        if options.json is not None:
            command = f"python benchmarks/studies/swarms.py --json {options.json}"
            text = json.dumps({"command": command, "seed": SEED, "rows": rows}, indent=1)
            write_atomic(options.json, text + "\n")
    show(rows)
    if options.plot is not None:
        plot(rows, options.plot)


if __name__ == "__main__":
    main()
