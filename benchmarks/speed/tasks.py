"""Many worlds of every task of one body beside Gymnasium's cart-poles, per derivative evaluated.

    OMP_NUM_THREADS=1 python benchmarks/speed/tasks.py [--worlds 1024] [--rounds 5]
        [--json benchmarks/results/speed_tasks.json]

Random actions, uniform disturbance, and every reset that they cause. A control step of ours
evaluates the equation 16 times (four Runge-Kutta substeps), one of CartPoleVectorEnv once. All are
timed by turns in one run; printed is the median over the rounds.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import gymnasium as gym

sys.path.append(str(Path(__file__).parents[1]))

import lagros_envs  # noqa: F401  (registers the ids)
from lagros_envs.files import write_atomic
from lagros_envs.registry import find_task, task_names
from lagros_envs.task import Task
from speed.learner import stepping_worlds, variants
from speed.timing import Candidate, interleave

_EVALUATIONS = 16
_STEPS = 20
_PEER = "CartPoleVectorEnv"


def measure(worlds: int, rounds: int) -> list[dict[str, object]]:
    """Return a row for each task and way of running it."""
    theirs = gym.make_vec("CartPole-v1", worlds, vectorization_mode="vector_entry_point")
    candidates: dict[str, Candidate] = {_PEER: stepping_worlds(theirs, _STEPS)}
    for name in task_names():
        task = find_task(name)
        if isinstance(task, Task):
            for way, settings in variants("compiled").items():
                env = gym.make_vec(task.env_id, worlds, disturbance="uniform", **settings)
                candidates[f"{name}, {way}"] = stepping_worlds(env, _STEPS)
    times = interleave(candidates, rounds)
    # Each call returns its own mean time of a step.
    seconds = {
        name: sorted(found.results)[len(found.results) // 2] for name, found in times.items()
    }
    return [
        {
            "task": name,
            "steps_per_second": worlds / found,
            "ratio": seconds[_PEER] / found,
            "ratio_per_derivative": _EVALUATIONS * seconds[_PEER] / found,
        }
        for name, found in seconds.items()
        if name != _PEER
    ]


def main() -> None:
    """Print the table and write the file that is asked for."""
    parser = argparse.ArgumentParser(description="Worlds of every task, per derivative.")
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    rows = measure(wanted.worlds, wanted.rounds)
    for row in rows:
        sys.stdout.write(
            f"{row['task']:<26} {row['steps_per_second']:>12,.0f} steps/s   "
            f"{row['ratio_per_derivative']:.2f} per derivative\n"
        )
    if wanted.json:
        command = "OMP_NUM_THREADS=1 python benchmarks/speed/tasks.py"
        text = json.dumps({"command": command, "worlds": wanted.worlds, "rows": rows}, indent=1)
        write_atomic(wanted.json, text + "\n")


if __name__ == "__main__":
    main()
