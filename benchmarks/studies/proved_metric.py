"""The metric that was made to be proved, in the loop beside the one that the policies use.

- Episodes of u* over the hold with its preference, for each of the two metrics, under the same
  disturbances: uniform in the ball, d_bar = 0.75.
- The share of random plans that stay in the box of the proof, and how far the others leave it.

    python benchmarks/studies/proved_metric.py [--episodes 200] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from lagros_benchmarks.tasks.cartpole.certify import metric_to_prove
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    draw_episodes,
    fly,
    random_pushes,
    tracking_law,
)
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import Metric, load_metric
from lagros_policies.expert import metric_of
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.proof import PROVED_BOX

_NAMESPACE = 41
_BOUND = 0.75


def loop(metric: Metric, drawn: Episodes) -> dict[str, Any]:
    """Fly every episode under u* of a metric; return counts, and the mean effort [N^2 s]."""
    law = tracking_law(CartPoleExpert(metric, law="tuned"), drawn)
    every = np.arange(len(drawn.seeds))
    flown = fly(drawn, law, every, random_pushes(drawn, "uniform", _BOUND))
    error = np.linalg.norm(flown.states - drawn.plans, axis=-1)
    times = drawn.settings.control_period * np.arange(error.shape[1])
    outside = error > drawn.settings.tube.radius(times)
    # At t = 0 error and radius are both zero.
    outside[:, 0] = False
    efforts = drawn.settings.control_period * np.sum(flown.controls**2, axis=(1, 2))
    return {
        "episodes": len(every),
        "fell": int(np.count_nonzero(flown.fallen)),
        "inside_at_the_end": int(np.count_nonzero(~outside[:, -1] & ~flown.fallen)),
        "left_on_the_way": int(np.count_nonzero(outside.any(axis=1))),
        "effort_mean": float(efforts.mean()),
    }


def plans_in_the_box(drawn: Episodes) -> dict[str, float]:
    """Return the share of plans that stay in the box of the proof, and the largest states."""
    largest = np.abs(drawn.plans).max(axis=1)
    box = PROVED_BOX
    limits = {ANGLE: box.angle, VELOCITY: box.velocity, ANGULAR_RATE: box.angular_rate}
    inside = np.all([largest[:, place] <= limit for place, limit in limits.items()], axis=0)
    return {
        "share": float(inside.mean()),
        "angle": float(largest[:, ANGLE].max()),
        "velocity": float(largest[:, VELOCITY].max()),
        "angular_rate": float(largest[:, ANGULAR_RATE].max()),
    }


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="The proved metric in the loop.")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--json", type=Path, default=None)
    wanted = parser.parse_args()
    drawn = draw_episodes(CartPoleExpert(), episode_seeds(0, wanted.episodes, _NAMESPACE))
    proved, _ = metric_to_prove(None)
    rows = {
        "proved": loop(load_metric(proved), drawn),
        "of the policies": loop(metric_of(CartPoleSettings()), drawn),
    }
    for name, row in rows.items():
        sys.stdout.write(
            f"metric {name}: {row['episodes']} episodes, {row['fell']} fell, "
            f"{row['inside_at_the_end']} inside the published tube at the end, "
            f"{row['left_on_the_way']} left it on the way, effort {row['effort_mean']:.3g} N^2 s\n"
        )
    plans = plans_in_the_box(drawn)
    sys.stdout.write(
        f"{100 * plans['share']:.0f} % of the plans stay in the box of the proof (any force); the "
        f"plans reach {plans['angle']:.2g} rad, {plans['velocity']:.2g} m/s and "
        f"{plans['angular_rate']:.2g} rad/s\n"
    )
    if wanted.json is not None:
        write_atomic(wanted.json, json.dumps({"loops": rows, "plans": plans}, indent=1) + "\n")


if __name__ == "__main__":
    main()
