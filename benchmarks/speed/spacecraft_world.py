"""Agent-steps per second of the batched spacecraft world, with sensing, disturbance and info.

OMP_NUM_THREADS=1 python benchmarks/speed/spacecraft_world.py [--worlds 256] [--agents 6]
"""

from __future__ import annotations

import argparse
from time import perf_counter

import gymnasium as gym
import numpy as np

import lagros_envs  # noqa: F401  (registers the environments)

_STEPS = 60
_REPEATS = 5


def main() -> None:
    """Step random thrust through the vector environment and print the median of the repeats."""
    parser = argparse.ArgumentParser(description="Time the batched spacecraft world.")
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--agents", type=int, default=6)
    parser.add_argument("--plain", action="store_true", help="without numba")
    options = parser.parse_args()
    rows = options.worlds * options.agents
    envs = gym.make_vec(
        "lagros/Spacecraft-v0",
        num_envs=rows,
        num_agents=options.agents,
        disturbance="uniform",
        disturbance_bound=0.4,
        compiled=False if options.plain else None,
        autoreset_mode="disabled",
    )
    rng = np.random.default_rng(0)
    actions = rng.uniform(0.0, 0.2, size=(_STEPS, rows, 8)).astype(np.float32)
    # The first step compiles, or loads what was compiled.
    envs.reset(seed=0)
    envs.step(actions[0])
    rates = []
    for repeat in range(_REPEATS):
        envs.reset(seed=repeat)
        begun = perf_counter()
        for action in actions:
            envs.step(action)
        rates.append(_STEPS * rows / (perf_counter() - begun))
    print(
        f"{options.worlds} worlds x {options.agents} agents: "
        f"{np.median(rates):,.0f} agent-steps/s (least {min(rates):,.0f}; 500,000 asked)"
    )


if __name__ == "__main__":
    main()
