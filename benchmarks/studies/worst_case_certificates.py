"""Is a certified bound ever crossed, by random, greedy or searched disturbances?

Three loops, each flown at least 10,000 times under disturbances of the stated bound: all random
kinds, constant pushes along every axis, the greedy feedback that pushes along the gradient of the
error energy, and sequences that a search found for that very episode.

- **cart-pole, held**: policies (b), by u* around its plan, and (c) every 0.1 s, against Theorem 1's
  tube of the shipped metric with the learning error of the flight. Its hypothesis is that the state
  stays in the metric's region; a flight is held against it until it leaves, and both are counted.
  "searched" looks for the largest error, "aimed" for the largest share of the tube while it holds.
- **cart-pole, ellipsoid**: the linear held control of the invariant ellipsoid, which keeps the
  state in its own region, each tube at the hold that it is proved for (0.1 s and 20 ms). A flight
  is held against it at the instants and at nine times between them.
- **spacecraft**: u* of the centralised policy every 0.1 s around its plans, against the certified
  position error; an episode is one agent. "climbed" is the sequence that the loop of the error,
  which knows no plan, stands worst.

    python benchmarks/studies/worst_case_certificates.py [--part NAME] [--json FILE]

Finished pieces are kept in runs/worst_case/; `--fresh` begins anew.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from theorem_one import CertificateTarget, TubeCheck
from worst_case_tracking import KINDS, SEED, SPACECRAFT_BOUNDS, drawn, spacecraft_case

from lagros_benchmarks.evidence.calibration import pretrained_hash
from lagros_benchmarks.run.files import plain, write_json
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    Law,
    draw_episodes,
    fly,
    policy_law,
    tracking_law,
)
from lagros_benchmarks.worst_case.search import SearchSettings, search
from lagros_benchmarks.worst_case.seeds import ATTACK
from lagros_benchmarks.worst_case.single import SingleTarget, energy_adversary
from lagros_envs.dynamics import hold_step
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tube import PaperTube
from lagros_policies.contraction.held_design import HeldDesign, HeldTube, design_held_contained
from lagros_policies.contraction.held_ellipsoid import prove_held_tube
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from lagros_policies.tasks.cartpole.plans import PlanBox

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

COMMAND = "python benchmarks/studies/worst_case_certificates.py"
FOLDER = Path("runs/worst_case_certificates")
# Cart-pole, held: scenarios of each case, random draws of each kind for each.
_HELD = (
    ("tube-mpc", 0.05),
    ("tube-mpc", 0.3),
    ("tube-mpc", 0.75),
    ("lagros", 0.3),
    ("lagros", 0.75),
)
_HELD_SCENARIOS, _HELD_DRAWS = 80, 3
_HELD_SEARCH = SearchSettings("gradient", budget=60, restarts=1)
# A search whose score is the share of the certified tube itself.
_AIMED_SEARCH = SearchSettings("cross-entropy", budget=200)
# Cart-pole, ellipsoid.
_ELLIPSOID_BOUND = 0.3
# Hold of the control [s], alpha of its tube [1/s].
_ELLIPSOIDS = {0.1: 0.5, 0.02: 0.8}
_ELLIPSOID_SCENARIOS = 200
# Times within a hold at which a flight is looked at, in shares of the hold.
_PHASES = np.linspace(0.1, 1.0, 10)
_ELLIPSOID_DRAWS = 8
_ELLIPSOID_SEARCH = SearchSettings("gradient", budget=60, restarts=1)
_SEARCH_RATE = 10.0
_PLANS = PlanBox()
_GOAL_RANGE = 1.5
_CHUNK = 10


def kept(name: str, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return a piece of the study from its file, or do it and write it."""
    path = FOLDER / f"{name}.json"
    if path.is_file():
        return dict(json.loads(path.read_text()))
    begun = perf_counter()
    piece = plain({**work(), "seconds": perf_counter() - begun})
    write_atomic(path, json.dumps(piece))
    return dict(piece)


