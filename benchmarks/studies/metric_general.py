r"""Metrics that tasks describe, designed and checked: of the car and of the planar quadrotor.

- The car [x, y, heading, speed] is steered by turn rate and acceleration: the controls move all
  that its motion depends on, so that its metric is a function of x_d.
- The planar quadrotor (PVTOL) [p_x, p_z, roll, v_x, v_z, spin] in the body's axes: the rotors move
  v_z and spin, and its metric is a function of roll and v_x.

Each is designed by CV-STEM over a box in all coordinates, checked on fresh triples that the design
never saw, and then attacked by a search that follows the worst of them (observed, not proved).

    OMP_NUM_THREADS=1 python benchmarks/studies/metric_general.py \
        --json benchmarks/results/metric_general.json
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

from studies.planar import CAR

from lagros_envs import Task, find_task
from lagros_envs.checks import check_whole
from lagros_envs.files import write_atomic
from lagros_policies.contraction import certified_tube, search_violation
from lagros_policies.learning.metric import MetricSettings

_SEARCH = 3  # seed


def study(task: Task, checks: int) -> dict[str, Any]:
    """Design a metric, check it, and look for where it is worst."""
    begun = time.perf_counter()
    metric = MetricSettings(checks=checks).design(task)
    designed = time.perf_counter()
    _, worst = search_violation(task.system, metric, _SEARCH)
    assert metric.verification is not None
    return {
        "rate": metric.contraction_rate,
        "chi": metric.condition_bound,
        "nu": metric.control_weight,
        "functions": metric.phi.size,
        "tube_per_disturbance": certified_tube(metric, 1.0).steady_radius,
        "verification": asdict(metric.verification),
        "worst_searched": worst,
        "design_s": designed - begun,
    }


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Metrics of a car and of a planar quadrotor.")
    parser.add_argument("--checks", type=int, default=10_000)
    parser.add_argument("--json", type=Path, default=None)
    wanted = parser.parse_args()
    check_whole("checks", wanted.checks)
    tasks = {"car": CAR, "pvtol": cast(Task, find_task("pvtol"))}
    found = {name: study(task, wanted.checks) for name, task in tasks.items()}
    text = json.dumps(found, indent=1)
    sys.stdout.write(text + "\n")
    if wanted.json is not None:
        write_atomic(wanted.json, text + "\n")


if __name__ == "__main__":
    main()
