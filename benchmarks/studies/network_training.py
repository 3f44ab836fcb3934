"""Which form of network (c) can be proved, and what does it cost?

The same labelled states of the task's law and the same passes for each form of network:

- `mlp`: all that is seen goes through tanh layers, the error of u alone is in the loss (the paper);
- `mlp, slope`: the error of the slope du/dx against the law's gain K is in the loss as well;
- `scheduled`: affine in the state, u = c + K x with c and K made of episode and time (`Mlp`);
- `scheduled, slope`: both.

Each is measured on plans that no training saw: errors of u and of the slope; flights beside the
law's (the same starts and disturbances); and the share of episodes for which it is *proved*, by the
tube around the network's own undisturbed flight, that it reaches the goal and never falls whatever
the disturbance does up to d_bar.

    OMP_NUM_THREADS=1 python benchmarks/studies/network_training.py [--plans 400]
        [--samples 100000] [--epochs 40] [--flights 200] [--proofs 20]
        [--json benchmarks/results/network_training.json]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from lagros_envs.arrays import Float32Array, FloatArray
from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.dynamics import hold_step
from lagros_envs.files import write_atomic
from lagros_envs.numbers import functions
from lagros_envs.registry import find_task
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.task import Scenario, Task
from lagros_policies.expert import Expert, TrackedPlans
from lagros_policies.learning.dataset import ExpertData, ExpertDataSettings, generate
from lagros_policies.learning.features import moved, seen, view_of
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.rounds import flown
from lagros_policies.learning.train import Moves, TrainingSettings, fit, learning_error
from lagros_policies.proof.guarantee import guarantees
from lagros_policies.proof.network_steering import network_flight
from lagros_policies.proof.plan_tube import plan_tubes

_NAMESPACE = 53
_KINDS = ("uniform", "constant", "gust", "switching")
# Each form is tried until less than this share of its episodes is proved.
_BOUNDS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.25, 0.3)
_ENOUGH = 0.9
_FORMS = {
    "mlp": (False, 0.0),
    "mlp, slope": (False, 0.3),
    "scheduled": (True, 0.0),
    "scheduled, slope": (True, 0.3),
}


@dataclass(frozen=True)
class Samples:
    """Labelled states as a network sees them.

    Attributes:
        features: Shape (s, f).
        labels: Shape (s, m).
        moves: How they move along a direction each.
    """

    features: Float32Array
    labels: Float32Array
    moves: Moves


def samples_of(task: Task, data: ExpertData) -> Samples:
    """Return what a network is fitted to or tested on."""
    see, rng = view_of(task), np.random.default_rng(0)
    features, signs = seen(see, data.observation.astype(np.float32))
    way, slope = data.moves(task, rng)
    ways = np.zeros_like(data.observation)
    ways[:, task.layout.state] = way
    side = np.ones_like(slope) if signs is None else signs
    along = moved(see, data.observation, ways).astype(np.float32)
    moves = Moves(along, (slope * side).astype(np.float32))
    return Samples(features, (data.control * side).astype(np.float32), moves)


def slope_error(network: Mlp, test: Samples) -> float:
    """Return the mean error of the slope along the directions, in units of u: errors' own size."""
    step = np.float32(0.1)
    ends = [network(test.features + end * test.moves.features) for end in (step, -step)]
    return float(np.abs((ends[0] - ends[1]) / (2.0 * step) - test.moves.labels).mean())


class Episodes:
    """Random episodes with their plans, and what is counted of flights of them.

    Args:
        task: The task.
        count: How many.
    """

    def __init__(self, task: Task, count: int) -> None:
        self.task, self.expert = task, Expert(task)
        self.seeds = episode_seeds(0, count, _NAMESPACE)
        self.scenarios: list[Scenario] = []
        states, controls = [], []
        for seed in self.seeds:
            scenario = task.sample(episode_streams(seed).scenario)
            plan = self.expert.planner.plan(scenario.initial_state, scenario.goal, 0)
            self.scenarios.append(scenario)
            states.append(plan.states)
            controls.append(plan.controls)
        self.tracked: TrackedPlans = self.expert.track(np.array(states), np.array(controls))
        self.goals = np.array([scenario.goal for scenario in self.scenarios])

    def pushes(self, kind: str, bound: float) -> FloatArray:
        """Draw disturbances, the same for whoever flies, shape (p, N, n)."""
        n, period = self.task.system.state_dim, self.task.control_period
        drawn = [
            OPEN_LOOP[kind].realise(episode_streams(s).disturbance, self.task.steps, n, period)
            for s in self.seeds
        ]
        return bound * np.stack(drawn)

    def by_law(self, pushes: FloatArray) -> FloatArray:
        """Return the states of flights of the law, shape (p, N + 1, n)."""
        states = [self.tracked.states[:, 0]]
        every = np.arange(len(states[0]))
        for step in range(self.task.steps):
            now = np.full(len(every), step)
            control = self.expert.control(self.tracked, every, now, states[-1])
            period, push = self.task.control_period, pushes[:, step]
            states.append(hold_step(self.task.system, states[-1], control, period, push))
        return np.stack(states, axis=1)

    def counted(self, fly: Callable[[FloatArray], FloatArray]) -> dict[str, Any]:
        """Return success and strict success under each kind at the task's bound, in percent."""
        task, found = self.task, {}
        radius = np.array(
            [task.success_radius(task.control_period * k) for k in range(task.steps + 1)]
        )
        for kind in _KINDS:
            states = fly(self.pushes(kind, task.defaults.bound))
            down = np.asarray(task.fallen(list(np.moveaxis(states, -1, 0)), functions))
            # Flights of networks stop before they fall.
            still = np.all(states[:, 1:] == states[:, :-1], axis=-1)
            stands = ~(down.any(axis=1) | still.any(axis=1))
            near = np.linalg.norm(states - self.goals[:, None], axis=-1) <= radius
            found[kind] = [
                100.0 * float(np.mean(stands & one)) for one in (near.any(axis=1), near[:, -1])
            ]
        return found


