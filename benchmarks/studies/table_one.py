"""Table I of the paper, each entry computed: what the policies map, their bounds, their load.

Nothing in a row is typed in but the policy's name:

- *maps*: parts of the observation that change the action, and whether the action lies nearer to
  u_d or to u* along closed loops under the uniform disturbance of 0.75;
- *tracking error*: the bound that this target calls for (Lemma 1 for u_d, Theorem 1 for u*), at
  several times on the region of the certificate, and whether it grows or settles; and the largest
  error seen;
- *load*: plans and network evaluations per control step, and the median time of a step.

    python benchmarks/studies/table_one.py [--json FILE] [--markdown FILE] [--episodes 10]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import lagros_envs  # noqa: F401  (registers the environment)
from lagros_benchmarks.evidence.records import recorded_error
from lagros_benchmarks.evidence.single import Question
from lagros_benchmarks.tasks.cartpole.certify import certify_metric, metric_to_prove
from lagros_benchmarks.worst_case.flights import draw_episodes, fly, law_of, random_pushes
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import Samples, diverging_bound, load_metric
from lagros_policies.contraction.theorems import contraction_distance
from lagros_policies.contraction.tube import Tube
from lagros_policies.policy import make
from lagros_policies.tasks.cartpole.expert import CartPoleExpert

FloatArray = NDArray[np.float64]

_POLICIES = ("learned", "tube-mpc", "lagros")
_BOUND = 0.75
_NAMESPACE = 37
_TIMES = (0.5, 1.0, 2.0, 9.0, 18.0)
_PARTS = {
    "x": task.STATE,
    "o_l": slice(task.GOAL.start, task.INITIAL_STATE.stop),
    "t": slice(task.TIME, task.TIME + 1),
}


def flown(policy: Any, name: str, episodes: int) -> dict[str, Any]:
    """Fly episodes and return what the policy did."""
    env: Any = gym.make(
        "lagros/CartPole-v0",
        disturbance="uniform",
        disturbance_bound=_BOUND,
        disable_env_checker=True,
    ).unwrapped
    expert = CartPoleExpert()
    to_plan, to_control, times, largest = [], [], [], 0.0
    counts: dict[str, int] = {}
    steps = 0
    inputs: set[str] = set()
    for seed in episode_seeds(0, episodes, _NAMESPACE):
        env.reset(seed=seed)
        plan = expert.planner.plan(env.scenario.initial_state, env.scenario.goal)
        tracked = expert.track(plan.states[None], plan.controls[None])
        observation, _ = env.reset(seed=seed, options={"nominal": plan.states})
        memory: Any = None
        for step in range(env.settings.steps):
            first = np.array([step == 0])
            begun = time.perf_counter()
            action, memory = policy.predict(observation, memory, first, True)
            times.append(time.perf_counter() - begun)
            if step == env.settings.steps // 20:
                inputs |= depends_on(policy, observation)
            force = float(np.ravel(action)[0]) * env.settings.force_scale
            state = np.asarray(env.state, dtype=np.float64)
            index, at = np.array([0]), np.array([step])
            wanted = float(expert.control(tracked, index, at, state[None])[0, 0])
            to_plan.append(force - float(plan.controls[step, 0]))
            to_control.append(force - wanted)
            observation, _, terminated, _, info = env.step(np.ravel(action))
            largest = max(largest, float(info["tracking_error"]))
            steps += 1
            if terminated:
                break
        if hasattr(policy, "counters") and memory is not None:
            for key, value in policy.counters(memory).items():
                counts[key] = counts.get(key, 0) + int(value)
    return {
        "inputs": [part for part in _PARTS if part in inputs],
        "distance_to_plan": float(np.sqrt(np.mean(np.square(to_plan)))),
        "distance_to_control": float(np.sqrt(np.mean(np.square(to_control)))),
        "step_time_median_s": float(np.median(times)),
        "networks_per_step": 1 if hasattr(policy, "bare_forward") else 0,
        "plans_per_step": counts.get("plans", 0) / steps,
        "largest_error": largest,
        "policy": name,
    }


def depends_on(policy: Any, observation: Any) -> set[str]:
    """Return the parts of an observation that change what a fresh policy answers."""
    start = np.array([True])
    base, _ = policy.predict(observation, None, start, True)
    found = set()
    for part, place in _PARTS.items():
        moved = np.array(observation, copy=True)
        moved[place] += np.asarray(0.1, moved.dtype)
        answer, _ = policy.predict(moved, None, start, True)
        if not np.array_equal(answer, base):
            found.add(part)
    return found


def control_error(name: str, region: dict[str, Any], episodes: int) -> float:
    """Return how far a policy was from controls that contract in the metric, in its region [N]."""
    expert = CartPoleExpert()
    flights = draw_episodes(expert, episode_seeds(1, episodes, _NAMESPACE))
    law, every = law_of(name, flights), np.arange(len(flights.seeds))
    done = fly(flights, law, every, random_pushes(flights, "uniform", _BOUND))
    state, nominal, force = done.states[:, :-1], flights.plans[:, :-1], flights.controls
    error = np.abs(state - nominal)
    inside = np.abs(force[..., 0]) <= region["u_d"][1]
    for place, coordinate in ((1, "theta"), (2, "p_dot"), (3, "theta_dot")):
        inside &= np.maximum(np.abs(state), np.abs(nominal))[..., place] <= region[coordinate][1]
    for place, coordinate in ((1, "theta_error"), (3, "theta_dot_error")):
        inside &= error[..., place] <= region[coordinate][1]
    # At e = 0 nothing is asked of the control.
    inside &= error.max(axis=-1) > 0.0
    samples = Samples(state[inside], nominal[inside], force[inside])
    metric: Any = load_metric(metric_to_prove(None)[0], 4)
    off = contraction_distance(CartPoleSettings().system, metric, samples, done.controls[inside])
    return float(off.max(initial=0.0))


def bounded(row: dict[str, Any], certificate: dict[str, Any], episodes: int) -> dict[str, Any]:
    """Return the bound that a row's target calls for."""
    times = np.array(_TIMES)
    follows_plan = row["distance_to_plan"] < row["distance_to_control"]
    if follows_plan:
        error = recorded_error(CartPoleSettings(), row["policy"])
        radii = diverging_bound(
            times, certificate["lipschitz"], _BOUND, error, certificate["b_bar"]
        )
        theorem = "Lemma 1"
    else:
        error = control_error(row["policy"], certificate["region"], episodes)
        rate = certificate["disturbed_rate"]
        tube = Tube(
            rate if rate > 0.0 else certificate["alpha"],
            certificate["chi"],
            _BOUND,
            error,
            certificate["b_bar"],
        )
        radii, theorem = tube.radius(times), "Theorem 1"
    # What settles gains less from T to 2 T than it has gained before.
    grows = bool(radii[-1] - radii[-2] > radii[-2])
    ratio = float(np.log(radii[-1] / radii[-2]) / (times[-1] - times[-2]))
    return {
        "target": "u_d" if follows_plan else "u*",
        "theorem": theorem,
        "learning_error": error,
        "times": list(_TIMES),
        "bound": radii.tolist(),
        "error": f"increases exponentially, by {ratio:.3g} /s"
        if grows
        else "exponentially bounded",
    }