def mixed_pushes(target: SingleTarget, draws: int, given: SearchSettings) -> dict[str, FloatArray]:
    """Return d/d_bar of all flights by how they were made, each (episodes, k, steps, 4)."""
    settings = target.flown.settings
    random = np.stack(
        [
            [
                drawn(kind, stream, settings.steps, 4, settings.control_period)
                for kind in KINDS
                for stream in episode_streams(seed).disturbance.spawn(draws)
            ]
            for seed in target.flown.seeds
        ]
    )
    starts = target.starts()
    searched = np.stack([one.sequence for one in search(target, given, SEED)])[:, None]
    return {
        "random": random,
        "constant": starts[:, :-1],
        "greedy": starts[:, -1:],
        "searched": searched,
    }


def held_case(policy: str, bound: float) -> dict[str, Any]:
    """Fly one policy under one bound against Theorem 1's tube."""
    expert = CartPoleExpert()
    episodes = draw_episodes(expert, episode_seeds(SEED, _HELD_SCENARIOS, ATTACK))
    if policy == "tube-mpc":
        law = tracking_law(expert, episodes)
    else:
        law = policy_law(LagrosPolicy(expert.task), episodes)
    adversary = energy_adversary(expert.metric)
    target = SingleTarget(episodes, law, "tube", bound, adversary)
    check = TubeCheck(expert, episodes, bound)
    rows = {}
    pushes = mixed_pushes(target, _HELD_DRAWS, _HELD_SEARCH)
    aimed = CertificateTarget(episodes, law, "tube", bound, adversary, check)
    found = search(aimed, _AIMED_SEARCH, SEED)
    pushes["aimed"] = np.stack([one.sequence for one in found])[:, None]
    for name, sequences in pushes.items():
        each = sequences.shape[1]
        which = np.repeat(np.arange(len(episodes.seeds)), each)
        flights = fly(episodes, law, which, bound * sequences.reshape(-1, *sequences.shape[2:]))
        held = check.hold(which, flights)
        error = np.linalg.norm(flights.states - episodes.plans[which], axis=-1)
        error = np.where(flights.alive, error, 0.0)
        rows[name] = {
            "flights": len(which),
            "crossed": int(held.certified_crossed.sum()),
            "whole_flight_in_region": int(held.in_region.sum()),
            "fallen": int(flights.fallen.sum()),
            "largest_share": float(held.certified_share.max()),
            "observed_tube": float(error.max()),
            "certified_radius": float(held.certified_radius.max()),
            "learning_error": float(held.learning_error.max()),
        }
    return {"unplanned": len(episodes.unplanned), "rows": rows}


def ellipsoid_tube(period: float) -> HeldTube:
    """Return the ellipsoid that is flown with a hold [s]."""
    design = HeldDesign(period, _ELLIPSOIDS[period], disturbance_bound=_ELLIPSOID_BOUND)
    return design_held_contained(CartPoleSettings().system, _PLANS, design)


def gentle_episodes(tube: HeldTube, chunk: int) -> Episodes:
    """Return episodes whose plans lie in the box of a tube, at its hold.

    Goals are drawn until a plan fits, which is the law of the scenarios and not a choice among
    outcomes: nothing has been flown yet.
    """
    coarse = CartPoleSettings()
    planner = CartPolePlanner(coarse)
    rng = np.random.default_rng([SEED, chunk])
    period = tube.design.period
    ratio = round(coarse.control_period / period)
    settings = replace(
        coarse,
        control_period=period,
        # For the search alone, which divides by it: constant but for the first instants, so that
        # the largest error at any time is looked for.
        tube=PaperTube(tube.steady_radius, _SEARCH_RATE),
    )
    goals: list[FloatArray] = []
    controls: list[FloatArray] = []
    planned: list[FloatArray] = []
    while len(goals) < _CHUNK:
        start, goal = np.zeros(4), np.zeros(4)
        goal[0] = rng.uniform(-_GOAL_RANGE, _GOAL_RANGE)
        plan = planner.plan(start, goal)
        box = np.array([np.inf, _PLANS.angle, _PLANS.velocity, _PLANS.angular_rate])
        fits = np.all(np.abs(plan.states) <= box) and np.all(np.abs(plan.controls) <= _PLANS.force)
        if plan.solved and fits:
            goals.append(goal)
            controls.append(np.repeat(plan.controls, ratio, axis=0))
            planned.append(plan.states)
    forces, instants = np.stack(controls), np.stack(planned)
    states = [instants[:, 0]]
    for step in range(settings.steps):
        state = hold_step(settings.system, states[-1], forces[:, step], settings.control_period)
        # The pole is unstable: without a new beginning at every instant of the plan, its forces
        # alone would carry the nominal trajectory away from it.
        after, left = divmod(step + 1, ratio)
        states.append(state if left else instants[:, after])
    seeds = episode_seeds(SEED + 1 + chunk, _CHUNK, ATTACK)
    return Episodes(
        settings,
        tuple(seeds),
        states[0],
        np.stack(goals),
        np.stack(states, axis=1),
        forces,
        np.zeros((len(seeds), 0, 3)),
    )


