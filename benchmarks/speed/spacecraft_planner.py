"""The joint planner on random scenarios: python benchmarks/speed/spacecraft_planner.py.

Options: --preset NAME --worlds N --seed S --agents N. Prints the share of scenarios with a plan,
the time per plan, the clearance between nodes and the effort. Start it on an idle machine, with
OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse

import numpy as np

from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_policies.planning.joint.planner import JointPlanner


def main() -> None:
    """Plan and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="paper", choices=sorted(PRESETS))
    parser.add_argument("--worlds", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--agents", type=int)
    options = parser.parse_args()
    planner = JointPlanner()
    rows = []
    for world in range(options.worlds):
        rng = np.random.default_rng([options.seed, world])
        scene = PRESETS[options.preset].sample(rng, options.agents)
        plan = planner.plan(
            scene.starts,
            scene.goals,
            scene.obstacles,
            scene.obstacle_radii,
            scene.agent_radius,
            scene.core_radius,
        )
        full = plan.margin == planner.settings.margins[0]
        effort = float(np.mean(plan.effort))
        rows.append((plan.solved, plan.seconds, plan.clearance, plan.attempts, full, effort))
        if not plan.solved:
            print(f"  world {world}: {plan.status}")
    solved, seconds, clearance, attempts, full, effort = np.array(rows, dtype=float).T
    held = solved > 0
    print(
        f"{options.preset}: a plan in {np.mean(held):.1%} of {options.worlds} worlds, on the first "
        f"guess {np.mean(held & (attempts == 1)):.1%}, with the full margin "
        f"{np.mean(held & (full > 0)):.1%}"
    )
    print(
        f"  seconds: median {np.median(seconds):.2f}, p99 {np.quantile(seconds, 0.99):.2f}, "
        f"max {np.max(seconds):.2f}"
    )
    if held.any():
        print(
            f"  clearance: least {np.min(clearance[held]):.3f} m, median "
            f"{np.median(clearance[held]):.3f} m; effort per agent {np.mean(effort[held]):.4f}"
        )


if __name__ == "__main__":
    main()
