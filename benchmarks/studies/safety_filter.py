"""What does the safety filter do to a policy, and what does it cost?

Flies two policies with and without `SafetyFilter` in the preset `paper` with six agents under a
uniform disturbance, on the same worlds: one that flies straight to its goal at 0.25 m/s whatever is
in between, and the centralised planner (d), which should not be hurt. Rates are per agent, with
Wilson intervals that take agents for independent, which those of one world are not quite. Then it
times the filter, and its exact solution of the quadratic programs that the flights met against
OSQP, one program at a time.

    python benchmarks/studies/safety_filter.py [--worlds 100] [--planned 20] [--bound 0.2,0.6,1.0]
        [--seed 0] [--json FILE]

The margins and rates of `lagros_policies/safety/barrier.py` were chosen with this straight flight
in worlds of other seeds (`episode_seeds(n, 100, 12345)` with n from 1 to 13).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import osqp
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy import sparse

from lagros_benchmarks.run.metrics import wilson_interval
from lagros_envs.files import write_atomic
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.spacecraft.physics import HEADING
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.policy import Policy, PolicyState
from lagros_policies.safety.barrier import BarrierSettings
from lagros_policies.safety.half_planes import nearest
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.thrusters import thrust_for_acceleration, to_body

PRESET, AGENTS = "paper", 6
SETTINGS = SpacecraftSettings()
LAYOUT = Layout.for_preset(PRESETS[PRESET].for_agents(AGENTS), SETTINGS)
RATES = ("success", "strict_success", "collided")
_WIDTH = 180  # of the tables, whatever the terminal

FloatArray = NDArray[np.float64]


class StraightPolicy:
    """Flies straight to the goal, at 0.25 m/s and slower near it, whatever is in between."""

    name = "straight"
    observes: Literal["local", "global"] = "local"
    speed, approach_rate, damping, spin_damping = 0.25, 0.8, 3.0, 0.6

    def predict(
        self,
        observation: NDArray[np.float32],
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], PolicyState]:
        """Damp the velocity towards the wanted one."""
        sensed = Sensed.of(LAYOUT, observation)
        distance = np.linalg.norm(sensed.goal, axis=1, keepdims=True)
        gain = np.minimum(self.approach_rate, self.speed / np.maximum(distance, 1e-9))
        push = np.empty((len(distance), 3))
        push[:, :2] = self.damping * (gain * sensed.goal - sensed.velocity)
        push[:, 2] = -self.spin_damping * sensed.spin
        states = np.zeros((len(push), 6))
        states[:, HEADING] = sensed.heading + 0.5 * SETTINGS.control_period * sensed.spin
        return thrust_for_acceleration(SETTINGS.system, states, push).astype(np.float32), state


class Recorder(SafetyFilter):
    """The filter, noting some of the actions that it changed and their situations."""

    def __init__(self, policy: Policy, bound: float) -> None:
        """Start without notes."""
        super().__init__(policy, SETTINGS, PRESET, AGENTS, bound)
        self.noted: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []

    def predict(
        self,
        observation: NDArray[np.float32],
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], PolicyState]:
        """Note one world in each step: its observations and the inner actions."""
        rows = observation[: AGENTS * (len(observation) // AGENTS)].reshape(-1, AGENTS, LAYOUT.size)
        chosen = rows[len(self.noted) % len(rows)]
        self.noted.append((chosen, self.policy.predict(chosen)[0]))
        return super().predict(observation, state, episode_start, deterministic)


def fly(
    policy: Policy, seeds: list[int], bound: float
) -> tuple[dict[str, NDArray[Any]], PolicyState]:
    """Fly worlds side by side to the time limit; return the measures of all agents and the state.

    Worlds whose agents have all collided drift on, which changes none of the measures.
    """
    env = SpacecraftVectorEnv(
        AGENTS * len(seeds),
        AGENTS,
        PRESET,
        "uniform",
        bound,
        settings=SETTINGS,
        compiled=False,
        autoreset_mode="disabled",
    )
    observation, info = env.reset(seed=seeds)
    state: PolicyState = None
    for _ in range(SETTINGS.steps):
        seen = observation if policy.observes == "local" else env.state()
        action, state = policy.predict(seen, state)
        observation, _, _, _, info = env.step(action.reshape(env.num_envs, -1))
    return info, state


def row_of(
    policy: Policy, label: str, bound: float, measures: dict[str, NDArray[Any]], state: PolicyState
) -> dict[str, Any]:
    """Return the figures of one policy under one bound."""
    row: dict[str, Any] = {
        "policy": label,
        "bound": bound,
        "agents_flown": measures["success"].size,
    }
    for name in RATES:
        row[f"{name}_rate"] = float(measures[name].mean())
        row[f"{name}_ci95"] = list(wilson_interval(int(measures[name].sum()), row["agents_flown"]))
    # Neither at the goal nor collided: stuck, or on the way still.
    row["late_rate"] = float(np.mean(~measures["success"] & ~measures["collided"]))
    arrived = measures["success"]
    row["effort_mean"] = float(measures["effort_to_success"][arrived].mean())
    row["arrival_mean_s"] = float(measures["success_time"][arrived].mean())
    count = getattr(policy, "counters", None)
    row["counters"] = {} if count is None else count(state)
    return row


def study(
    worlds: int, planned: int, bounds: list[float], seed: int
) -> tuple[list[dict[str, Any]], Recorder]:
    """Fly every policy in the same worlds under every bound."""
    seeds = episode_seeds(seed, worlds, EVALUATION)
    rows = []
    recorder = Recorder(StraightPolicy(), bounds[-1])
    for bound in bounds:
        recorder = Recorder(StraightPolicy(), bound)
        still = replace(BarrierSettings.for_bound(bound), sidestep_speed=0.0)
        entries: list[tuple[str, Policy, int]] = [
            ("straight", StraightPolicy(), worlds),
            ("straight, filter", recorder, worlds),
            (
                "straight, no sidestep",
                SafetyFilter(StraightPolicy(), SETTINGS, PRESET, AGENTS, barrier=still),
                worlds,
            ),
        ]
        if planned:
            central = CentralizedPolicy(SETTINGS, PRESET, AGENTS, bound)
            filtered = SafetyFilter(central, SETTINGS, PRESET, AGENTS, bound)
            entries += [
                ("centralized", central, planned),
                ("centralized, filter", filtered, planned),
            ]
        for label, policy, count in entries:
            measures, state = fly(policy, seeds[:count], bound)
            rows.append(row_of(policy, label, bound, measures, state))
    return rows, recorder


def microseconds(call: Callable[[], Any], least: int = 200) -> float:
    """Return the median time of a call [us]."""
    call()
    spans = []
    for _ in range(least):
        start = time.perf_counter()
        call()
        spans.append(time.perf_counter() - start)
    return 1e6 * float(np.median(spans))


def programs(recorder: Recorder) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return wanted points, normals and bounds of the programs met, with a box each."""
    observations, actions = (np.concatenate(part) for part in zip(*recorder.noted, strict=True))
    sensed = Sensed.of(LAYOUT, observations)
    first, second, _ = SETTINGS.system.wrench(list(np.maximum(actions, 0.0).T))
    wanted = to_body(np.stack([first, second], axis=-1), -sensed.heading) / SETTINGS.system.mass
    planes = recorder.barrier.half_planes(sensed.velocity, *sensed[1:])
    box = np.broadcast_to(np.vstack([np.eye(2), -np.eye(2)]), (len(wanted), 4, 2))
    normals = np.concatenate([np.stack([planes.x, planes.y], axis=-1), box], axis=1)
    bounds = np.concatenate([planes.bounds, np.full((len(wanted), 4), -4.0)], axis=1)
    unmet = np.any(np.einsum("bkc,bc->bk", normals, wanted) < bounds, axis=1)
    return wanted[unmet], normals[unmet], bounds[unmet]


