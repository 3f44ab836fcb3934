"""How long the spacecraft's network takes to decide: one agent, the six of a world, many worlds.

Times `predict` of (c) on observations met in flight, with and without the safety filter; medians
over calls, the batch sizes by turns. What one agent senses decides its time, so every call takes
other observations.

    OMP_NUM_THREADS=1 python benchmarks/speed/spacecraft_policies.py [--calls 2000] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lagros_policies
from lagros_envs.files import write_atomic
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter

_WORLDS, _AGENTS = 64, 6
_EVERY = 15  # steps between the observations that are kept


def observations(policy: Any, env: SpacecraftVectorEnv) -> NDArray[np.float32]:
    """Fly and return what was observed, shape (instants, worlds * agents, o)."""
    observation, _ = env.reset(seed=list(range(_WORLDS)))
    kept = []
    for step in range(env.settings.steps):
        if step % _EVERY == 0:
            kept.append(observation)
        observation, *_ = env.step(policy.predict(observation)[0])
    return np.stack(kept)


def main() -> None:
    """Time and print."""
    parser = argparse.ArgumentParser(description="Time the spacecraft's network.")
    parser.add_argument("--calls", type=int, default=2000)
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    env = SpacecraftVectorEnv(
        _WORLDS * _AGENTS, _AGENTS, "paper", "uniform", 0.4, autoreset_mode="disabled"
    )
    plain = lagros_policies.make("lagros", env)
    filtered = SafetyFilter(plain, env.settings, env.preset, disturbance_bound=0.4)
    seen = observations(plain, env)
    rng = np.random.default_rng(0)
    sizes = (1, _AGENTS, _WORLDS * _AGENTS)
    times: dict[tuple[str, int], list[float]] = {}
    for call in range(options.calls):
        for size in sizes:
            if size == sizes[-1] and call % 20:
                continue
            first = int(rng.integers(_WORLDS * _AGENTS // size)) * size
            rows = seen[rng.integers(len(seen)), first : first + size]
            for name, policy in (("lagros", plain), ("lagros + filter", filtered)):
                begun = perf_counter()
                policy.predict(rows)
                times.setdefault((name, size), []).append(perf_counter() - begun)
    rows_out = [
        {
            "policy": name,
            "batch": size,
            "median_us": 1e6 * float(np.median(values)),
            "p99_us": 1e6 * float(np.quantile(values, 0.99)),
            "per_agent_us": 1e6 * float(np.median(values)) / size,
        }
        for (name, size), values in times.items()
    ]
    for row in rows_out:
        print(
            f"{row['policy']:>16}, {row['batch']:>3} agents in a call: median "
            f"{row['median_us']:.0f} us, p99 {row['p99_us']:.0f} us, "
            f"{row['per_agent_us']:.1f} us per agent"
        )
    if options.json is not None:
        write_atomic(options.json, json.dumps(rows_out, indent=1) + "\n")


if __name__ == "__main__":
    main()