def ellipsoid_shares(
    tube: HeldTube, episodes: Episodes, which: IntArray, pushes: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Fly episodes and return what they used of a tube, at the instants and between them.

    Args:
        tube: The tube.
        episodes: The episodes.
        which: Episode of each flight, shape (b,).
        pushes: d, shape (b, steps, 4).

    Returns:
        The largest V / bound of V of each flight, that of |e_i| / bound of |e_i| and that of
        ||e||, each (b,), and which fell.
    """
    law = ellipsoid_law(tube, episodes)
    flights = fly(episodes, law, which, pushes)
    settings, period = episodes.settings, tube.design.period
    states, nominals = flights.states[:, :-1], episodes.plans[which, :-1]
    controls = episodes.controls[which]
    begun = period * np.arange(settings.steps)
    energy, output, whole = np.zeros((3, len(which)))
    for phase in _PHASES:
        state = hold_step(settings.system, states, flights.controls, phase * period, pushes)
        error = state - hold_step(settings.system, nominals, controls, phase * period)
        times = begun + phase * period
        used = tube.energy(phase, error, flights.controls - controls) / tube.share(times) ** 2
        bounds = np.stack([tube.output_radius(axis, times) for axis in np.eye(4)], axis=-1)
        energy = np.maximum(energy, used.max(axis=1))
        output = np.maximum(output, (np.abs(error) / bounds).max(axis=(1, 2)))
        whole = np.maximum(whole, np.linalg.norm(error, axis=-1).max(axis=1))
    return energy, output, whole, flights.fallen


def ellipsoid_law(tube: HeldTube, episodes: Episodes) -> Law:
    """Return the control of a tube around the plans of episodes."""

    def law(state: FloatArray, episode: IntArray, step: IntArray) -> FloatArray:
        return tube.control(state, episodes.plans[episode, step], episodes.controls[episode, step])

    return law


def ellipsoid_chunk(tube: HeldTube, chunk: int) -> dict[str, Any]:
    """Fly some scenarios against the ellipsoid."""
    episodes = gentle_episodes(tube, chunk)
    inverse = np.linalg.inv(tube.duals[0, :4, :4])

    def greedy(state: FloatArray, nominal: FloatArray) -> FloatArray:
        return (state - nominal) @ inverse

    bound = _ELLIPSOID_BOUND
    law = ellipsoid_law(tube, episodes)
    target = SingleTarget(episodes, law, "tube", bound, greedy)
    rows = {}
    for name, sequences in mixed_pushes(target, _ELLIPSOID_DRAWS, _ELLIPSOID_SEARCH).items():
        which = np.repeat(np.arange(_CHUNK), sequences.shape[1])
        pushes = bound * sequences.reshape(-1, *sequences.shape[2:])
        energy, output, whole, fallen = ellipsoid_shares(tube, episodes, which, pushes)
        rows[name] = {
            "flights": len(which),
            "crossed": int(np.count_nonzero((energy > 1.0 + 1e-9) | (output > 1.0 + 1e-9))),
            "fallen": int(fallen.sum()),
            "largest_share": float(np.sqrt(energy.max())),
            "largest_output_share": float(output.max()),
            "observed_tube": float(whole.max()),
            "certified_radius": tube.steady_radius,
        }
    return {"rows": rows}


def part_held() -> list[dict[str, Any]]:
    """Return one row for each policy, bound and way of making disturbances."""
    rows = []
    for policy, bound in _HELD:
        piece = kept(
            f"held-{policy}-{bound}-{pretrained_hash('cartpole')}",
            partial(held_case, policy, bound),
        )
        about = {"part": "cartpole-held", "policy": policy, "bound": bound}
        rows += [{**about, "made": made, **row} for made, row in piece["rows"].items()]
    return rows


def part_ellipsoid() -> list[dict[str, Any]]:
    """Return one row for each hold and way of making disturbances, added up over the chunks."""
    rows = []
    for period in _ELLIPSOIDS:
        tube = ellipsoid_tube(period)
        proof = kept(f"ellipsoid-held-{period}-proof", partial(ellipsoid_proof, tube))
        part = f"cartpole-ellipsoid, {1000 * period:g} ms"
        about = {"part": part, "policy": "u_d + K e", "bound": _ELLIPSOID_BOUND}
        chunks = [
            kept(f"ellipsoid-held-{period}-{chunk}", partial(ellipsoid_chunk, tube, chunk))
            for chunk in range(_ELLIPSOID_SCENARIOS // _CHUNK)
        ]
        for made in chunks[0]["rows"]:
            parts = [chunk["rows"][made] for chunk in chunks]
            row = {name: max(part[name] for part in parts) for name in parts[0]}
            for name in ("flights", "crossed", "fallen"):
                row[name] = sum(part[name] for part in parts)
            rows.append({**about, "made": made, **row, "tube_proved": proof["proved"]})
    return rows


def ellipsoid_proof(tube: HeldTube) -> dict[str, Any]:
    """Prove the tube that is flown, for its hold."""
    return {"proved": prove_held_tube(CartPoleSettings().system, tube).proved}


def part_spacecraft() -> list[dict[str, Any]]:
    """Return one row for each bound and way of making disturbances."""
    rows = []
    for bound in SPACECRAFT_BOUNDS:
        piece = kept(
            f"spacecraft-{bound}-{pretrained_hash('spacecraft')}", partial(spacecraft_case, bound)
        )
        about = {"part": "spacecraft", "policy": "centralized (u*)", "bound": bound}
        rows += [{**about, "made": made, **row} for made, row in piece["rows"].items()]
    return rows


PARTS: dict[str, Callable[[], list[dict[str, Any]]]] = {
    "held": part_held,
    "ellipsoid": part_ellipsoid,
    "spacecraft": part_spacecraft,
}


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="certified bounds against random, greedy and searched disturbances")
    for heading in (
        "part",
        "policy",
        "d̄",
        "made",
        "flights",
        "crossed",
        "share",
        "observed",
        "bound",
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row["part"],
            row["policy"],
            f"{row['bound']:g}",
            row["made"],
            str(row["flights"]),
            str(row["crossed"]),
            f"{100 * row['largest_share']:.1f} %",
            f"{row['observed_tube']:.3g}",
            f"{row['certified_radius']:.3g}",
        )
    Console(width=120).print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Try to cross the certified bounds.")
    parser.add_argument("--part", choices=tuple(PARTS), help="only that part")
    parser.add_argument("--fresh", action="store_true", help="forget the pieces kept")
    parser.add_argument(
        "--json", type=Path, default=Path("benchmarks/results/worst_case_certificates.json")
    )
    options = parser.parse_args()
    if options.fresh:
        for path in FOLDER.glob("*.json"):
            path.unlink()
    rows = [row for name in PARTS if options.part in (None, name) for row in PARTS[name]()]
    show(rows)
    total = {
        part: sum(row["flights"] for row in rows if row["part"] == part)
        for part in dict.fromkeys(row["part"] for row in rows)
    }
    write_json(
        options.json,
        {
            "command": COMMAND + (f" --part {options.part}" if options.part else ""),
            "flights": total,
            "crossed": sum(row["crossed"] for row in rows),
            "rows": rows,
        },
    )


if __name__ == "__main__":
    main()