def against_osqp(recorder: Recorder) -> dict[str, float]:
    """Solve the same programs exactly, and with OSQP one by one: set up anew, and updated."""
    wanted, normals, bounds = programs(recorder)
    answer = nearest(wanted, normals, bounds)
    open_ = answer.violation == 0.0
    slots = bounds.shape[1]
    # Every entry of the matrix is kept, so that OSQP can be updated.
    pattern = sparse.csc_matrix(np.ones((slots, 2)))
    options = {"verbose": False, "eps_abs": 1e-6, "eps_rel": 1e-6, "max_iter": 20000}
    identity = sparse.eye(2, format="csc")
    high = np.full(slots, np.inf)

    def fresh(row: int) -> Any:
        solver = osqp.OSQP()
        matrix = pattern.copy()
        matrix.data = normals[row].T.ravel()
        solver.setup(identity, -wanted[row], matrix, bounds[row], high, **options)
        return solver

    kept = fresh(0)

    def updated(row: int) -> Any:
        kept.update(q=-wanted[row], l=bounds[row], Ax=normals[row].T.ravel())
        return kept.solve(raise_error=False)

    def one(row: int) -> Any:
        return nearest(wanted[row : row + 1], normals[row : row + 1], bounds[row : row + 1])

    some = np.flatnonzero(open_)[:200]
    apart = [
        float(np.max(np.abs(fresh(row).solve(raise_error=False).x - answer.points[row])))
        for row in some
    ]
    index = iter(np.resize(some, 2000))
    few = np.arange(min(6, len(wanted)))
    return {
        "programs": len(wanted),
        "infeasible": int(np.sum(~open_)),
        "largest_difference": max(apart),
        "nearest_one_us": microseconds(lambda: one(int(next(index)))),
        "nearest_six_us_per_row": microseconds(
            lambda: nearest(wanted[few], normals[few], bounds[few])
        )
        / len(few),
        "nearest_all_us_per_row": microseconds(lambda: nearest(wanted, normals, bounds), 10)
        / len(wanted),
        "osqp_fresh_us": microseconds(lambda: fresh(int(next(index))).solve(raise_error=False)),
        "osqp_updated_us": microseconds(lambda: updated(int(next(index)))),
    }


