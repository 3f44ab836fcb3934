"""The enclosures on a public problem: a cart-pole with somebody else's network (ARCH-COMP, AINNCS).

u = network(x), tanh 4-64-64-1 with a tanh at the end, held for 0.02 s:

    x1' = x2, x2' = 2u, x3' = x4,
    x4' = (0.08 * 0.41 (9.8 sin x3 - 2u cos x3) - 0.0021 x4) / 0.0105

From all |x1|, |x3| <= 0.1, |x2|, |x4| <= 0.05 it is to be proved that |x1|, |x3|, |x4| <= 0.001 for
8 s < t <= 10 s. The set is cut into equal cells; random ones of them are followed by
the tubes of this package (no disturbance, the network enclosed over the errors' own box). What is
reported of the set is therefore *observed* on these cells, what is said of each cell is *proved*:
of the Runge-Kutta steps at the control instants, of real numbers, as the competition takes the

The file is not ours and is not shipped: github.com/verivital/ARCH-COMP2025, AINNCS, "cartpole".

    OMP_NUM_THREADS=1 python benchmarks/studies/arch_cartpole.py --onnx FILE
        [--parts 16,16,16,16:32,8,32,8] [--cells 64] [--seconds 10]
        [--json benchmarks/results/arch_cartpole.json]
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import hold_step
from lagros_envs.dynamics.system import Components
from lagros_envs.files import write_atomic
from lagros_policies.learning.networks import Mlp
from lagros_policies.proof.error_set import ErrorSet
from lagros_policies.proof.network_enclosure import relaxation, second_order
from lagros_policies.proof.network_expansion import box_inputs, expand
from lagros_policies.proof.network_steering import axes_along
from lagros_policies.proof.plan_tube import plan_tubes
from lagros_policies.proof.rounded import above
from lagros_policies.proof.steering import Steering

PERIOD = 0.02
INITIAL = np.array([0.1, 0.05, 0.1, 0.05])
# What is to be proved: |x1|, |x3|, |x4| by the end, from some time on [s].
WITHIN, FROM = np.array([0.001, np.inf, 0.001, 0.001]), 8.0
_SLACK = 2.0**-40
_PUBLISHED = (
    "no script of 2024 and 2025 proves it of the whole set; smaller sets, or one box of sides "
    "0.006, 0.003, 0.006, 0.001 for 1 s"
)


@dataclass(frozen=True)
class Balancing:
    """The motion of the problem."""

    state_dim: int = 4
    control_dim: int = 1

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt."""
        _, speed, angle, rate = state
        (force,) = control
        push = 2.0 * force
        swing = 9.8 * functions.sin(angle) - push * functions.cos(angle)
        return speed, push, rate, (0.08 * 0.41 * swing - 0.0021 * rate) / 0.0105


class Along:
    """The network as a `Controller`: enclosed over boxes that lie along the errors.

    Args:
        network: The network, of the state itself.
    """

    def __init__(self, network: Mlp) -> None:
        self.network = network
        self._layers = list(zip(network.weights, network.biases, strict=True))

    def steering(
        self, step: int, errors: ErrorSet, state: FloatArray, control: FloatArray
    ) -> Steering:
        """Enclose the control; see `Controller.steering`."""
        centre = state + errors.centre
        nothing = _SLACK * (np.abs(centre) + errors.radius)
        axes, back, along = axes_along(errors, nothing)
        inputs = box_inputs(centre, along, axes)
        found = [second_order(expand(self.network, inputs)), relaxation(self._layers, inputs)]
        first = found[0].error <= found[1].error
        gain = np.where(first[..., None], found[0].gain, found[1].gain)
        # What R misses of the inverse of T moves the inputs by less than `nothing`.
        missed = np.einsum("pmi,pij,pj->pm", np.abs(gain), np.abs(back), nothing)
        error = np.where(first, found[0].error, found[1].error)
        offset = np.where(first, found[0].offset, found[1].offset)
        return Steering(gain @ back, offset - control, above(error + missed))


def read(path: Path) -> Mlp:
    """Read the network of the problem; the tanh at its end gets a layer after it, of one.

    Raises:
        ImportError: onnx is not installed.
        ValueError: It is another network.
    """
    import onnx
    from onnx import numpy_helper

    found = onnx.load(path).graph
    arrays = [numpy_helper.to_array(one) for one in found.initializer]
    weights = [one.T for one in arrays if one.ndim == 2]
    biases = [one for one in arrays if one.ndim == 1]
    if [one.op_type for one in found.node] != ["Gemm", "Tanh"] * 3 or weights[0].shape[0] != 4:
        raise ValueError(f"{path} is not the network of the problem: three layers with tanh")
    return Mlp([*weights, np.eye(1)], [*biases, np.zeros(1)])


