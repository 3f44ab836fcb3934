"""Which law should track a plan, and with which weights?

Laws and weights are held against each other around the same plans, under the same disturbances:

- every law of `lagros_policies.expert.LAWS`: the gain of the metric along the plan (shipped), the
  same projected onto the contracting set, at half and twice the rate, with its weights in a plain
  regulator (no rate, hence no metric), a plain regulator with those of `lqr`, and within the task's
  CV-STEM metric the least-norm u* and the preference tuned before;
- `joint`: one metric and one gain for all plans, functions of x_d, from the same condition imposed
  jointly over samples (`contraction/sampled.py`), at twice the rate;
- the shipped weights with another control weight R, and with another R at the start of an episode:
  the curve along which the tube is paid for with effort and with exits from the paper's tube.

Columns: success and strict success under every kind of disturbance; effort to success and episodes
that ever left the paper's tube under `uniform`; the largest error per unit of d_bar that aimed
sequences reach in the linearised loop and in flight at 0.4 of the bound, over all plans and for
the median one; how often a projection moves the control; for how many plans a tube is proved.

The weights that the cart-pole ships were found on other episodes by benchmarks/tuning/plan_law.py.

    OMP_NUM_THREADS=1 python benchmarks/studies/plan_law.py [--task cartpole] [--episodes 200]
        [--proved 20] [--only NAME,...] [--period 0.05] [--share 1.5]
        [--json benchmarks/results/plan_law.json] [--figure FILE]

With --only, the other rows of the JSON file stay as they are.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from lagros_benchmarks.run.files import write_json
from lagros_benchmarks.worst_case.aimed import aimed_sequences
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    Flights,
    draw_episodes,
    fly,
    parts_of,
    random_pushes,
    tracking_law,
)
from lagros_benchmarks.worst_case.goals import loop_slopes
from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import functions
from lagros_envs.registry import find_task
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Task
from lagros_policies.contraction.basis import CONSTANT
from lagros_policies.contraction.sampled import SampledDesign, design_sampled
from lagros_policies.expert import LAWS, SHIPPED_LAW, Expert, TrackedPlans
from lagros_policies.proof.plan_tube import plan_tubes

_NAMESPACE = 67
_KINDS = ("uniform", "constant", "gust", "switching")
# Of the task's bound: where the worst is looked for, and where tubes are asked for.
_SEARCHED, _PROVED = 0.4, (2.0 / 15.0, 1.0 / 3.0)
_SMALL = 1e-3  # d_bar at which a flight is as good as linear
_CONTROL_SHARES = (1.0 / 16.0, 0.25, 4.0, 16.0)
_DESIGNED = 20  # plans that `joint` is designed on
_EARLY = (0.0, 2.0, 4.0, 6.0)  # logarithm of R at the start in units of R


class JointExpert(Expert):
    """u_d + K(x_d) e with the gain of one metric for all plans of a task."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        own, metric = self.feedback, self.metric
        drawn = draw_episodes(self, episode_seeds(1, _DESIGNED, _NAMESPACE))
        design = SampledDesign(
            2.0 * own.rate,
            own.state_weights,
            10.0 * min(own.control_weights),
            getattr(metric, "phi", CONSTANT),
        )
        n, m = task.system.state_dim, task.system.control_dim
        self._joint = design_sampled(
            task.system,
            task.control_period,
            drawn.plans[:, :-1].reshape(-1, n),
            drawn.controls.reshape(-1, m),
            design,
        )

    def track(self, states: FloatArray, controls: FloatArray, first_step: int = 0) -> TrackedPlans:
        """Prepare plans; see `Expert.track`."""
        return TrackedPlans(states, controls, first_step, self._joint.gain(states[:, :-1]))


def laws(task: Task) -> dict[str, Callable[[], Expert]]:
    """Return how to build what is compared, by name; the shipped law is the first."""
    own = Expert(task).feedback
    found: dict[str, Callable[[], Expert]] = {}
    for law in (SHIPPED_LAW, *(law for law in LAWS if law != SHIPPED_LAW)):
        found[law] = partial(Expert, task, law=law)
    found["joint"] = partial(JointExpert, task)
    for share in _CONTROL_SHARES:
        control = tuple(share * weight for weight in own.control_weights)
        weights = replace(own, control_weights=control)
        found[f"R x {share:g}"] = partial(Expert, task, weights=weights)
    for early in _EARLY:
        weights = replace(own, early_control=(early,) * task.system.control_dim)
        found[f"R begins e^{early:g}"] = partial(Expert, task, weights=weights)
    return found


