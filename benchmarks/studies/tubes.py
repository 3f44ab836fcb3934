"""Three kinds of tube, for the cart-pole and the spacecraft, each against the worst found.

    paper       Theorem 1 with the metric of least chi: a ball in the whole state
    output      the same with the objective re-weighted: the least bound of one output
    ellipsoid   invariant for peak-bounded disturbances (S-procedure), whole state or one output

Cart-pole: constant metrics, each designed on the errors that its own tube allows, for the plans
after their first 0.8 s, and proved on that continuous box by interval arithmetic. Then episodes
around such plans under the control of the tube at will (inside the integrator): random
disturbances, the one that raises V fastest, and a search for the worst. Spacecraft: for all states,
control held for 0.1 s; the worst disturbance of the linear law v = K e is exact.

    python benchmarks/studies/tubes.py [--json FILE] [--markdown FILE] [--flights 100] [--held]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.worst_case.search import SearchSettings, search
from lagros_envs import cartpole_task as task
from lagros_envs.disturbances import Disturbance, into_unit_ball, onto_unit_sphere
from lagros_envs.dynamics import hold_step, vector_field
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.double_integrator import (
    certified_margin,
    design_axis,
    flow,
    state_tube,
)
from lagros_policies.contraction.ellipsoid import TubeControl, prove_tube
from lagros_policies.contraction.ellipsoid_axis import (
    design_axis_ellipsoid,
    prove_axis_ellipsoid,
    worst_output,
)
from lagros_policies.contraction.proof.spacecraft import prove_axis
from lagros_policies.contraction.tube_design import (
    ConstantTube,
    PlanBox,
    TubeDesign,
    design_contained,
)
from lagros_policies.planning import CartPolePlanner

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_NAMESPACE = 31
_SETTLED = PlanBox(angle=0.4, velocity=7.5, angular_rate=1.2, force=3.0)
_SETTLED_STEP = 8
_UPRIGHT = PlanBox(angle=0.05, velocity=0.5, angular_rate=0.1, force=0.5)
# Plans, method, what is least, d_bar and alpha [1/s]; alpha is about the best of each.
_CASES = (
    ("upright", "paper", "whole", 0.075, 0.9),
    ("upright", "output", "theta", 0.075, 0.9),
    ("upright", "ellipsoid", "whole", 0.075, 0.9),
    ("upright", "ellipsoid", "theta", 0.075, 0.6),
    ("upright", "ellipsoid", "p", 0.075, 0.9),
    ("settled", "paper", "whole", 0.075, 0.6),
    ("settled", "output", "theta", 0.075, 0.6),
    ("settled", "ellipsoid", "whole", 0.075, 0.7),
    ("settled", "ellipsoid", "theta", 0.075, 0.6),
    ("settled", "ellipsoid", "p", 0.075, 0.7),
    ("upright", "paper", "whole", 0.75, 0.6),
    ("upright", "output", "theta", 0.75, 0.6),
    ("upright", "ellipsoid", "theta", 0.75, 0.4),
)
_OUTPUTS = {"theta": (0.0, 1.0, 0.0, 0.0), "p": (1.0, 0.0, 0.0, 0.0)}
_PERIOD = 0.1
# Control steps flown, and Runge-Kutta steps in each; d is constant over a control step, but for
# the steepest one, which is renewed at every Runge-Kutta step.
_STEPS = 40
_FINE = 10
# Error of the integration, as a share of the tube.
_INTEGRATION = 1e-3
_KINDS = ("uniform", "sphere", "constant", "sinusoid", "gust")


@dataclass(frozen=True)
class Plans:
    """Target trajectories: x_d where each begins (p, 4), and u_d (p, steps, 1)."""

    start: FloatArray
    controls: FloatArray


def settled_plans(count: int) -> Plans:
    """Plan random episodes and cut off their first 0.8 s; keep those inside the box."""
    settings = task.CartPoleSettings()
    planner = CartPolePlanner(settings)
    starts, controls = [], []
    for seed in episode_seeds(0, count, _NAMESPACE):
        scenario = task.sample_scenario(episode_streams(seed).scenario, settings)
        plan = planner.plan(scenario.initial_state, scenario.goal)
        part = plan.states[_SETTLED_STEP : _SETTLED_STEP + _STEPS + 1]
        force = plan.controls[_SETTLED_STEP : _SETTLED_STEP + _STEPS]
        limit = (_SETTLED.angle, _SETTLED.velocity, _SETTLED.angular_rate)
        if not np.all(np.abs(part[:, 1:]) <= limit) or np.abs(force).max() > _SETTLED.force:
            raise RuntimeError(f"the plan of episode {seed} leaves {_SETTLED}")
        starts.append(part[0])
        controls.append(force)
    return Plans(np.stack(starts), np.stack(controls))


def resting_plans(count: int) -> Plans:
    """Return plans that rest at the goal."""
    return Plans(np.zeros((count, 4)), np.zeros((count, _STEPS, 1)))


def fly(
    tube: ConstantTube,
    plans: Plans,
    which: IntArray,
    pushes: FloatArray | None,
    held: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Fly episodes from e(0) = 0 under the control of a tube at will.

    Args:
        tube: The tube.
        plans: The plans.
        which: Plan of each flight, shape (b,).
        pushes: d / d_bar, shape (b, steps, 4); None for d along W^-1 e, which raises V fastest.
        held: Hold the control for a Runge-Kutta step, 10 ms, in place of a control at will.

    Returns:
        The largest |e_i| of each flight, (b, 4), and the largest share of the tube, max of
        sqrt(V(t) / bound of V(t)), (b,).
    """
    system = task.CartPoleSettings().system
    law, inverse = TubeControl(system, tube), np.linalg.inv(tube.dual)
    bound, fine = tube.design.disturbance_bound, _PERIOD / _FINE
    nominal = plans.start[which]
    state = nominal.copy()
    rng = np.random.default_rng(7)
    first = onto_unit_sphere(rng.standard_normal(state.shape), np.eye(4)[0])
    largest, share = np.zeros((len(which), 4)), np.zeros(len(which))
    for instant in range(_STEPS * _FINE):
        control = plans.controls[which, instant // _FINE]
        error = state - nominal
        if pushes is None:
            push = onto_unit_sphere(error @ inverse, first)
        else:
            push = pushes[:, instant // _FINE]
        if held:
            force = law(state, nominal, control)
            state = hold_step(system, state, force, fine, bound * push, 1)
            nominal = hold_step(system, nominal, control, fine, substeps=1)
        else:
            state, nominal = _advance(law, state, nominal, control, bound * push, fine)
        error = state - nominal
        largest = np.maximum(largest, np.abs(error))
        energy = np.sum(error @ inverse * error, axis=-1)
        allowed = tube.energy * float(tube.share((instant + 1) * fine)) ** 2
        share = np.maximum(share, np.sqrt(energy / allowed))
    return largest, share


def _advance(
    law: TubeControl,
    state: FloatArray,
    nominal: FloatArray,
    control: FloatArray,
    push: FloatArray,
    duration: float,
) -> tuple[FloatArray, FloatArray]:
    """Integrate x under u*(x, x_d, u_d) and x_d under u_d together: a control at will, not held."""
    system = law.system

    def slope(pair: FloatArray) -> FloatArray:
        here, there = pair
        moved = vector_field(system, here, law(here, there, control)) + push
        return np.stack([moved, vector_field(system, there, control)])

    pair = np.stack([state, nominal])
    first = slope(pair)
    second = slope(pair + 0.5 * duration * first)
    third = slope(pair + 0.5 * duration * second)
    fourth = slope(pair + duration * third)
    following = pair + duration / 6.0 * (first + 2.0 * (second + third) + fourth)
    return following[0], following[1]


class TubeTarget:
    """The flights around one plan, for `worst_case.search`: how large an output becomes."""

    def __init__(self, tube: ConstantTube, plans: Plans, output: FloatArray, held: bool) -> None:
        """Keep what is attacked."""
        self._tube, self._plans, self._output, self._held = tube, plans, output, held
        self.episodes, self.steps, self.channels, self.slope_cost = len(plans.start), _STEPS, 4, 0
        self.shares: list[float] = []

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the largest |c'e| of each flight."""
        largest, share = fly(self._tube, self._plans, episode, sequences, self._held)
        self.shares.append(float(share.max()))
        return largest @ np.abs(self._output)

    def slopes(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """There are none."""
        raise NotImplementedError

    def starts(self) -> FloatArray:
        """Return constant pushes along each state, both ways."""
        rays = np.concatenate([np.eye(4), -np.eye(4)])
        held = np.repeat(into_unit_ball(rays)[:, None], _STEPS, axis=1)
        return np.repeat(held[None], self.episodes, axis=0)


def attack(
    tube: ConstantTube, plans: Plans, flights: int, budget: int, held: bool
) -> dict[str, Any]:
    """Return what the worst disturbances found do to a tube."""
    rng = np.random.default_rng(3)
    which = rng.integers(len(plans.start), size=flights)
    random = [
        Disturbance(kind, 1.0, (True,) * 4).realise(rng, _STEPS, _PERIOD)
        for kind in _KINDS
        for _ in range(flights)
    ]
    errors, share = fly(tube, plans, np.tile(which, len(_KINDS)), np.stack(random), held)
    steepest, worst = fly(tube, plans, which, None, held)
    largest = np.maximum(errors.max(axis=0), steepest.max(axis=0))
    shares, flown = [float(share.max()), float(worst.max())], len(share) + len(worst)
    few = Plans(plans.start[:1], plans.controls[:1])
    for index in (1, 0):
        target = TubeTarget(tube, few, np.eye(4)[index], held)
        settings = SearchSettings(method="cross-entropy", budget=budget, population=50)
        for found in search(target, settings, seed=index):
            largest[index] = max(largest[index], found.score)
            flown += found.flights
        shares.append(max(target.shares))
    return {
        "flights": flown,
        "observed": dict(zip(("p", "theta", "p_dot", "theta_dot"), largest.tolist(), strict=True)),
        "largest_share": max(shares),
        "crossed": max(shares) > 1.0 + _INTEGRATION,
    }


def cartpole_rows(
    flights: int, budget: int, most_seconds: float, held: bool
) -> list[dict[str, Any]]:
    """Return one row per tube of the cart-pole."""
    system = task.CartPoleSettings().system
    settled, resting = settled_plans(20), resting_plans(1)
    rows = []
    for name, method, output, bound, rate in _CASES:
        begun = time.monotonic()
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
        row: dict[str, Any] = {"plans": name, "d_bar": bound, "method": method, "least": output}
        row["alpha"] = rate
        try:
            tube = design_contained(system, _SETTLED if name == "settled" else _UPRIGHT, design)
        except (InfeasibleError, RuntimeError) as problem:
            rows.append({**row, "contained": False, "problem": str(problem)})
            continue
        proof = prove_tube(system, tube, most_seconds)
        names = ("p", "theta", "p_dot", "theta_dot")
        row.update(
            contained=True,
            proved=proof.proved,
            proof_cells=proof.condition.cells,
            radius=tube.steady_radius,
            outputs=dict(zip(names, tube.steady_outputs.tolist(), strict=True)),
            nu=tube.control_weight,
            W=tube.dual.tolist(),
            error_box=tube.error.tolist(),
            **attack(tube, settled if name == "settled" else resting, flights, budget, held),
        )
        sys.stderr.write(f"{name}, {method}, {output}, d_bar {bound:g}: ")
        sys.stderr.write(f"proved {proof.proved}, {time.monotonic() - begun:.0f} s\n")
        rows.append(row)
    return rows


def spacecraft_rows() -> list[dict[str, Any]]:
    """Return one row per tube of the spacecraft, per unit of d_bar."""
    rows: list[dict[str, Any]] = []
    position = np.array([1.0, 0.0])
    push = np.array([0.5 * _PERIOD**2, _PERIOD])
    for objective, label in (("state", "paper"), ("position", "output")):
        for rate in (0.3, 1.0, 2.0):
            metric = design_axis(rate, _PERIOD, objective)  # type: ignore[arg-type]
            pull = push @ metric.matrix
            gain = -(pull @ flow(_PERIOD)) / float(pull @ push)
            rows.append(
                {
                    "method": label,
                    "alpha": rate,
                    "proved": prove_axis(metric).holds,
                    "whole": state_tube(metric, 1.0).steady_radius,
                    "position": certified_margin(metric, 1.0),
                    "worst_position": worst_output(gain, _PERIOD, position),
                }
            )
    for objective in ("state", "position"):
        tube = design_axis_ellipsoid(_PERIOD, objective)  # type: ignore[arg-type]
        rows.append(
            {
                "method": "ellipsoid",
                "least": objective,
                "proved": prove_axis_ellipsoid(tube),
                "whole": tube.state,
                "position": tube.position,
                "worst_position": worst_output(tube.gain, _PERIOD, position),
                "gain": tube.gain.tolist(),
            }
        )
    return rows


def markdown(cartpole: list[dict[str, Any]], spacecraft: list[dict[str, Any]]) -> str:
    """Return both tables."""
    lines = [
        "| plans | d̄ | tube | least in | α | ‖e‖ ≤ | \\|θ − θ_d\\| ≤ [rad] | worst found | "
        "\\|p − p_d\\| ≤ [m] | worst found | √(V/bound) worst | proved |",
        "|---|---:|---|---|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    for row in cartpole:
        head = f"| {row['plans']} | {row['d_bar']:g} | {row['method']} | {row['least']} |"
        if not row["contained"]:
            lines.append(f"{head} {row['alpha']:g} | leaves its box | | | | | | |")
            continue
        bound, seen = row["outputs"], row["observed"]
        lines.append(
            f"{head} {row['alpha']:g} | {row['radius']:.3g} | {bound['theta']:.3g} | "
            f"{seen['theta']:.3g} | {bound['p']:.3g} | {seen['p']:.3g} | "
            f"{row['largest_share']:.3f} | {'yes' if row['proved'] else 'no'} |"
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
    parser = argparse.ArgumentParser(description="Three kinds of tube against the worst found.")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--markdown", type=Path, default=None)
    parser.add_argument(
        "--held", action="store_true", help="hold the control 10 ms: a third of the time"
    )
    parser.add_argument("--flights", type=int, default=100, help="of each kind of disturbance")
    parser.add_argument("--budget", type=int, default=108, help="flights of a search, per plan")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each proof")
    wanted = parser.parse_args()
    cartpole = cartpole_rows(wanted.flights, wanted.budget, wanted.seconds, wanted.held)
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
