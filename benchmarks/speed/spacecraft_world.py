"""Agent-steps per second of batched spacecraft worlds, with sensing, disturbance and info.

    OMP_NUM_THREADS=1 python benchmarks/speed/spacecraft_world.py [--sizes 1x128,1x1024,64x32]
        [--preset swarm] [--json benchmarks/results/spacecraft_world_speed.json]
    OMP_NUM_THREADS=1 python benchmarks/speed/spacecraft_world.py --thresholds

Zero actions, uniform disturbance of 0.4; a step returns observations, rewards and info of all
agents as arrays. Processor time of this process: the median and the least of the rounds, which take
turns, so that a busy machine meets all sizes alike. The second command compares cells with all
pairs: from which number on cells are faster is what `tasks/spacecraft/nearby.py` says.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from lagros_envs.dynamics.held import has_numba
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_streams
from lagros_envs.tasks.spacecraft.nearby import Nearby
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

_STEPS = 20
_SPEED = 0.4  # of agents on their way [m/s]
_SIZES = "1x128,1x512,1x1024,64x32,256x6"
_COUNTS = (4, 8, 12, 16, 24, 32, 48, 64, 96, 128)


def stepping(worlds: int, agents: int, preset: str, compiled: bool) -> Callable[[], float]:
    """Return a function that steps worlds and returns the processor time of one step [s]."""
    env = SpacecraftVectorEnv(
        worlds * agents,
        agents,
        preset,
        "uniform",
        0.4,
        compiled=compiled,
        autoreset_mode="disabled",
    )
    nothing = np.zeros((worlds * agents, 8), np.float32)

    def steps() -> float:
        env.reset(seed=0)
        env.step(nothing)
        begun = process_time()
        for _ in range(_STEPS):
            env.step(nothing)
        return (process_time() - begun) / _STEPS

    steps()
    return steps


def drawing(agents: int, preset: str) -> Callable[[], float]:
    """Return a function that draws a scenario and returns its processor time [s]."""
    seeds = iter(range(10**6))

    def draw() -> float:
        stream = episode_streams(next(seeds)).scenario
        begun = process_time()
        PRESETS[preset].sample(stream, agents)
        return process_time() - begun

    return draw


def by_turns(candidates: dict[Any, Callable[[], float]], rounds: int) -> dict[Any, list[float]]:
    """Return the times of every candidate, one from each round."""
    times: dict[Any, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, one in candidates.items():
            times[name].append(one())
    return times


def measure(sizes: str, preset: str, rounds: int, plain: bool) -> list[dict[str, Any]]:
    """Return a row for each size and way of running it."""
    candidates: dict[Any, Callable[[], float]] = {}
    for size in sizes.split(","):
        worlds, agents = map(int, size.split("x"))
        for compiled in (False, True) if has_numba() and not plain else (False,):
            candidates[worlds, agents, compiled] = stepping(worlds, agents, preset, compiled)
        candidates[worlds, agents, None] = drawing(agents, preset)
    rows = []
    for (worlds, agents, compiled), times in by_turns(candidates, rounds).items():
        row: dict[str, Any] = {"preset": preset, "worlds": worlds, "agents": agents}
        if compiled is None:
            rows.append({**row, "what": "scenario", "seconds": float(np.median(times))})
            continue
        median, least = float(np.median(times)), min(times)
        rows.append(
            {
                **row,
                "what": "step",
                "numba": compiled,
                "step_ms": 1e3 * median,
                "least_step_ms": 1e3 * least,
                "agent_steps_per_second": worlds * agents / median,
                "best_agent_steps_per_second": worlds * agents / least,
            }
        )
    return rows


def thresholds(preset: str, rounds: int) -> None:
    """Print the times of looking up what is near, by cells and by all pairs."""
    candidates: dict[Any, Callable[[], float]] = {}
    for count in _COUNTS:
        for worlds in (1, 64):
            for by_cells in (False, True):
                candidates[worlds, count, by_cells] = looking(worlds, count, preset, by_cells)
    times = {name: np.median(found) for name, found in by_turns(candidates, rounds).items()}
    for worlds in (1, 64):
        for count in _COUNTS:
            pairs, cells = (1e6 * times[worlds, count, way] for way in (False, True))
            sys.stdout.write(
                f"{worlds:3} worlds x {count:4} agents: all pairs {pairs:8.0f} us, cells "
                f"{cells:8.0f} us\n"
            )


def looking(worlds: int, agents: int, preset: str, by_cells: bool) -> Callable[[], float]:
    """Return a function that looks up what is near and returns its processor time [s]."""
    env = SpacecraftVectorEnv(worlds * agents, agents, preset, compiled=False)
    env.reset(seed=0)
    world = env.world
    nearby = Nearby(
        env.settings.sensing_radius,
        world.parts[:2],
        world.goals,
        2.0 * world.agent_radius,
        world.obstacle_centres,
        world.obstacle_radii,
        world.core_radius,
        by_cells,
    )
    points = world.parts[:2]
    # As they fly: what is found is looked at again until somebody has moved too far.
    angle = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, points.shape[1:])
    move = _SPEED * env.settings.control_period * np.array([np.cos(angle), np.sin(angle)])
    way = [points + step * move for step in range(_STEPS)]

    def look() -> float:
        begun = process_time()
        for places in way:
            nearby.at(places, 0.05)
        return (process_time() - begun) / _STEPS

    return look


def main() -> None:
    """Print the table, and write the file that is asked for."""
    parser = argparse.ArgumentParser(description="Time batched spacecraft worlds.")
    parser.add_argument("--sizes", default=_SIZES, help="worlds x agents, with commas between")
    parser.add_argument("--preset", default="swarm", choices=sorted(PRESETS))
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--plain", action="store_true", help="without numba")
    parser.add_argument("--thresholds", action="store_true", help="cells beside all pairs")
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    if wanted.thresholds:
        thresholds(wanted.preset, wanted.rounds)
        return
    rows = measure(wanted.sizes, wanted.preset, wanted.rounds, wanted.plain)
    for row in rows:
        size = f"{row['worlds']:4} x {row['agents']:4}"
        if row["what"] == "scenario":
            sys.stdout.write(f"{size}  a scenario in {row['seconds']:.3f} s\n")
            continue
        sys.stdout.write(
            f"{size}  {'numba' if row['numba'] else 'NumPy'}  {row['step_ms']:7.2f} ms a step, "
            f"{row['agent_steps_per_second']:>11,.0f} agent-steps/s "
            f"(at best {row['best_agent_steps_per_second']:,.0f})\n"
        )
    if wanted.json:
        command = (
            "OMP_NUM_THREADS=1 python benchmarks/speed/spacecraft_world.py "
            f"--sizes {wanted.sizes} --preset {wanted.preset} --rounds {wanted.rounds}"
            f"{' --plain' if wanted.plain else ''}"
        )
        record: dict[str, Any] = {"command": command, "clock": "processor time"}
        record |= {"load": os.getloadavg()[0], "rows": rows}
        write_atomic(wanted.json, json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