def outcomes(episodes: Episodes, flights: Flights) -> dict[str, float]:
    """Return shares of success, as the environments count them, effort, and exits."""
    task = episodes.settings
    times = task.control_period * np.arange(task.steps + 1)
    goals = np.broadcast_to(episodes.goals[:, None], flights.states.shape)
    distance = task.goal_distance(parts_of(flights.states), parts_of(goals), functions)
    whole = flights.alive & ~(flights.lost[:, None] & (np.diff(flights.alive, append=0) != 0))
    inside = (distance <= task.success_radius(times)) & whole
    succeeded = inside.any(axis=1)
    first = np.where(succeeded, inside.argmax(axis=1), task.steps)
    spent = task.control_period * np.sum(
        np.square(flights.controls - np.array(task.control_centre)), axis=-1
    )
    before = np.arange(task.steps) < first[:, None]
    found = {
        "success": float(succeeded.mean()),
        "strict": float(inside[:, -1].mean()),
        "effort": float(np.sum(spent * before, axis=1).mean()),
    }
    radius = task.tube_radius(times)
    if radius is not None:
        error = np.linalg.norm(flights.states - episodes.plans, axis=-1)
        left = np.any(error[:, 1:] > radius[1:], axis=1) | flights.lost
        found["left"] = float(left.mean())
    return found


def worst_errors(expert: Expert, episodes: Episodes) -> dict[str, float]:
    """Return the largest ||e|| per unit of d_bar under aimed sequences, linear and flown."""
    law, every = tracking_law(expert, episodes), np.arange(len(episodes.seeds))
    calm = np.zeros((len(every), *episodes.controls.shape[1:2], episodes.plans.shape[-1]))
    slopes = loop_slopes(episodes, law, every, calm, fly(episodes, law, every, calm))
    aimed = aimed_sequences(*slopes)
    each = np.repeat(every, aimed.shape[1])
    found = {}
    for name, bound in (
        ("linear", _SMALL),
        ("flown", _SEARCHED * episodes.settings.defaults.bound),
    ):
        pushes = bound * aimed.reshape(-1, *aimed.shape[2:])
        flights = fly(episodes, law, each, pushes)
        error = np.linalg.norm(flights.states - episodes.plans[each], axis=-1).max(axis=1)
        error = np.where(flights.fallen, np.inf, error).reshape(aimed.shape[:2]).max(axis=1)
        found[f"{name}_max"] = float(error.max() / bound)
        found[f"{name}_median"] = float(np.median(error) / bound)
    return found


def projection(expert: Expert, episodes: Episodes, flights: Flights) -> dict[str, float]:
    """Return how often the projection moves the control along flights, and how far on average."""
    plain = Expert(expert.task, law="gain", weights=expert.feedback)
    plans = plain.track(episodes.plans, episodes.controls)
    count, steps = flights.controls.shape[:2]
    which, step = np.repeat(np.arange(count), steps), np.tile(np.arange(steps), count)
    states = flights.states[:, :-1].reshape(count * steps, -1)
    wanted = plain.control(plans, which, step, states).reshape(flights.controls.shape)
    moved = np.linalg.norm(flights.controls - wanted, axis=-1)[flights.alive[:, :-1]]
    # Single precision of the action moves it, too.
    unit = float(np.linalg.norm(expert.task.control_scale))
    return {"acts": float(np.mean(moved > 1e-5 * unit)), "moved": float(moved.mean())}


def proved_share(expert: Expert, episodes: Episodes, count: int, bound: float) -> float | None:
    """Return for which share of the first plans a tube of a bound is proved; None of no gain."""
    task = expert.task
    tracked = expert.track(episodes.plans[:count], episodes.controls[:count])
    if tracked.feedback is None or expert.law_name == "projected" or not count:
        return None
    tubes = plan_tubes(
        task.system,
        task.control_period,
        tracked.states,
        tracked.controls,
        tracked.feedback,
        bound,
        control_low=task.control_low,
        control_high=task.control_high,
        control_centre=task.control_centre,
    )
    return float(np.mean(tubes.closed))


