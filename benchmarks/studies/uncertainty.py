"""What a wrong model costs: every policy believes the paper's parameters, the truth is another.

Cart-pole: mass of cart and pole, friction of the cart and length of the pole times a factor; (c)
`lagros`, (b) as u* around a plan that is made once, the same with the adaptive law (friction
and mass of the cart unknown), `lqr` and `ppo`, the same episodes, uniform disturbance of bound 0.1.
Spacecraft: each thruster gives its command times a gain, or one gives nothing; (c) and (d), preset
`paper`, six agents, uniform disturbance of bound 0.4.

    OMP_NUM_THREADS=1 python benchmarks/studies/uncertainty.py [--episodes 100] [--worlds 10]
        [--only none,cart_mass,pole_mass,cart_friction,half_length,spacecraft]
        [--json benchmarks/results/uncertainty.json] [--figure benchmarks/results/uncertainty.png]

With `--only` the rows of the other parts are kept from the JSON file.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from studies.rollouts import Episodes, Law, fly, measures, plan_episodes

from lagros_benchmarks.report.canvas import canvas, check_figure_path, curve, save, styles
from lagros_benchmarks.run.metrics import cluster_rate_interval
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.actor import PpoPolicy
from lagros_policies.baselines import LqrPolicy
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.remarks.adaptive import AdaptiveControl, largest_gain
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.remarks import cart_mass_regressor, friction_regressor
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftLagrosPolicy

FloatArray = NDArray[np.float64]
Seen = Callable[[FloatArray, FloatArray, int], None]

PARAMETERS = ("cart_mass", "pole_mass", "cart_friction", "half_length")
FACTORS: dict[str, tuple[float, ...]] = dict.fromkeys(PARAMETERS, (0.5, 0.8, 1.25, 2.0))
FACTORS["cart_friction"] += (4.0,)
GAINS = (0.5, 1.0, 2.0)
_PARTS = ("none", *PARAMETERS, "spacecraft")
AGENTS = 6
_NAMESPACE, _STUDY = 25, 26
_BOUND, _SPACECRAFT_BOUND = 0.1, 0.4
# Largest regressors that the adaptation is prepared for: speed [m/s], acceleration [m/s^2].
_REACH = (1.5, 8.0)
_LIMITS = (3.0, 0.8)
_LEAKAGE = 0.02  # [1/s]


def network_law(policy: Any, episodes: Episodes, settings: task.CartPoleSettings) -> Law:
    """Return a law that shows a policy the observation of the environment."""
    rows = np.zeros((len(episodes.states), task.OBSERVATION_DIM), np.float32)
    rows[:, task.GOAL] = episodes.goals
    rows[:, task.INITIAL_STATE] = episodes.states[:, 0]

    def law(state: FloatArray, step: int) -> FloatArray:
        rows[:, task.STATE] = state
        rows[:, task.TIME] = step * settings.control_period
        action, _ = policy.predict(rows)
        return settings.force_scale * np.asarray(action, np.float64)

    return law


def tracking_law(
    expert: CartPoleExpert, episodes: Episodes, adapt: bool
) -> tuple[Law, Seen, list[FloatArray]]:
    """Return u* around the plans, what it does after a step, and its running estimate."""
    model, period = expert.task.system, expert.task.control_period
    plans = expert.track(episodes.states, episodes.controls)
    count = len(episodes.states)
    everyone = np.arange(count)
    mass_regressor = cart_mass_regressor(model)

    def regressor(state: FloatArray, control: FloatArray) -> FloatArray:
        parts = friction_regressor(state, control), mass_regressor(state, control)
        return np.concatenate(parts, axis=-1)

    gain = largest_gain(expert.law, _REACH) if adapt else (0.0, 0.0)
    adaptive = AdaptiveControl(expert.law, regressor, gain, _LEAKAGE, _LIMITS)
    # The estimate, and u* of the current step.
    memory = [np.zeros((count, 2)), np.zeros((count, 1))]

    def law(state: FloatArray, step: int) -> FloatArray:
        nominal, control = episodes.states[:, step], episodes.controls[:, step]
        preferred = expert.preference.deviation(
            plans.gains,
            everyone,
            np.full(count, step),
            state - nominal,
            np.full(count, step * period),
        )
        force, memory[1] = adaptive.control(state, nominal, control, memory[0], preferred)
        return force

    def seen(state: FloatArray, following: FloatArray, step: int) -> None:
        target = episodes.states[:, step + 1]
        memory[0] = adaptive.update(memory[0], state, memory[1], following, target)

    return law, seen, memory


def cartpole_study(count: int, parameters: Sequence[str]) -> list[dict[str, Any]]:
    """Fly every policy on every true system that has one of these parameters wrong."""
    expert = CartPoleExpert(law="tuned")
    settings = expert.task
    episodes = plan_episodes(expert, count, _NAMESPACE)
    policies = {"lagros": LagrosPolicy, "lqr": LqrPolicy, "ppo": PpoPolicy}
    laws = {
        name: network_law(build(settings), episodes, settings) for name, build in policies.items()
    }
    rows = []
    cases = [(name, factor) for name, factors in FACTORS.items() for factor in factors]
    for parameter, factor in [("none", 1.0), *cases]:
        if parameter not in parameters:
            continue
        truth = true_system(settings.system, parameter, factor)
        for name in ("lagros", "tube-mpc", "adaptive", "lqr", "ppo"):
            row = {
                "task": "cartpole",
                "policy": name,
                "parameter": parameter,
                "factor": factor,
                "bound": _BOUND,
            }
            if name in laws:
                flown = fly(episodes, laws[name], truth, settings, _BOUND)
            else:
                law, seen, memory = tracking_law(expert, episodes, name == "adaptive")
                after = seen if name == "adaptive" else None
                flown = fly(episodes, law, truth, settings, _BOUND, after)
                if name == "adaptive":
                    row["estimate_median"] = np.median(memory[0], axis=0).tolist()
            rows.append({**row, **measures(episodes, flown, settings)})
    return rows


def true_system(model: CartPole, parameter: str, factor: float) -> CartPole:
    """Return the model with one parameter times a factor."""
    if parameter == "none":
        return model
    changed: Any = {parameter: factor * getattr(model, parameter)}
    return replace(model, **changed)


def spacecraft_study(worlds: int) -> list[dict[str, Any]]:
    """Fly (c) and (d) with thrusters that do not give what they are asked for."""
    seeds = episode_seeds(0, worlds, _STUDY)
    dead = np.ones(8)
    dead[0] = 0.0
    cases = [(f"{gain:g}", np.full(8, gain)) for gain in GAINS] + [("one dead", dead)]
    env = SpacecraftVectorEnv(
        worlds * AGENTS,
        AGENTS,
        "paper",
        "uniform",
        _SPACECRAFT_BOUND,
        compiled=False,
        autoreset_mode="disabled",
    )
    lagros = SpacecraftLagrosPolicy(env.settings, env.preset)
    central = CentralizedPolicy(env.settings, "paper", AGENTS, disturbance_bound=_SPACECRAFT_BOUND)
    rows, plans = [], None
    for label, gain in cases:
        for policy in (lagros, central):
            memory: Any = plans if policy is central else None
            observation, info = env.reset(seed=seeds)
            spent = np.zeros(env.num_envs)
            for _ in range(env.settings.steps):
                seen = env.state() if policy is central else observation
                action, memory = policy.predict(seen, memory)
                asked = np.maximum(action.reshape(env.num_envs, -1), 0.0)
                on_way = ~info["success"]
                spent += on_way * np.sum(asked**2, axis=1) * env.settings.control_period
                observation, _, _, _, info = env.step((asked * gain).astype(np.float32))
            if policy is central:
                plans = memory
            success = info["success"].reshape(worlds, AGENTS)
            if policy is central:
                success = success & np.array([[plan.solved] for plan in memory])
            rows.append(
                {
                    "task": "spacecraft",
                    "policy": policy.name,
                    "gain": label,
                    "bound": _SPACECRAFT_BOUND,
                    "worlds": worlds,
                    "agents": AGENTS,
                    "success_rate": float(success.mean()),
                    "success_world_ci95": list(
                        cluster_rate_interval(success.sum(axis=1).tolist(), [AGENTS] * worlds)
                    ),
                    "collision_rate": float(info["collided"].mean()),
                    "commanded_effort_mean": float(spent.mean()),
                }
            )
    return rows


def show(rows: Sequence[dict[str, Any]]) -> None:
    """Print the tables."""
    console = Console(width=150)
    table = Table(title=f"cart-pole, wrong model, uniform disturbance, bound {_BOUND}")
    for heading in ("truth", "policy", "success %", "strict %", "fell %", "effort", "rms error"):
        table.add_column(heading, justify="right")
    craft = Table(title=f"spacecraft, wrong thrusters, uniform disturbance, {_SPACECRAFT_BOUND}")
    for heading in ("gain", "policy", "success %", "collided %", "effort asked for"):
        craft.add_column(heading, justify="right")
    for row in rows:
        if row["task"] == "cartpole":
            table.add_row(
                f"{row['parameter']} x {row['factor']:g}",
                row["policy"],
                f"{100 * row['success_rate']:.1f}",
                f"{100 * row['strict_success_rate']:.1f}",
                f"{100 * row['fall_rate']:.1f}",
                f"{row['effort_mean']:.4g}",
                f"{row['tracking_error_rms']:.3g}",
            )
        else:
            low, high = row["success_world_ci95"]
            craft.add_row(
                row["gain"],
                row["policy"],
                f"{100 * row['success_rate']:.1f} ({100 * low:.1f}-{100 * high:.1f})",
                f"{100 * row['collision_rate']:.1f}",
                f"{row['commanded_effort_mean']:.3g}",
            )
    console.print(table)
    console.print(craft)


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw strict success of the cart-pole against each factor."""
    mine = [row for row in rows if row["task"] == "cartpole"]
    policies = list(dict.fromkeys(row["policy"] for row in mine))
    figure, panels = canvas(8.0, 5.0, 2, 2, abscissa=False)
    for axes, parameter in zip(panels, PARAMETERS, strict=True):
        for index, (name, style) in enumerate(styles(policies).items()):
            own = [
                row
                for row in mine
                if row["policy"] == name and row["parameter"] in (parameter, "none")
            ]
            own.sort(key=lambda row: float(row["factor"]))
            # Policies of equal success would hide each other: each is moved by a little.
            shift = 1.012 ** (index - (len(policies) - 1) / 2)
            rates = 100 * curve([row["strict_success_rate"] for row in own])
            ends = 100 * np.array([row["strict_success_ci95"] for row in own])
            axes.errorbar(
                shift * curve([row["factor"] for row in own]),
                rates,
                yerr=np.abs(ends.T - rates),
                color=style.colour,
                linestyle=style.line,
                marker=style.marker,
                markersize=5,
                capsize=2,
                linewidth=1.6,
                elinewidth=1,
                label={"tube-mpc": "u* around the plan", "adaptive": "u*, adaptive"}.get(
                    name, name
                ),
            )
        axes.set_xscale("log")
        marks = sorted((1.0, *FACTORS[parameter]))
        axes.set_xticks(marks, [f"{mark:g}" for mark in marks])
        axes.minorticks_off()
        axes.set_title(parameter.replace("_", " "), loc="left", fontsize=10)
        axes.set(ylim=(-4, 104), yticks=(0, 25, 50, 75, 100))
    figure.supxlabel("true value over the model's", fontsize=10)
    figure.supylabel("strict success [%], 95 % interval", fontsize=10)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=5, frameon=False)
    save(figure, check_figure_path(path))


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Policies on a system that is not their model.")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--only", default=",".join(_PARTS), help="parts to fly, by commas")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/uncertainty.json"))
    parser.add_argument("--figure", type=Path, default=Path("benchmarks/results/uncertainty.png"))
    options = parser.parse_args()
    asked = options.only.split(",")
    if not set(asked) <= set(_PARTS):
        parser.error(f"--only {options.only}: parts are {', '.join(_PARTS)}")
    found = json.loads(options.json.read_text()) if options.json.is_file() else []
    found = [row for row in found if row.get("parameter", "spacecraft") not in asked]
    if set(asked) - {"spacecraft"}:
        found += cartpole_study(options.episodes, asked)
    if "spacecraft" in asked:
        found += spacecraft_study(options.worlds)
    # In the order of the parts, whatever was flown first.
    found.sort(key=lambda row: _PARTS.index(row.get("parameter", "spacecraft")))
    show(found)
    write_atomic(options.json, json.dumps(found, indent=1) + "\n")
    if {row.get("parameter") for row in found} >= set(_PARTS[:-1]):
        draw(found, options.figure)


if __name__ == "__main__":
    main()
