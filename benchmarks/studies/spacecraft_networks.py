"""What the rounds of training bring, and what a larger network would.

Flies every network of a folder of `lagros reproduce spacecraft` in the preset `paper` under uniform
disturbance, with and without the safety filter, on worlds of a namespace of their own: neither
those of training nor those of the published tables. With `--width` a network of that width is
fitted to the flights of the folder first, with `--seeds` networks of other seeds.

    python benchmarks/studies/spacecraft_networks.py [--folder runs/reproduce-spacecraft]
        [--worlds 60] [--bound 0.2,0.6,1.0] [--width 200] [--seeds 3] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from lagros_benchmarks.run.metrics import wilson_interval
from lagros_benchmarks.tasks.spacecraft.reproduce import SpacecraftReproduceSettings, training_part
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.learning.train_deep_set import fit_deep_set, join
from lagros_policies.tasks.spacecraft.flights import flight_samples, fly_expert
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftNetworkPolicy
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter

AGENTS = 6
STUDY = 4242  # namespace of the worlds of this study


def fly(weights: Path, bound: float, worlds: int, filtered: bool) -> dict[str, Any]:
    """Fly one network in all worlds side by side and return its figures."""
    env = SpacecraftVectorEnv(
        worlds * AGENTS,
        AGENTS,
        "paper",
        "uniform",
        bound,
        compiled=False,
        autoreset_mode="disabled",
    )
    policy: Any = SpacecraftNetworkPolicy(env.settings, env.preset, weights=weights)
    if filtered:
        policy = SafetyFilter(policy, env.settings, env.preset, disturbance_bound=bound)
    observation, info = env.reset(seed=episode_seeds(555, worlds, STUDY))
    state = None
    for _ in range(env.settings.steps):
        action, state = policy.predict(observation, state)
        observation, _, _, _, info = env.step(action)
    success, collided = info["success"], info["collided"]
    return {
        "network": weights.stem,
        "bound": bound,
        "safety_filter": filtered,
        "worlds": worlds,
        "success_rate": float(success.mean()),
        "success_ci95": list(wilson_interval(int(success.sum()), success.size)),
        "collision_rate": float(collided.mean()),
        "stuck_rate": float((~success & ~collided).mean()),
        "effort_mean": float(info["effort_to_success"].mean()),
    }


def fit_other(folder: Path, seed: int, width: int) -> Path:
    """Fit a network of another seed or width to the flights of the folder; return its file."""
    settings, task = SpacecraftReproduceSettings(), SpacecraftSettings()
    weights = folder / f"seed{seed}_width{width}.safetensors"
    if weights.exists():
        return weights
    parts = [fly_expert(folder / "flights", settings.flights, task)]
    for index, flights in enumerate(settings.rounds, start=1):
        learner = folder / f"spacecraft_round{index - 1}.safetensors"
        met = fly_expert(folder / f"relabelled{index}", flights, task, learner)
        parts += [training_part(met, settings)] * settings.relabelled_weight
    samples = join([flight_samples(part, task, 0.25, 0.25) for part in parts])
    layers = (width, width)
    training = replace(settings.lagros, element=layers, agent=layers, seed=seed)
    network: DeepSet = fit_deep_set(samples, training, weights.with_suffix(".checkpoint"))
    network.save(weights)
    return weights


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="networks of the spacecraft, preset paper, 6 agents, uniform disturbance")
    for heading in ("network", "d̄", "filter", "success %", "collided %", "stuck %", "effort"):
        table.add_column(heading, justify="right")
    for row in rows:
        low, high = row["success_ci95"]
        table.add_row(
            row["network"],
            f"{row['bound']:g}",
            "yes" if row["safety_filter"] else "no",
            f"{100 * row['success_rate']:.1f} [{100 * low:.1f}, {100 * high:.1f}]",
            f"{100 * row['collision_rate']:.1f}",
            f"{100 * row['stuck_rate']:.1f}",
            f"{row['effort_mean']:.2f}",
        )
    Console().print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Fly the networks of a reproduction.")
    parser.add_argument("--folder", type=Path, default=Path("runs/reproduce-spacecraft"))
    parser.add_argument("--worlds", type=int, default=60)
    parser.add_argument("--bound", default="0.2,0.6,1.0", help="disturbance bounds, by commas")
    parser.add_argument("--width", type=int, help="fit a network of this width too")
    parser.add_argument("--seeds", type=int, default=0, help="fit so many other seeds too")
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    networks = sorted(options.folder.glob("spacecraft_round*.safetensors"))
    networks.append(options.folder / "spacecraft_lagros.safetensors")
    seed, width = SpacecraftReproduceSettings().lagros.seed, 100
    networks += [fit_other(options.folder, seed + 1 + one, width) for one in range(options.seeds)]
    if options.width is not None:
        networks.append(fit_other(options.folder, seed, options.width))
    rows = [
        fly(weights, float(bound), options.worlds, filtered)
        for weights in networks
        for filtered in (False, True)
        for bound in options.bound.split(",")
    ]
    show(rows)
    if options.json is not None:
        write_atomic(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
