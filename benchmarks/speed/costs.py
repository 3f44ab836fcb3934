"""What every task costs: its metric once, a plan of an episode, a call of (c), and the same in C.

    OMP_NUM_THREADS=1 python benchmarks/speed/costs.py [--plans 50] [--tasks car arm]
        [--json benchmarks/results/speed_costs.json]

Processor time on one thread, so that other processes on the machine count little. Plans are of
the first episodes that `lagros bench` flies, from their starts. One that does not hold counts
with the time that it took; how many hold stands beside. Of the calls, C compiled with plain -O2
and for this processor, the least of 20 medians of 4,200 calls is given: beside work on the other
thread of its core a call takes half as long again.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))

from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.files import write_atomic
from lagros_envs.registry import find_task, task_names
from lagros_envs.seeding import episode_streams
from lagros_envs.task import Task
from lagros_policies.export import exported_names, load_source
from lagros_policies.export.c99 import c_file
from lagros_policies.export.cost import c_time
from lagros_policies.learning.metric import metric_settings
from lagros_policies.planning.planner import planner_of

_TURNS = 20  # medians of calls
_NATIVE = ("-std=c99", "-O3", "-march=native", "-ffp-contract=fast")


def measure(task: Task, plans: int) -> dict[str, object]:
    """Return the times of a task [s]."""
    begun = time.process_time()
    metric = metric_settings(task).design(task)
    designed = time.process_time() - begun
    planner, times, held = planner_of(task), [], 0
    for seed in BenchmarkSettings.for_task(task.name, episodes=plans).episode_seeds():
        episode = task.sample(episode_streams(seed).scenario)
        begun = time.process_time()
        plan = planner.plan(episode.initial_state, episode.goal, discs=episode.discs)
        times.append(time.process_time() - begun)
        held += plan.solved
    check, network, calls = metric.verification, f"lagros-{task.name}", (math.nan,) * 3
    if network in exported_names():
        source = load_source(network)
        text = c_file(source)
        turns = [(*c_time(text, source), c_time(text, source, _NATIVE)[0]) for _ in range(_TURNS)]
        calls = tuple(np.min(turns, axis=0))
    return {
        "task": task.name,
        "metric_cpu_seconds": designed,
        "violations": None if check is None else check.violations,
        "plans": plans,
        "plans_that_hold": held,
        "plan_cpu_seconds_median": float(np.median(times)),
        "plan_cpu_seconds_p95": float(np.quantile(times, 0.95)),
        "call_cpu_us": 1e6 * float(calls[1]),
        "c_call_cpu_us": 1e6 * float(calls[0]),
        "c_native_call_cpu_us": 1e6 * float(calls[2]),
    }


def main() -> None:
    """Print the table and write the file that is asked for."""
    parser = argparse.ArgumentParser(description="Metric, plans and calls of every task.")
    parser.add_argument("--plans", type=int, default=50)
    parser.add_argument("--tasks", nargs="+", default=task_names())
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    rows = []
    for name in wanted.tasks:
        task = find_task(name)
        if isinstance(task, Task):
            row = measure(task, wanted.plans)
            rows.append(row)
            sys.stdout.write(
                f"{name:<14} metric {row['metric_cpu_seconds']:6.1f} s   plan, median "
                f"{row['plan_cpu_seconds_median']:.3f} s, p95 {row['plan_cpu_seconds_p95']:.3f} s, "
                f"{row['plans_that_hold']} of {row['plans']} hold   "
                f"call {row['call_cpu_us']:.1f} us, in C {row['c_call_cpu_us']:.2f} us, "
                f"native {row['c_native_call_cpu_us']:.2f} us\n"
            )
            sys.stdout.flush()
    if wanted.json:
        command = "OMP_NUM_THREADS=1 python benchmarks/speed/costs.py"
        text = json.dumps({"command": command, "rows": rows}, indent=1)
        write_atomic(wanted.json, text + "\n")


if __name__ == "__main__":
    main()
