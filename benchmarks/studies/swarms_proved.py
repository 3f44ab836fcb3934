"""Whether anybody meets with the proved filter, in every preset, however many agents there are.

Flies (c) with the filter that has a proof in every cell of `CELLS` (preset, agents, bound,
disturbance), in the first worlds of seed 1. Beside two kinds of the benchmark there is "nearest":
each agent is pushed at every instant with all of d_bar towards the surface that is nearest to where
it would stop, divided between position and velocity as moves the filter's answer farthest. Least
gaps are of surfaces, at the control instants. A cell that the file has is not flown again.

    python benchmarks/studies/swarms_proved.py [--cells swarm,gcbf] [--agents 32,128] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from lagros_envs.arrays import FloatArray
from lagros_envs.balls import onto_unit_sphere
from lagros_envs.disturbances import Situation
from lagros_envs.files import write_atomic
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.spacecraft.scenarios import Scenario, preset_named
from lagros_envs.tasks.spacecraft.task import settings_for
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftLagrosPolicy
from lagros_policies.tasks.spacecraft.proved_filter import ProvedFilter
from lagros_policies.tasks.spacecraft.reserved import Reserved, reserved_for

SEED = 1
AGENTS = 120  # that make a cell, at least
CLOSEST = 4  # centres of obstacles among which the nearest surface is looked for


class Cell(NamedTuple):
    """What is flown together.

    Attributes:
        preset: Name of the preset.
        agents: N.
        bound: d_bar.
        disturbance: "nearest", or a kind of the benchmark.
    """

    preset: str
    agents: int
    bound: float
    disturbance: str


KINDS = ("uniform", "constant", "nearest")
CELLS = tuple(
    Cell(preset, agents, bound, kind)
    for preset, agents, bound, kinds in (
        ("paper", 6, 0.4, KINDS),
        ("crossing", 6, 0.4, KINDS),
        ("open", 6, 0.4, KINDS),
        ("swarm-45", 32, 0.4, KINDS),
        ("swarm", 32, 0.4, KINDS),
        ("swarm", 128, 0.4, KINDS),
        ("gcbf", 8, 0.4, ("uniform", "nearest")),
        ("gcbf", 8, 0.2, KINDS),
        ("gcbf-free", 8, 0.2, ("uniform", "nearest")),
        ("swarm", 1024, 0.4, ("nearest",)),
        ("gcbf", 128, 0.2, ("nearest",)),
        ("swarm", 512, 0.4, ("nearest",)),
        ("gcbf", 1024, 0.2, ("nearest",)),
    )
    for kind in kinds
)


def to_nearest(points: FloatArray, scene: Scenario) -> tuple[FloatArray, FloatArray]:
    """Return from each point of an agent (n, 2) to the nearest surface, and how far it is, (n,)."""
    place, index = cKDTree(points).query(points, k=2)
    # Of two in one place either may come first.
    other = np.where(index[:, 0] == np.arange(len(points)), index[:, 1], index[:, 0])
    way, gap = points[other] - points, place[:, 1] - 2.0 * scene.agent_radius
    count = min(CLOSEST, len(scene.obstacles))
    if count:
        far, index = cKDTree(scene.obstacles).query(points, k=range(1, count + 1))
        away = far - scene.obstacle_radii[index] - scene.core
        best = np.argmin(away, axis=1), np.arange(len(points))
        nearest = index[best[1], best[0]]
        nearer = away[best[1], best[0]] < gap
        way = np.where(nearer[:, None], scene.obstacles[nearest] - points, way)
        gap = np.where(nearer, away[best[1], best[0]], gap)
    return way, gap


class Nearest:
    """Pushes every agent towards the surface nearest to where it would stop."""

    def __init__(self, reserved: Reserved) -> None:
        self.beta = reserved.reserve.stopping_time
        self.env: SpacecraftVectorEnv | None = None
        # A steady d moves p - p_n by (k_v d_p + d_v) / k_p.
        self.shares = onto_unit_sphere(np.array([reserved.gain.damping, 1.0]), np.zeros(2))

    def __call__(self, situation: Situation) -> FloatArray:
        """Return directions of length one, shape (worlds, agents, 6)."""
        assert self.env is not None
        state = situation.state
        push = np.zeros(state.shape)
        for world, scene in enumerate(self.env.scenarios):
            assert scene is not None
            points = state[world, :, :2] + self.beta * state[world, :, 3:5]
            way = onto_unit_sphere(to_nearest(points, scene)[0], np.array([1.0, 0.0]))
            push[world, :, :2], push[world, :, 3:5] = self.shares[0] * way, self.shares[1] * way
        return push


def fly(cell: Cell) -> dict[str, Any]:
    """Fly a cell and return its row."""
    count = -(-AGENTS // cell.agents)
    preset = preset_named(cell.preset).for_agents(cell.agents)
    settings = settings_for(preset)
    pusher = Nearest(reserved_for(settings, preset, cell.bound))
    given: Any = pusher if cell.disturbance == "nearest" else cell.disturbance
    env = SpacecraftVectorEnv(
        *(count * cell.agents, cell.agents, cell.preset, given, cell.bound),
        compiled=False,
        autoreset_mode="disabled",
    )
    pusher.env = env
    inner = SpacecraftLagrosPolicy(env.settings, env.preset)
    policy: Any = ProvedFilter(inner, env.settings, env.preset, disturbance_bound=cell.bound)
    observation, info = env.reset(seed=episode_seeds(SEED, count, EVALUATION))
    state, least = None, np.inf
    for _ in range(env.settings.steps):
        action, state = policy.predict(observation, state)
        observation, _, _, _, info = env.step(action)
        for places, scene in zip(env.states[..., :2], env.scenarios, strict=True):
            assert scene is not None
            least = min(least, float(to_nearest(places, scene)[1].min()))
    success, collided = info["success"], info["collided"]
    return cell._asdict() | {
        "worlds": count,
        "time_limit_s": env.settings.time_limit,
        "clearance_m": policy.reserved.reserve.clearance,
        "nominal_speed_m_s": policy.reserved.speed,
        "collided": int(collided.sum()),
        "safe_rate": float(1.0 - collided.mean()),
        "least_gap_m": least,
        "success_rate": float(success.mean()),
        "reached_rate": float(info["reached"].mean()),
        "effort_mean": float(info["effort_to_success"].mean()),
        "counters": policy.counters(state),
    }


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="(c) with the proved filter")
    for heading in (
        *("preset", "N", "d̄", "disturbance", "agents", "collided", "safe %", "least gap m"),
        *("success %", "effort", "infeasible"),
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row["preset"],
            str(row["agents"]),
            f"{row['bound']:g}",
            row["disturbance"],
            str(row["agents"] * row["worlds"]),
            str(row["collided"]),
            f"{100 * row['safe_rate']:.1f}",
            f"{row['least_gap_m']:.3f}",
            f"{100 * row['success_rate']:.1f}",
            f"{row['effort_mean']:.2f}",
            str(row["counters"]["infeasible"]),
        )
    Console(width=120).print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Fly (c) with the proved filter.")
    parser.add_argument("--cells", help="presets to fly, by commas; all if left out")
    parser.add_argument("--agents", help="numbers of agents to fly, by commas; all if left out")
    parser.add_argument("--json", type=Path, help="keep the rows there")
    options = parser.parse_args()
    presets = None if options.cells is None else options.cells.split(",")
    numbers = None if options.agents is None else list(map(int, options.agents.split(",")))
    kept = options.json is not None and options.json.exists()
    rows = json.loads(options.json.read_text())["rows"] if kept else []
    for cell in CELLS:
        wanted = (presets is None or cell.preset in presets) and (
            numbers is None or cell.agents in numbers
        )
        if not wanted or cell in {Cell(*(row[name] for name in Cell._fields)) for row in rows}:
            continue
        rows.append(fly(cell))
        rows.sort(key=lambda row: CELLS.index(Cell(*(row[name] for name in Cell._fields))))
        if options.json is not None:
            command = f"python benchmarks/studies/swarms_proved.py --json {options.json}"
            text = json.dumps({"command": command, "seed": SEED, "rows": rows}, indent=1)
            write_atomic(options.json, text + "\n")
    show(rows)


if __name__ == "__main__":
    main()
