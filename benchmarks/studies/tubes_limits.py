"""Where the tubes of `tubes.py` end: other rates, a control that is renewed, Runge-Kutta steps.

- Tubes of a control held for 0.1 s at the task's d_bar of 0.75, at rates beside that of the table.
- Tubes for a control at will, flown with that control renewed every 20 ms only: how far V goes
  beyond its bound.
- The motion that the environment integrates beside one with a tenth of its steps, in closed loop
  over whole episodes and over one hold.

    python benchmarks/studies/tubes_limits.py [--flights 800] [--episodes 100] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tubes_flights import NAMESPACE, PERIOD, UPRIGHT, resting_plans, steepest_share

from lagros_benchmarks.worst_case.flights import draw_episodes, random_pushes
from lagros_envs.dynamics import hold_step
from lagros_envs.dynamics.integrate import SUBSTEPS
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole import task
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.held_design import HeldDesign, design_held_contained
from lagros_policies.contraction.tube_design import TubeDesign, design_contained
from lagros_policies.tasks.cartpole.expert import CartPoleExpert

FloatArray = NDArray[np.float64]

_ANGLE = (0.0, 1.0, 0.0, 0.0)
_BOUND = 0.75
_RATES = (0.4, 0.45, 0.5, 0.55, 0.6)
_OUTPUTS = {"theta": _ANGLE, "whole": None}
# Tubes at will that are flown with a control that is renewed: least in, d_bar, alpha [1/s].
_AT_WILL = (("whole", 0.075, 0.9), ("theta", 0.075, 0.6))
_FINER = 10


def other_rates() -> list[dict[str, Any]]:
    """Return which tubes of a held control keep themselves in their box at d_bar = 0.75."""
    system = task.CartPoleSettings().system
    rows = []
    for least, output in _OUTPUTS.items():
        for rate in _RATES:
            design = HeldDesign(PERIOD, rate, output, disturbance_bound=_BOUND)
            try:
                design_held_contained(system, UPRIGHT, design)
                found = True
            except (InfeasibleError, RuntimeError):
                found = False
            rows.append({"least": least, "alpha": rate, "contained": found})
    return rows


def renewed(flights: int) -> list[dict[str, Any]]:
    """Return the largest V over its bound where the control at will is renewed every 20 ms."""
    system = task.CartPoleSettings().system
    rows = []
    for least, bound, rate in _AT_WILL:
        design = TubeDesign(rate=rate, output=_OUTPUTS[least], disturbance_bound=bound)
        tube = design_contained(system, UPRIGHT, design)
        shares = {
            hold: steepest_share(tube, resting_plans(1), flights, hold) for hold in (None, 0.02)
        }
        rows.append({"least": least, "alpha": rate, "at_will": shares[None], "held": shares[0.02]})
    return rows


def integration(episodes: int) -> dict[str, float]:
    """Return how far the environment's Runge-Kutta steps are from finer ones.

    Each of two loops answers its own state, so that a difference is fed back as an error is.
    """
    expert = CartPoleExpert()
    drawn = draw_episodes(expert, episode_seeds(0, episodes, NAMESPACE))
    pushes = random_pushes(drawn, "uniform", _BOUND)
    tracked = expert.track(drawn.plans, drawn.controls)
    every = np.arange(len(drawn.seeds))
    system, period = drawn.settings.system, drawn.settings.control_period
    coarse, fine = drawn.initial_states, drawn.initial_states
    whole = one = 0.0
    for step in range(drawn.settings.steps):
        at = np.full(len(every), step)
        push = pushes[:, step]
        force = expert.control(tracked, every, at, fine)
        same = hold_step(system, fine, force, period, push)
        answer = expert.control(tracked, every, at, coarse)
        coarse = hold_step(system, coarse, answer, period, push)
        fine = hold_step(system, fine, force, period, push, substeps=_FINER * SUBSTEPS)
        one = max(one, float(np.abs(same - fine).max()))
        whole = max(whole, float(np.abs(coarse - fine).max()))
    return {"episodes": len(every), "one_hold": one, "whole_episode": whole}


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Where the tubes end.")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--flights", type=int, default=800, help="of the steepest disturbance")
    parser.add_argument("--episodes", type=int, default=100, help="for the Runge-Kutta steps")
    wanted = parser.parse_args()
    rates, shares = other_rates(), renewed(wanted.flights)
    steps = integration(wanted.episodes)
    kept = [f"{row['least']}, {row['alpha']:g} 1/s" for row in rates if row["contained"]]
    sys.stdout.write(
        f"held 0.1 s, d_bar = {_BOUND:g}, near the upright: {len(kept)} of {len(rates)} tubes "
        f"(alpha from {min(_RATES):g} to {max(_RATES):g} 1/s) keep their box {kept or ''}\n"
    )
    for row in shares:
        sys.stdout.write(
            f"ellipsoid at will, least in {row['least']}, alpha = {row['alpha']:g} 1/s: sqrt(V / "
            f"bound) reaches {row['at_will']:.4f} at will and {row['held']:.4f} renewed every "
            f"20 ms\n"
        )
    sys.stdout.write(
        f"{SUBSTEPS} Runge-Kutta steps per hold against {_FINER * SUBSTEPS}, "
        f"{steps['episodes']} episodes: {steps['one_hold']:.1e} over one hold, "
        f"{steps['whole_episode']:.1e} over an episode in closed loop, largest of any state\n"
    )
    if wanted.json is not None:
        record = {"other_rates": rates, "renewed": shares, "integration": steps}
        write_atomic(wanted.json, json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