def markdown(rows: list[dict[str, Any]], certificate: dict[str, Any]) -> str:
    """Return the table."""
    lines = [
        "| policy | maps | bound of ‖x − x_d‖ | after 0.5, 1, 2, 9, 18 s | largest seen | load |",
        "|---|---|---|---|---:|---|",
    ]
    for row in rows:
        work = []
        if row["networks_per_step"]:
            work.append(f"{row['networks_per_step']} network evaluation")
        if row["plans_per_step"]:
            plans = f"{row['plans_per_step']:.2g}"
            work.append(f"{plans} plan" if plans == "1" else f"{plans} plans")
        radii = ", ".join(f"{radius:.3g}" for radius in row["bound"])
        near, far = row["distance_to_plan"], row["distance_to_control"]
        cells = (
            row["policy"],
            f"({', '.join(row['inputs'])}) ↦ {row['target']} ({near:.2g} N from u_d, {far:.2g} N "
            "from u*)",
            f"{row['error']} ({row['theorem']})",
            radii,
            f"{row['largest_error']:.3g}",
            f"{' and '.join(work)}, {1e3 * row['step_time_median_s']:.3g} ms",
        )
        lines.append(f"| {' | '.join(cells)} |")
    channels = "all states" if certificate["channels"] == "all" else "the two rates"
    lines += [
        "",
        f"d̄ = {_BOUND:g}, α = {certificate['alpha']:.4g} 1/s, χ = {certificate['chi']:.4g}, b̄ = "
        f"{certificate['b_bar']:.4g}, L_f = {certificate['lipschitz']:.4g} 1/s on the region of "
        f"the certificate, while x stays there; disturbances of {channels} in Theorem 1. "
        "L_f is that of a u_d which does not answer to x, as a plan does not; a network's does, "
        "which adds ‖B ∂u_d/∂x‖ to it: the bound of Lemma 1 is the paper's formula there, and no "
        "proof.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Compute the table."""
    parser = argparse.ArgumentParser(description="Table I, computed.")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--markdown", type=Path, default=None)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=60.0, help="for each proof")
    wanted = parser.parse_args()
    asked = Question("u*", _BOUND, 0, seconds=wanted.seconds)
    found = certify_metric(CartPoleSettings(), asked)
    certificate = found.as_json()
    env = gym.make("lagros/CartPole-v0", disable_env_checker=True)
    rows = []
    for name in _POLICIES:
        # A part of the observation is moved, also to where no training was.
        policy = make(name, env, allow_other_settings=True)
        row = flown(policy, name, wanted.episodes)
        rows.append({**row, **bounded(row, certificate, wanted.episodes)})
    text = markdown(rows, certificate)
    sys.stdout.write(text)
    names = (
        *("alpha", "chi", "nu", "b_bar", "epsilon_l", "d_bar", "channels"),
        *("region", "lipschitz"),
    )
    record: dict[str, Any] = {
        "rows": rows,
        "certificate": {name: certificate[name] for name in names},
    }
    record["certificate"]["holds"] = found.holds
    if wanted.json is not None:
        write_atomic(wanted.json, json.dumps(record, indent=1) + "\n")
    if wanted.markdown is not None:
        write_atomic(wanted.markdown, text)


if __name__ == "__main__":
    main()
