"""Kinds of tube, for the cart-pole and the spacecraft, each against the worst found.

    paper       Theorem 1 with the metric of least chi: a ball in the whole state
    output      the same with the objective re-weighted: the least bound of one output
    ellipsoid   invariant for peak-bounded disturbances (S-procedure), whole state or one output
    held        the same for a linear control that is held, at the instants and between them
    held, any   the same for every sequence of holds of at most that length

Cart-pole: each designed on the errors that its own tube allows, for the plans after their first
0.8 s or around the upright, and proved on that continuous box by interval arithmetic. Then episodes
around such plans, those of the first three under a control at will (inside the integrator): random
disturbances, the one that raises V fastest, and a search for the worst. Spacecraft: for all states,
control held for 0.1 s; the worst disturbance of the linear law v = K e is exact.

    python benchmarks/studies/tubes.py [--json FILE] [--markdown FILE] [--flights 100]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tubes_flights import PERIOD, SETTLED, UPRIGHT, AnyTube, attack, resting_plans, settled_plans

from lagros_envs.files import write_atomic
from lagros_envs.tasks.cartpole import task
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.double_integrator import (
    certified_margin,
    design_axis,
    flow,
    state_tube,
)
from lagros_policies.contraction.ellipsoid import TubeProof, prove_tube
from lagros_policies.contraction.held_design import (
    HeldDesign,
    HeldTube,
    design_held,
    design_held_contained,
)
from lagros_policies.contraction.held_ellipsoid import HeldTubeProof, prove_held_tube
from lagros_policies.contraction.tube_design import TubeDesign, design_contained
from lagros_policies.tasks.cartpole.plans import PlanBox
from lagros_policies.tasks.spacecraft.ellipsoid_axis import (
    design_axis_ellipsoid,
    prove_axis_ellipsoid,
    worst_output,
)
from lagros_policies.tasks.spacecraft.proof import prove_axis

FloatArray = NDArray[np.float64]

# Plans, method, what is least, d_bar, alpha [1/s] and hold [s], None for a control at will; alpha
# is about the best of each.
_CASES = (
    ("upright", "paper", "whole", 0.075, 0.9, None),
    ("upright", "output", "theta", 0.075, 0.9, None),
    ("upright", "ellipsoid", "whole", 0.075, 0.9, None),
    ("upright", "ellipsoid", "theta", 0.075, 0.6, None),
    ("upright", "ellipsoid", "p", 0.075, 0.9, None),
    ("upright", "held", "whole", 0.075, 0.5, 0.1),
    ("upright", "held", "theta", 0.075, 0.4, 0.1),
    ("upright", "held", "p", 0.075, 0.6, 0.1),
    ("upright", "held, any", "whole", 0.075, 0.5, 0.1),
    ("settled", "paper", "whole", 0.075, 0.6, None),
    ("settled", "output", "theta", 0.075, 0.6, None),
    ("settled", "ellipsoid", "whole", 0.075, 0.7, None),
    ("settled", "ellipsoid", "theta", 0.075, 0.6, None),
    ("settled", "ellipsoid", "p", 0.075, 0.7, None),
    ("settled", "held", "whole", 0.075, 0.6, 0.1),
    ("settled", "held", "theta", 0.075, 0.5, 0.1),
    ("settled", "held", "p", 0.075, 0.5, 0.1),
    ("gentle", "ellipsoid", "whole", 0.3, 0.8, None),
    ("gentle", "held", "whole", 0.3, 0.5, 0.1),
    ("gentle", "held", "whole", 0.3, 0.8, 0.02),
    ("upright", "held", "theta", 0.5, 0.4, 0.1),
    ("upright", "held", "theta", 0.55, 0.4, 0.1),
    ("upright", "held", "theta", 0.65, 0.4, 0.05),
    ("upright", "held", "theta", 0.75, 0.4, 0.05),
    ("upright", "held", "theta", 0.75, 0.4, 0.02),
    ("upright", "paper", "whole", 0.75, 0.6, None),
    ("upright", "output", "theta", 0.75, 0.6, None),
    ("upright", "ellipsoid", "theta", 0.75, 0.4, None),
)
_OUTPUTS = {"theta": (0.0, 1.0, 0.0, 0.0), "p": (1.0, 0.0, 0.0, 0.0)}
_BOXES = {"settled": SETTLED, "upright": UPRIGHT, "gentle": PlanBox()}


def designed(case: tuple[str, str, str, float, float, float | None]) -> AnyTube:
    """Return the tube of a case.

    Raises:
        InfeasibleError: There is none that stays in its box.
        RuntimeError: The solver stopped.
    """
    name, method, output, bound, rate, period = case
    system = task.CartPoleSettings().system
    if period is not None:
        held = HeldDesign(
            period=period,
            rate=rate,
            output=_OUTPUTS.get(output),
            disturbance_bound=bound,
            # A tube that is narrow in p is wide in the rates: too wide for the larger box.
            control_penalty=1e-3 if (name, output) == ("settled", "p") else 1e-4,
            aperiodic=method == "held, any",
        )
        return design_held_contained(system, _BOXES[name], held)
    # The task's own bound is near the largest that any tube stands: less room for the proof.
    loose = bound == 0.75
    design = TubeDesign(
        method=method,  # type: ignore[arg-type]
        rate=rate,
        output=_OUTPUTS.get(output),
        disturbance_bound=bound,
        control_penalty=1e-3 if loose or method != "ellipsoid" else 0.02,
        floor=0.01 if loose else 0.03,
        margin=0.03 if loose else 0.05,
    )
    return design_contained(system, _BOXES[name], design)


def degree_table() -> str:
    """Return how the bound of ||e|| near the upright falls with the degree of Q(s), per d_bar."""
    system = task.CartPoleSettings().system
    error = np.array([0.0, 0.1, 0.5, 0.4])
    lines = ["| degree of Q(s), held 0.1 s | ‖e‖ ≤, per unit of d̄ |", "|---:|---:|"]
    for degree in (2, 3, 4, 6, 8):
        design = HeldDesign(PERIOD, 0.5, disturbance_bound=1.0, degree=degree)
        tube = design_held(system, UPRIGHT, error, design)
        lines.append(f"| {degree} | {tube.steady_radius:.3f} |")
    return "\n".join(lines) + "\n"


def proof_of(tube: AnyTube, most_seconds: float) -> TubeProof | HeldTubeProof:
    """Prove a tube, or try to."""
    system = task.CartPoleSettings().system
    if isinstance(tube, HeldTube):
        return prove_held_tube(system, tube, most_seconds)
    return prove_tube(system, tube, most_seconds)


def cartpole_rows(flights: int, budget: int, most_seconds: float) -> list[dict[str, Any]]:
    """Return one row per tube of the cart-pole."""
    # Plans that rest at the goal lie in every box.
    plans = {"settled": settled_plans(20), "upright": resting_plans(1), "gentle": resting_plans(1)}
    rows = []
    for case in _CASES:
        begun = time.monotonic()
        name, method, output, bound, rate, period = case
        row: dict[str, Any] = {"plans": name, "d_bar": bound, "method": method, "least": output}
        row.update(alpha=rate, hold=period)
        try:
            tube = designed(case)
        except (InfeasibleError, RuntimeError) as problem:
            rows.append({**row, "contained": False, "problem": str(problem)})
            continue
        proof = proof_of(tube, most_seconds)
        names = ("p", "theta", "p_dot", "theta_dot")
        if isinstance(tube, HeldTube):
            row.update(Q=tube.duals.tolist(), K=tube.gain.tolist(), force=tube.largest_deviation)
        else:
            row.update(W=tube.dual.tolist(), nu=tube.control_weight)
        row.update(
            contained=True,
            proved=proof.proved,
            proof_seconds=proof.seconds,
            radius=tube.steady_radius,
            outputs=dict(zip(names, tube.steady_outputs.tolist(), strict=True)),
            error_box=tube.error.tolist(),
            **attack(tube, plans[name], flights, budget),
        )
        sys.stderr.write(f"{case}: proved {proof.proved}, {time.monotonic() - begun:.0f} s\n")
        rows.append(row)
    return rows


def spacecraft_rows() -> list[dict[str, Any]]:
    """Return one row per tube of the spacecraft, per unit of d_bar."""
    rows: list[dict[str, Any]] = []
    position = np.array([1.0, 0.0])
    push = np.array([0.5 * PERIOD**2, PERIOD])
    for objective, label in (("state", "paper"), ("position", "output")):
        for rate in (0.3, 1.0, 2.0):
            metric = design_axis(rate, PERIOD, objective)  # type: ignore[arg-type]
            pull = push @ metric.matrix
            gain = -(pull @ flow(PERIOD)) / float(pull @ push)
            rows.append(
                {
                    "method": label,
                    "alpha": rate,
                    "proved": prove_axis(metric).holds,
                    "whole": state_tube(metric, 1.0).steady_radius,
                    "position": certified_margin(metric, 1.0),
                    "worst_position": worst_output(gain, PERIOD, position),
                }
            )
    for objective in ("state", "position"):
        tube = design_axis_ellipsoid(PERIOD, objective)  # type: ignore[arg-type]
        rows.append(
            {
                "method": "ellipsoid",
                "least": objective,
                "proved": prove_axis_ellipsoid(tube),
                "whole": tube.state,
                "position": tube.position,
                "worst_position": worst_output(tube.gain, PERIOD, position),
                "gain": tube.gain.tolist(),
            }
        )
    return rows


def markdown(cartpole: list[dict[str, Any]], spacecraft: list[dict[str, Any]]) -> str:
    """Return both tables."""
    lines = [
        "| plans | d̄ | tube | least in | hold | α | ‖e‖ ≤ | \\|θ − θ_d\\| ≤ [rad] | worst found | "
        "\\|p − p_d\\| ≤ [m] | worst found | √(V/bound) worst | crossed | proved |",
        "|---|---:|---|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    for row in cartpole:
        hold = "at will" if row["hold"] is None else f"{1000 * row['hold']:g} ms"
        head = f"| {row['plans']} | {row['d_bar']:g} | {row['method']} | {row['least']} | {hold} |"
        if not row["contained"]:
            lines.append(f"{head} {row['alpha']:g} | leaves its box | | | | | | | |")
            continue
        bound, seen = row["outputs"], row["observed"]
        lines.append(
            f"{head} {row['alpha']:g} | {row['radius']:.3g} | {bound['theta']:.3g} | "
            f"{seen['theta']:.3g} | {bound['p']:.3g} | {seen['p']:.3g} | "
            f"{row['largest_share']:.3f} | {row['crossed']} of {row['flights']:,} | "
            f"{'yes' if row['proved'] else 'no'} |"
        )
    lines += [
        "",
        "| spacecraft, per unit of d̄ | α | ‖e‖ of an axis or the plane ≤ | position ≤ [m] | "
        "worst position of v = K e, exact [m] | proved |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for row in spacecraft:
        name = f"{row['method']} ({row['least']})" if "least" in row else row["method"]
        alpha = f"{row['alpha']:g}" if "alpha" in row else ""
        lines.append(
            f"| {name} | {alpha} | {row['whole']:.3g} | {row['position']:.3g} | "
            f"{row['worst_position']:.3g} | {'yes' if row['proved'] else 'no'} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Kinds of tube against the worst found.")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--markdown", type=Path, default=None)
    parser.add_argument("--flights", type=int, default=100, help="of each kind of disturbance")
    parser.add_argument("--budget", type=int, default=108, help="flights of a search, per plan")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each proof")
    parser.add_argument(
        "--degrees", action="store_true", help="only what the degree of Q(s) is worth"
    )
    wanted = parser.parse_args()
    if wanted.degrees:
        sys.stdout.write(degree_table())
        return
    cartpole = cartpole_rows(wanted.flights, wanted.budget, wanted.seconds)
    spacecraft = spacecraft_rows()
    text = markdown(cartpole, spacecraft)
    sys.stdout.write(text)
    if wanted.json is not None:
        record = {"cartpole": cartpole, "spacecraft": spacecraft}
        write_atomic(wanted.json, json.dumps(record, indent=1) + "\n")
    if wanted.markdown is not None:
        write_atomic(wanted.markdown, text)


if __name__ == "__main__":
    main()