def study(task: Task, names: Sequence[str], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Fly what is compared and return a row for each; what cannot be built has none."""
    rows: list[dict[str, Any]] = []
    count, proved = options.episodes, options.proved
    bound, build = options.share * task.defaults.bound, laws(task)
    episodes = draw_episodes(Expert(task), episode_seeds(0, count, _NAMESPACE))
    for name in names:
        try:
            expert = build[name]()
        except (FileNotFoundError, ValueError) as error:
            Console(stderr=True).print(f"{name}: {error}")
            continue
        law, every = tracking_law(expert, episodes), np.arange(len(episodes.seeds))
        row: dict[str, Any] = {"law": name, "task": task.name, "bound": bound}
        row |= {"episodes": len(every), "unplanned": len(episodes.unplanned)}
        for kind in _KINDS:
            flights = fly(episodes, law, every, random_pushes(episodes, kind, bound))
            row[kind] = outcomes(episodes, flights)
            if expert.law_name == "projected":
                row[kind] |= projection(expert, episodes, flights)
        row["worst"] = worst_errors(expert, episodes)
        row["proved"] = {
            f"{share * bound:.3g}": proved_share(expert, episodes, proved, share * bound)
            for share in _PROVED
        }
        rows.append(row)
        Console().print(f"{name}: {row['uniform']}")
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print rows as a table."""
    if not rows:
        return
    table = Table(title=f"{rows[0]['task']}, d̄ = {rows[0]['bound']:g}; success / strict [%]")
    proved = list(rows[0]["proved"])
    for heading in (
        *("law", *_KINDS, "effort", "left %", "‖e‖/d̄ linear", "flown"),
        *(f"proved % at {bound}" for bound in proved),
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        worst = row["worst"]
        table.add_row(
            row["law"],
            *(
                f"{100 * row[kind]['success']:.1f} / {100 * row[kind]['strict']:.1f}"
                for kind in _KINDS
            ),
            f"{row['uniform']['effort']:.3g}",
            f"{100 * row['uniform'].get('left', np.nan):.1f}",
            f"{worst['linear_median']:.2f}, {worst['linear_max']:.2f}",
            f"{worst['flown_median']:.2f}, {worst['flown_max']:.2f}",
            *(
                "-" if row["proved"][bound] is None else f"{100 * row['proved'][bound]:.0f}"
                for bound in proved
            ),
        )
    console = Console(width=190)
    console.print(table)
    for kind, flown in ((kind, row[kind]) for row in rows for kind in _KINDS):
        if "acts" in flown:
            console.print(
                f"{kind}: the projection acts in {100.0 * flown['acts']:.3f} % of the steps and "
                f"moves the control by {flown['moved']:.2g} on average"
            )


def draw(rows: list[dict[str, Any]], path: Path, unit: str) -> None:
    """Draw effort, in a unit or "", and exits over the worst error of each row."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.6), constrained_layout=True)
    columns = (
        ("effort", 1.0, f"effort [{unit}s]" if unit else "effort"),
        ("left", 100.0, "left the paper's tube [%]"),
    )
    for axis, (column, factor, label) in zip(axes, columns, strict=True):
        for prefix in ("R x", "R begins"):
            line = [row for row in rows if row["law"].startswith(prefix)]
            line.append(rows[0])
            line.sort(key=lambda row: row["worst"]["flown_median"])
            points = [(r["worst"]["flown_median"], factor * r["uniform"][column]) for r in line]
            axis.plot(*zip(*points, strict=True), marker=".", label=f"{prefix} ...")
        marks = iter("os^vDPX*")
        for row in rows:
            # The projection that never acts lies on the gain.
            if not row["law"].startswith("R ") and row["law"] != "projected":
                place = row["worst"]["flown_median"], factor * row["uniform"][column]
                axis.plot(
                    *place, marker=next(marks), linestyle="none", color="black", label=row["law"]
                )
        axis.set_xlabel("largest error found per unit of d̄, median plan")
        axis.set_ylabel(label)
        axis.set_xscale("log")
        axis.set_xticks(ticks := (5, 7, 10, 15, 20), [str(tick) for tick in ticks], minor=False)
        axis.set_xticks((), minor=True)
        axis.margins(x=0.12)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--task", default="cartpole")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--proved", type=int, default=20, help="plans whose tubes are asked for")
    parser.add_argument("--period", type=float, help="another control period [s]")
    parser.add_argument("--share", type=float, default=1.0, help="of the bound of the task")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--only", help="names of rows, such as gain,lqr")
    options = parser.parse_args()
    task: Any = find_task(options.task)
    if options.period is not None:
        task = replace(task, control_period=options.period)
    names = list(laws(task))
    found = {}
    if options.only and options.json and options.json.is_file():
        found = {row["law"]: row for row in json.loads(options.json.read_text())}
    asked = options.only.split(",") if options.only else names
    found |= {row["law"]: row for row in study(task, asked, options)}
    rows = [found[name] for name in names if name in found]
    show(rows)
    if options.json:
        write_json(options.json, rows)
    if options.figure:
        draw(rows, options.figure, task.squared_unit)


if __name__ == "__main__":
    main()
