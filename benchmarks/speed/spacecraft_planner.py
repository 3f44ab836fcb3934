"""The joint planner on random scenarios: python benchmarks/speed/spacecraft_planner.py.

Options: --preset NAME --worlds N --seed S --agents N --bound B. Prints the share of scenarios with
a plan, the time per plan and that of the processor, the clearance between nodes and the effort.
With a bound it plans as policy (d) does for it, with the preset's T and the expected error as
margin; without, with the planner's own settings. Start it on an idle machine, with
OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_policies.planning.joint.planner import JointPlanner
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy


def main() -> None:
    """Plan and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="paper", choices=sorted(PRESETS))
    parser.add_argument("--worlds", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--agents", type=int)
    parser.add_argument("--bound", type=float)
    options = parser.parse_args()
    planner = JointPlanner()
    if options.bound is not None:
        planner = CentralizedPolicy(
            preset=options.preset, num_agents=options.agents, disturbance_bound=options.bound
        ).planner
    rows = []
    for world in range(options.worlds):
        rng = np.random.default_rng([options.seed, world])
        scene = PRESETS[options.preset].sample(rng, options.agents)
        begun = time.process_time()
        plan = planner.plan(
            scene.starts,
            scene.goals,
            scene.obstacles,
            scene.obstacle_radii,
            scene.agent_radius,
            scene.core_radius,
        )
        spent = time.process_time() - begun
        full = plan.margin == planner.settings.margins[0]
        effort = float(np.mean(plan.effort))
        rows.append((plan.solved, plan.seconds, spent, plan.clearance, plan.attempts, full, effort))
        if not plan.solved:
            print(f"  world {world}: {plan.status}")
    solved, seconds, spent, clearance, attempts, full, effort = np.array(rows, dtype=float).T
    held = solved > 0
    print(
        f"{options.preset}: a plan in {np.mean(held):.1%} of {options.worlds} worlds, on the first "
        f"guess {np.mean(held & (attempts == 1)):.1%}, with the full margin "
        f"{np.mean(held & (full > 0)):.1%}"
    )
    print(
        f"  seconds: median {np.median(seconds):.2f}, p99 {np.quantile(seconds, 0.99):.2f}, "
        f"max {np.max(seconds):.2f}; of the processor median {np.median(spent):.2f}, "
        f"max {np.max(spent):.2f}"
    )
    if held.any():
        print(
            f"  clearance: least {np.min(clearance[held]):.3f} m, median "
            f"{np.median(clearance[held]):.3f} m; effort per agent {np.mean(effort[held]):.4f}"
        )


if __name__ == "__main__":
    main()