def control_of(network: Mlp, states: FloatArray) -> FloatArray:
    """Return u at states (p, 4), of doubles."""
    values = states
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        values = values @ weight.astype(np.float64) + bias
        values = np.tanh(values) if index < len(network.weights) - 1 else values
    return values


def flights(network: Mlp, middles: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
    """Return states (p, N + 1, 4) and controls (p, N, 1) from some states (p, 4)."""
    states, controls = np.empty((len(middles), steps + 1, 4)), np.empty((len(middles), steps, 1))
    states[:, 0] = middles
    for step in range(steps):
        controls[:, step] = control_of(network, states[:, step])
        states[:, step + 1] = hold_step(Balancing(), states[:, step], controls[:, step], PERIOD)
    return states, controls


def measured(
    network: Mlp, parts: tuple[int, ...], cells: int, seconds: float, seed: int
) -> dict[str, Any]:
    """Follow random cells of the set, each side cut into so many parts: what is proved of them."""
    rng = np.random.default_rng([seed, *parts])
    half = INITIAL / parts
    places = rng.integers(0, parts, (cells, 4))
    begun = process_time()
    states, controls = flights(network, (2 * places + 1) * half - INITIAL, round(seconds / PERIOD))
    tubes = plan_tubes(
        Balancing(),
        PERIOD,
        states,
        controls,
        Along(network),
        0.0,
        initial=np.broadcast_to(half, (cells, 4)),
    )
    taken = process_time() - begun
    known = np.isfinite(tubes.norm)
    until = PERIOD * (known.sum(axis=1) - 1)
    late = PERIOD * np.arange(states.shape[1]) > FROM - 1e-9
    reached = np.abs(states) + tubes.outputs
    holds = known.all(axis=1) & np.all(reached[:, late] <= WITHIN, axis=(1, 2))
    return {
        "parts": parts,
        "cells_in_all": math.prod(parts),
        "cells_followed": cells,
        "seconds_of_motion": seconds,
        "share_followed_to_the_end": float(known.all(axis=1).mean()),
        "proved_until_s": {
            name: float(f(until)) for name, f in (("least", np.min), ("median", np.median))
        },
        "share_proved": float(holds.mean()) if late.sum() > 1 else None,
        "largest_late": reached[known.all(axis=1)][:, late].max(axis=(0, 1)).tolist()
        if late.sum() > 1 and known.all(axis=1).any()
        else None,
        "processor_time_per_cell_s": taken / cells,
        "processor_time_of_the_whole_set_h": math.prod(parts) * taken / cells / 3600.0,
    }


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--onnx", type=Path, required=True)
    parser.add_argument("--parts", default="16,16,16,16:32,8,32,8")
    parser.add_argument("--cells", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    network = read(options.onnx)
    rows = [
        measured(
            network,
            tuple(map(int, parts.split(","))),
            options.cells,
            options.seconds,
            options.seed,
        )
        for parts in options.parts.split(":")
    ]
    table = Table(
        "parts of each side",
        "cells",
        "to the end",
        "proved until s",
        "proved",
        "s a cell",
        "h in all",
    )
    for row in rows:
        table.add_row(
            ", ".join(map(str, row["parts"])),
            f"{row['cells_followed']} of {row['cells_in_all']}",
            f"{100 * row['share_followed_to_the_end']:.0f} %",
            f"{row['proved_until_s']['least']:.2f}, median {row['proved_until_s']['median']:.2f}",
            "–" if row["share_proved"] is None else f"{100 * row['share_proved']:.0f} %",
            f"{row['processor_time_per_cell_s']:.1f}",
            f"{row['processor_time_of_the_whole_set_h']:.0f}",
        )
    Console(width=120).print(table)
    if options.json is not None:
        command = (
            f"python benchmarks/studies/arch_cartpole.py --onnx FILE --parts {options.parts} "
            f"--cells {options.cells} --seconds {options.seconds:g} --seed {options.seed}"
        )
        record = {"command": command, "published": _PUBLISHED, "rows": rows}
        write_atomic(options.json, json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