def proved(task: Task, network: Mlp, scenarios: Sequence[Scenario]) -> list[dict[str, Any]]:
    """Return for each bound, the shares of episodes with a tube and with a guarantee."""
    flight = network_flight(task, network, scenarios)
    goals = np.array([scenario.goal for scenario in scenarios])
    rows: list[dict[str, Any]] = []
    discs = np.zeros((len(scenarios), 0, 3))
    for bound in _BOUNDS:
        begun = perf_counter()
        tubes = plan_tubes(
            task.system,
            task.control_period,
            flight.states,
            flight.controls,
            flight.steering,
            bound,
        )
        found = guarantees(task, goals, discs, flight.states, flight.controls, tubes)
        largest = found.norm[found.closed].max(axis=1, initial=0.0)
        rows.append(
            {
                "bound": bound,
                "tube": float(found.closed.mean()),
                "guaranteed": float(found.holds.mean()),
                "largest_error_per_bound": float(np.median(largest)) / bound
                if len(largest)
                else None,
                "seconds_per_episode": (perf_counter() - begun) / len(scenarios),
            }
        )
        if rows[-1]["guaranteed"] < _ENOUGH:
            break
    return rows


def study(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Train and measure every form."""
    task: Any = find_task(options.task)
    metric: Any = Expert(task).metric
    how = task.learning
    shards = 10
    settings = [
        ExpertDataSettings(plans, samples, shards, how.disturbance_bound, seed=seed)
        for plans, samples, seed in ((options.plans, options.samples, 100), (100, 10_000, 101))
    ]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        train, test = (
            samples_of(task, generate(folder / str(one.seed), metric, one, task))
            for one in settings
        )
        episodes = Episodes(task, options.flights)
        rows.append({"form": "law", "flights": episodes.counted(episodes.by_law)})
        for form, (scheduled, weight) in _FORMS.items():
            begun = perf_counter()
            made = TrainingSettings(
                how.hidden,
                options.epochs,
                how.batch,
                scheduled=view_of(task).affine if scheduled else 0,
                slope_weight=weight,
            )
            network = fit(train.features, train.labels, made, folder / form, moves=train.moves)
            taken = perf_counter() - begun
            error = learning_error(network, test.features, test.labels)
            shares = proved(task, network, episodes.scenarios[: options.proofs])
            enough = [row["bound"] for row in shares if row["guaranteed"] >= _ENOUGH]
            flights = episodes.counted(lambda d: flown(task, network, episodes.scenarios, d))  # noqa: B023
            rows.append(
                {
                    "form": form,
                    "weights": sum(
                        w.size + b.size
                        for w, b in zip(network.weights, network.biases, strict=True)
                    ),
                    "training_s": taken,
                    "error": {"mean": error.mean, "p99": error.p99, "max": error.maximum},
                    "slope_error_mean": slope_error(network, test),
                    "flights": flights,
                    "largest_bound_proved": max(enough, default=0.0),
                    "by_bound": shares,
                }
            )
            show(rows)
    return rows


def show(rows: Sequence[dict[str, Any]]) -> None:
    """Print rows as a table."""
    table = Table(
        "form", "error mean", "p99", "max", "slope", *(f"{kind} succ/strict" for kind in _KINDS),
        "proved to d̄", "s",
    )  # fmt: skip
    for row in rows:
        error = row.get("error")
        texts = [f"{error[key]:.3f}" for key in error] if error else ["–"] * 3
        texts.append(f"{row['slope_error_mean']:.3f}" if error else "–")
        texts += ["/".join(f"{one:.1f}" for one in row["flights"][kind]) for kind in _KINDS]
        texts += [f"{row['largest_bound_proved']:g}", f"{row['training_s']:.0f}"] if error else []
        table.add_row(row["form"], *texts)
    Console(width=150).print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--task", default="cartpole")
    parser.add_argument("--plans", type=int, default=400)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--proofs", type=int, default=20)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = study(options)
    if options.json is not None:
        said = {key: value for key, value in vars(options).items() if key != "json"}
        write_atomic(options.json, json.dumps({"settings": said, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
