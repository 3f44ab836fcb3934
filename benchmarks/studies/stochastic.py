"""Bound and measured mean square under Wiener noise, side by side.

Spacecraft: one body under u* of the constant metric, held for 0.1 s, tracking rest; noise on
position and velocity; `held_mean_square` (proved, up to the turning within a hold). Cart-pole: u*
with the shipped metric along random plans; noise on the rates, then on all states;
`mean_square_bound` (the condition was checked on samples, the region is left now and then, and the
control is held: observed). Means over many paths, with three standard errors.

    OMP_NUM_THREADS=1 python benchmarks/studies/stochastic.py [--paths 400]
        [--json benchmarks/results/stochastic.json]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from studies.rollouts import plan_episodes

from lagros_envs.files import write_atomic
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.contraction.control import error_energy
from lagros_policies.contraction.double_integrator import design_axis
from lagros_policies.remarks.stochastic import (
    held_mean_square,
    mean_square_bound,
    noisy_hold_step,
)
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.spacecraft.wrench_control import WrenchTracking

FloatArray = NDArray[np.float64]

_NAMESPACE, _SEED = 24, 20210226
_RATES = (0.5, 1.0, 2.0)
_PLACE, _SPEED = 0.05, 0.1  # intensities of the spacecraft [m / sqrt(s)], [m/s / sqrt(s)]
_SECONDS = 20.0
# Intensities of the cart-pole: of the rates alone, and of all states.
_CARTPOLE = ((0.0, 0.0, 0.05, 0.05), (0.0, 0.0, 0.1, 0.1), (0.05, 0.01, 0.05, 0.05))
_PLANS = 40


def spacecraft_row(rate: float, paths: int) -> dict[str, Any]:
    """Track rest under noise and compare what is measured with the held bound."""
    body, turning = Spacecraft(), design_axis(0.3)
    law = WrenchTracking(body, design_axis(rate), turning)
    period = law.plane.period
    steps = round(_SECONDS / period)
    bound = held_mean_square(law.plane, _PLACE, _SPEED, steps)
    intensity = np.array([_PLACE, _PLACE, 0.0, _SPEED, _SPEED, 0.0])
    rng = np.random.default_rng(_SEED)
    state = np.zeros((paths, 6))
    still, rest = np.zeros(6), np.zeros(3)
    for _ in range(steps):
        state = noisy_hold_step(
            body, state, law.control(state, still, rest), period, intensity, rng, substeps=1
        )
    errors = np.stack([state[:, :2], state[:, 3:5]], axis=-1)
    energy = np.einsum("...ai,ij,...aj->...", errors, law.plane.matrix, errors)
    place = np.sum(state[:, :2] ** 2, axis=-1)
    return {
        "system": "spacecraft",
        "rate": rate,
        "intensity": intensity.tolist(),
        "paths": paths,
        "time_s": _SECONDS,
        "energy": _mean(energy),
        "energy_bound": float(bound.energy[-1]),
        "square": _mean(place),
        "square_of": "position",
        "square_bound": float(bound.position[-1]),
        "kind": "proved",
    }


def cartpole_rows(intensity: tuple[float, ...], paths: int) -> list[dict[str, Any]]:
    """Fly plans under noise with least-norm u* and with the preferred feedback."""
    expert = CartPoleExpert(law="tuned")
    episodes = plan_episodes(expert, _PLANS, _NAMESPACE)
    plans = expert.track(episodes.states, episodes.controls)
    plan = np.arange(paths) % _PLANS

    def least(state: FloatArray, step: int) -> FloatArray:
        return expert.law(state, episodes.states[plan, step], episodes.controls[plan, step])

    def preferring(state: FloatArray, step: int) -> FloatArray:
        return expert.control(plans, plan, np.full(paths, step), state)

    bound = mean_square_bound(expert.metric, intensity)
    rows = []
    for name, law in (("least norm", least), ("preferring", preferring)):
        state, outside = _fly(expert, episodes.states[plan], law, np.asarray(intensity))
        error = state - episodes.states[plan, -1]
        energy = error_energy(expert.metric.matrix(state), error)
        time = expert.task.time_limit
        rows.append(
            {
                "system": f"cart-pole, {name}",
                "rate": bound.rate,
                "intensity": list(intensity),
                "paths": paths,
                "time_s": time,
                "energy": _mean(energy),
                "energy_bound": float(bound.energy(time)),
                "square": _mean(np.sum(error**2, axis=-1)),
                "square_of": "state",
                "square_bound": float(bound.mean_square(time)),
                "left_region": outside,
                "kind": "observed",
            }
        )
    return rows


def _fly(
    expert: CartPoleExpert,
    nominal: FloatArray,
    law: Callable[[FloatArray, int], FloatArray],
    intensity: FloatArray,
) -> tuple[FloatArray, float]:
    """Return the states at the end and the share of paths that ever left the metric's angles."""
    task, rng = expert.task, np.random.default_rng(_SEED)
    state = nominal[:, 0]
    outside = np.zeros(len(state), bool)
    for step in range(task.steps):
        force = law(state, step)
        state = noisy_hold_step(
            task.system, state, force, task.control_period, intensity, rng, substeps=2
        )
        outside |= np.abs(state[:, 1]) > expert.metric.region.angle
    return state, float(outside.mean())


def _mean(values: FloatArray) -> list[float]:
    """Return mean and three standard errors."""
    return [float(values.mean()), float(3.0 * values.std() / np.sqrt(len(values)))]


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="mean square under Wiener noise: bound and measured (3 standard errors)")
    headings = ("system", "rate", "E V", "bound", "ratio", "E‖e‖²", "bound", "ratio", "kind")
    for heading in headings:
        table.add_column(heading, justify="right")
    for row in rows:
        cells = []
        for name in ("energy", "square"):
            mean, wide = row[name]
            limit = row[f"{name}_bound"]
            cells += [f"{mean:.4g} ± {wide:.2g}", f"{limit:.4g}", f"{mean / limit:.2f}"]
        noise = ",".join(f"{g:g}" for g in row["intensity"])
        system = f"{row['system']}\n({noise})"
        table.add_row(system, f"{row['rate']:.3g}", *cells, row["kind"])
    Console(width=150).print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Mean square under noise: bound and measured.")
    parser.add_argument("--paths", type=int, default=400)
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/stochastic.json"))
    options = parser.parse_args()
    rows = [spacecraft_row(rate, options.paths) for rate in _RATES]
    for intensity in _CARTPOLE:
        rows += cartpole_rows(intensity, options.paths)
    show(rows)
    write_atomic(options.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