def overhead(recorder: Recorder) -> dict[str, float]:
    """Time what the filter adds to an action: sensing taken apart, filter, counters [us]."""
    observations, actions = (np.concatenate(part) for part in zip(*recorder.noted, strict=True))
    _, changed, _ = recorder.filter(actions, Sensed.of(LAYOUT, observations))
    free, busy = np.flatnonzero(~changed), np.flatnonzero(changed)
    groups = {
        "one_unchanged": free[:1],
        "one_changed": busy[:1],
        "six_as_met": np.arange(AGENTS),
        "six_changed": busy[:AGENTS],
        "all_as_met": np.arange(len(actions)),
    }
    times = {}
    for name, rows in groups.items():
        worn = SafetyFilter(Answers(actions[rows]), SETTINGS, PRESET, AGENTS)
        worn.barrier = recorder.barrier
        seen = observations[rows]
        span = microseconds(partial(worn.predict, seen), 100)
        times[f"{name}_us_per_row"] = span / len(rows)
    return times


class Answers:
    """A policy that takes no time."""

    name = "answers"
    observes: Literal["local", "global"] = "local"

    def __init__(self, actions: NDArray[np.float32]) -> None:
        """Remember what to answer."""
        self.actions = actions

    def predict(
        self,
        observation: NDArray[np.float32],
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], PolicyState]:
        """Return the actions."""
        return self.actions, state


def show(rows: list[dict[str, Any]], timings: dict[str, dict[str, float]]) -> None:
    """Print the flights and the timings."""
    console = Console(width=_WIDTH)
    table = Table(title=f"Safety filter, {PRESET}, {AGENTS} agents, uniform disturbance")
    headings = ("bound", "policy", "success %", "strict %", "collided %", "late %", "effort")
    for heading in (*headings, "arrives s", "changed %", "infeasible %"):
        table.add_column(heading, justify="left" if heading == "policy" else "right")
    for row in rows:
        rates = []
        for name in RATES:
            low, high = row[f"{name}_ci95"]
            rates.append(f"{100 * row[f'{name}_rate']:.1f} [{100 * low:.1f}, {100 * high:.1f}]")
        steps = row["counters"].get("filtered_steps", 0)
        shares = [
            f"{100 * row['counters'][name] / steps:.2f}" if steps else ""
            for name in ("interventions", "infeasible")
        ]
        table.add_row(
            f"{row['bound']:g}",
            row["policy"],
            *rates,
            f"{100 * row['late_rate']:.1f}",
            f"{row['effort_mean']:.2f}",
            f"{row['arrival_mean_s']:.1f}",
            *shares,
        )
    console.print(table)
    for title, figures in timings.items():
        console.print(f"{title}: " + ", ".join(f"{k} {v:.3g}" for k, v in figures.items()))


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Fly policies with and without the safety filter.")
    parser.add_argument("--worlds", type=int, default=100)
    parser.add_argument("--planned", type=int, default=20, help="worlds of the centralised planner")
    parser.add_argument("--bound", default="0.2,0.6,1.0", help="disturbance bounds, by commas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the figures there")
    options = parser.parse_args()
    bounds = [float(part) for part in options.bound.split(",")]
    rows, recorder = study(options.worlds, options.planned, bounds, options.seed)
    timings = {"programs": against_osqp(recorder), "overhead": overhead(recorder)}
    show(rows, timings)
    if options.json is not None:
        write_atomic(options.json, json.dumps({"flights": rows, **timings}, indent=1) + "\n")


if __name__ == "__main__":
    main()
