r"""Metrics of systems that are no cart-pole: a car and a planar quadrotor, designed and checked.

- The car [x, y, heading, speed] is steered by turn rate and acceleration: the controls move all
  that its motion depends on, so that its metric is a function of x_d.
- The planar quadrotor (PVTOL) [p_x, p_z, roll, v_x, v_z, spin] in the body's axes: the rotors move
  v_z and spin, and its metric is a function of roll and v_x.

Each is designed by CV-STEM over a box in all coordinates, checked on fresh triples that the design
never saw, and then attacked by a search that follows the worst of them (observed, not proved).

    OMP_NUM_THREADS=1 python benchmarks/studies/metric_general.py \
        --json benchmarks/results/metric_general.json
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from studies.planar import Car, Pvtol

from lagros_envs.checks import check_whole
from lagros_envs.dynamics import System
from lagros_envs.files import write_atomic
from lagros_policies.contraction import (
    Basis,
    BoxRegion,
    CvStemSettings,
    certified_tube,
    design_on_region,
    harmonics,
    powers,
    products,
    search_violation,
    verify_metric,
)

_DESIGN, _CHECK, _SEARCH = 1, 2, 3  # seeds


def car() -> tuple[System, BoxRegion, CvStemSettings]:
    """Return the car, where its metric must hold, and what to design."""
    region = BoxRegion(
        low=(-5.0, -5.0, -math.pi, 0.5),
        high=(5.0, 5.0, math.pi, 2.5),
        error=(0.5, 0.5, 0.5, 0.5),
        control_low=(-2.0, -1.0),
        control_high=(2.0, 1.0),
    )
    # A turned plan has a turned metric: of second degree in the sine and cosine of its heading.
    basis = products(harmonics(2, 2), powers(3, 1))
    settings = CvStemSettings(0.5, 0, 0.05, 0.1, (1.0,) * 4, basis, "nominal")
    return Car(), region, settings


def pvtol() -> tuple[System, BoxRegion, CvStemSettings]:
    """Return the quadrotor, where its metric must hold, and what to design."""
    third, body = math.pi / 3, Pvtol()
    hover = body.hover
    region = BoxRegion(
        low=(-5.0, -5.0, -third, -2.0, -1.0, -third),
        high=(5.0, 5.0, third, 2.0, 1.0, third),
        error=(0.5, 0.5, 0.3, 0.5, 0.5, 0.5),
        control_low=(hover - 1.0,) * 2,
        control_high=(hover + 1.0,) * 2,
    )
    basis = Basis(("1", "cos(x[2])", "sin(x[2])", "x[3]"))
    scaling = (1.0, 1.0, 3.0, 1.0, 1.0, 1.0)
    return body, region, CvStemSettings(0.5, 0, 0.05, 0.1, scaling, basis)


CASES = {"car": car, "pvtol": pvtol}


def study(
    system: System, region: BoxRegion, settings: CvStemSettings, checks: int
) -> dict[str, Any]:
    """Design a metric, check it, and look for where it is worst."""
    begun = time.perf_counter()
    metric = design_on_region(system, region, settings, seed=_DESIGN)
    designed = time.perf_counter()
    fresh = region.sample(np.random.default_rng(_CHECK), checks)
    check = verify_metric(system, metric, fresh, _CHECK).verification
    assert check is not None
    _, worst = search_violation(system, metric, _SEARCH)
    return {
        "rate": metric.contraction_rate,
        "chi": metric.condition_bound,
        "nu": metric.control_weight,
        "functions": metric.phi.size,
        "tube_per_disturbance": certified_tube(metric, 1.0).steady_radius,
        "verification": asdict(check),
        "worst_searched": worst,
        "design_s": designed - begun,
        "check_s": time.perf_counter() - designed,
    }


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Metrics of a car and of a planar quadrotor.")
    parser.add_argument("--checks", type=int, default=10_000)
    parser.add_argument("--systems", default=",".join(CASES))
    parser.add_argument("--json", type=Path, default=None)
    wanted = parser.parse_args()
    check_whole("checks", wanted.checks)
    found = {name: study(*CASES[name](), wanted.checks) for name in wanted.systems.split(",")}
    text = json.dumps(found, indent=1)
    sys.stdout.write(text + "\n")
    if wanted.json is not None:
        write_atomic(wanted.json, text + "\n")


if __name__ == "__main__":
    main()
