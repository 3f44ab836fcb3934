"""Algorithm 1: random episodes, target trajectories, states in their tubes, labels u*.

Then DAgger: a network flies episodes, and what u* would have done is asked where it came to, around
a plan from there. Both are data of one kind. The work is cut into shards that depend on nothing but
the settings, the network and their index; see `shards`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import (
    check_disturbance_bound,
    check_fields,
    check_not_negative,
    check_seed,
    check_whole,
)
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.task import Scenario, Task
from lagros_policies.backends import LOKY, Backend
from lagros_policies.contraction import Metric
from lagros_policies.contraction.metric_files import region_record
from lagros_policies.expert import Expert
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.rounds import draw_pushes, met_along, met_states, padded_discs
from lagros_policies.learning.shards import Shard, make_shards
from lagros_policies.learning.tubes import around, tube_states
from lagros_policies.planning import PlannerSettings, Trajectory
from lagros_policies.room import task_of

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

# Give up where fewer than one state in so many is inside the verified region.
_PATIENCE = 100
# An episode, the control step at which a plan of it begins, and that plan.
Planned = tuple[Scenario, int, Trajectory]
# A control nearer to that of the linear law is that of the linear law.
_SAME = 1e-6


@dataclass(frozen=True, slots=True)
class ExpertDataSettings:
    """What to generate.

    Attributes:
        plans: Random episodes, each with one target trajectory.
        samples: Labelled states in all.
        shards: Pieces of work.
        disturbance_bound: Largest d_bar of the closed loops that fill the tube.
        spread: Radius of the ball added to every state, in units of d_bar times the control
            period: one more step of disturbance.
        seed: Seed of the run.

    Raises:
        ValueError: A value is out of range, or the shards do not divide plans and samples.
    """

    plans: int = 1000
    samples: int = 50_000
    shards: int = 20
    disturbance_bound: float = 1.0
    spread: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        check_seed(self.seed)
        if self.shards < 1 or self.plans % self.shards or self.samples % self.shards:
            raise ValueError(
                f"shards={self.shards} must divide plans={self.plans} and samples={self.samples}"
            )
        for name in ("plans", "samples"):
            check_whole(name, getattr(self, name))
        check_disturbance_bound("disturbance_bound", self.disturbance_bound)
        check_not_negative("spread", self.spread)


@dataclass(frozen=True)
class ExpertData:
    """Labelled states and the plans they lie around.

    Attributes:
        observation: What the policy sees at the state, shape (s, o).
        control: u*, shape (s, m).
        gain: K where the law is u_d + K (x - x_d), shape (s, m, n); (s, m, 0) where it has none.
        plan: Which plan each sample belongs to, shape (s,).
        plan_states: x_d, shape (p, N + 1, n); before the plan begins, where it begins.
        plan_controls: u_d, shape (p, N, m).
        plan_steps: Control step at which each plan begins, shape (p,).
        plan_starts: x(0) of its episode, shape (p, n).
        plan_discs: Discs of its episode, shape (p, most discs, 3).
        drawn: States drawn in all, with those outside the verified region.
    """

    observation: FloatArray
    control: FloatArray
    gain: FloatArray
    plan: IntArray
    plan_states: FloatArray
    plan_controls: FloatArray
    plan_steps: IntArray
    plan_starts: FloatArray
    plan_discs: FloatArray
    drawn: int

    @property
    def plans(self) -> Shard:
        """All that is said of the plans."""
        return {name: value for name, value in vars(self).items() if name.startswith("plan_")}

    def nominal_pairs(self, task: Task) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return the observations along the plans, u_d there, and which plan: data of (a)."""
        plan, step = np.nonzero(np.arange(task.steps) >= self.plan_steps[:, None])
        seen = observations(task, self.plan_states[plan, step], step, plan, vars(self))
        return seen, self.plan_controls[plan, step], plan

    def moves(self, task: Task, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return directions of the state, shape (s, n), and how u* moves along them, (s, m).

        Directions are random, of the spread of the errors; zero where u* is not the linear law, as
        at the bounds of the control.

        Raises:
            ValueError: The law behind the labels has no linear gain.
        """
        if not self.gain.shape[-1]:
            raise ValueError(f"the law of {task.name} has no linear gain along its plans")
        layout = task.layout
        step = np.rint(self.observation[:, layout.time] / task.control_period).astype(int).ravel()
        error = self.observation[:, layout.state] - self.plan_states[self.plan, step]
        push = np.einsum("smn,sn->sm", self.gain, error)
        linear = self.plan_controls[self.plan, step] + push
        same = np.isclose(self.control, linear, atol=_SAME).all(axis=1)
        way = error.std(axis=0) * rng.standard_normal(error.shape) * same[:, None]
        return way, np.einsum("smn,sn->sm", self.gain, way)


def observations(
    task: Task, states: FloatArray, steps: IntArray, plan: IntArray, plans: dict[str, Any]
) -> FloatArray:
    """Return what the environment shows at states of episodes.

    Args:
        task: The task.
        states: x, shape (s, n).
        steps: Control step of each, shape (s,).
        plan: Which plan each belongs to, shape (s,).
        plans: `plan_states`, `plan_starts` and `plan_discs`, as in `ExpertData`.
    """
    layout = task.layout
    observation = np.empty((len(states), layout.size))
    observation[:, layout.state] = states
    observation[:, layout.goal] = plans["plan_states"][plan, -1]
    observation[:, layout.initial_state] = plans["plan_starts"][plan]
    observation[:, layout.time] = steps * task.control_period
    discs = plans["plan_discs"][plan]
    observation[:, layout.discs] = discs.reshape(len(states), 3 * task.most_discs)
    return observation


def generate(
    folder: Path,
    metric: Metric,
    settings: ExpertDataSettings,
    task: Task | None = None,
    jobs: int = 1,
    on_shard: Callable[[int], None] | None = None,
    backend: Backend = LOKY,
    network: Mlp | None = None,
    along: ExpertData | None = None,
) -> ExpertData:
    """Generate expert data, or finish what an interrupted call began.

    Args:
        folder: Where the shards are kept.
        metric: The contraction metric behind u*.
        settings: What to generate.
        task: The task; the paper's if left out.
        jobs: Processes.
        on_shard: Called with the number of shards that are finished.
        backend: Whose processes they are.
        network: Plan from where it comes to in the episodes, as DAgger does, and not from their
            starts.
        along: Let it fly the episodes of these data instead, and label what it meets around their
            plans.

    Returns:
        All samples, in an order that does not depend on the processes.

    Raises:
        ValueError: The folder holds data of other settings, or a shard is damaged.
    """
    task = task_of(task)
    plans = None if along is None else along.plans
    make = partial(
        make_shard, metric=metric, settings=settings, task=task, network=network, along=plans
    )
    record = record_of(metric, settings, task, network)
    if along is not None:
        record["along"] = len(along.plan_states)
    return _join(make_shards(folder, settings.shards, make, record, jobs, on_shard, backend))


def make_shard(
    index: int,
    metric: Metric,
    settings: ExpertDataSettings,
    task: Task,
    network: Mlp | None = None,
    along: Shard | None = None,
) -> Shard:
    """Generate one shard: plan, fill the tubes, keep the verified region, label."""
    expert = Expert(task, metric)
    rng = np.random.default_rng([settings.seed, index])
    if along is not None:
        # The plans keep their order, so that those held out stay so.
        parts = {name: np.array_split(plans, settings.shards) for name, plans in along.items()}
        return _labelled(
            rng, expert, settings, {name: parts[name][index] for name in parts}, network
        )
    episodes = episodes_of(index, settings, task)
    if network is None:
        held = planned_episodes(expert, episodes)
    else:
        ask_once(expert)
        pushes = draw_pushes(rng, len(episodes), task, settings.disturbance_bound)
        met = met_states(rng, task, network, episodes, pushes)
        plans = [
            (episodes[which], step, _planned(expert, episodes[which], state, step))
            for which, step, state in met
        ]
        held = [(episode, step, plan) for episode, step, plan in plans if plan is not None]
    if not held:
        raise ValueError(f"none of the {len(episodes)} episodes of shard {index} has a plan")
    return _labelled(rng, expert, settings, plan_arrays(task, held))


def _labelled(
    rng: np.random.Generator,
    expert: Expert,
    settings: ExpertDataSettings,
    shard: Shard,
    network: Mlp | None = None,
) -> Shard:
    """Label states around plans: in their tubes, or where a network comes to."""
    task, metric = expert.task, expert.metric
    states, controls, first = (shard[f"plan_{name}"] for name in ("states", "controls", "steps"))
    tracked = expert.track(states, controls)
    wanted = settings.samples // settings.shards
    gains = tracked.feedback
    if gains is None:
        gains = np.zeros((*controls.shape, 0))
    parts: list[tuple[FloatArray, FloatArray, FloatArray, IntArray]] = []
    kept = drawn = 0
    while kept < wanted:
        if drawn > _PATIENCE * wanted:
            raise ValueError(
                f"only {kept} of {drawn} states lie in the verified region {metric.region}: "
                "verify a larger region or lower disturbance_bound"
            )
        if network is None:
            points, plan_of, step = tube_states(rng, expert, tracked, settings, first)
        else:
            met = met_along(rng, task, network, shard, settings.disturbance_bound)
            points, plan_of, step = around(rng, task, met, settings, first)
        choice = rng.permutation(len(points))
        points, plan_of, step = points[choice], plan_of[choice], step[choice]
        nominal, nominal_control = states[plan_of, step], controls[plan_of, step]
        inside = metric.region.contains(points, nominal, nominal_control)
        # Count only the states that were needed: the last batch is cut.
        needed = int(np.searchsorted(np.cumsum(inside), wanted - kept)) + 1
        points, plan_of, step = points[:needed], plan_of[:needed], step[:needed]
        inside, drawn = inside[:needed], drawn + len(points)
        points, plan_of, step = points[inside], plan_of[inside], step[inside]
        label = expert.control(tracked, plan_of, step, points)
        seen = observations(task, points, step, plan_of, shard)
        parts.append((seen, label, gains[plan_of, step], plan_of))
        kept += len(points)
    names = "observation", "control", "gain", "plan"
    joined = (np.concatenate(part) for part in zip(*parts, strict=True))
    return {**dict(zip(names, joined, strict=True)), **shard, "drawn": np.array(drawn)}


def episodes_of(index: int, settings: ExpertDataSettings, task: Task) -> list[Scenario]:
    """Return the random episodes of a shard."""
    count = settings.plans // settings.shards
    seeds = episode_seeds(settings.seed, settings.plans)[index * count : (index + 1) * count]
    return [task.sample(episode_streams(seed).scenario) for seed in seeds]


def ask_once(expert: Expert) -> None:
    """Plan from one guess: where a flight went wrong there is often no way, from any of them."""
    if isinstance(expert.planner.settings, PlannerSettings):
        expert.planner.settings = replace(expert.planner.settings, attempts=1)


def planned_episodes(expert: Expert, episodes: Sequence[Scenario]) -> list[Planned]:
    """Plan episodes from their starts, and return those that have a plan."""
    plans = [(one, 0, _planned(expert, one, one.initial_state, 0)) for one in episodes]
    return [(episode, step, plan) for episode, step, plan in plans if plan is not None]


def _planned(expert: Expert, episode: Scenario, state: FloatArray, step: int) -> Trajectory | None:
    """Return a plan from a state of an episode; None where there is none that holds."""
    plan = expert.planner.plan(state, episode.goal, step, discs=episode.discs)
    # One that does not hold is no target; the share is reported with the data.
    return plan if plan.solved else None


def plan_arrays(task: Task, held: Sequence[Planned]) -> Shard:
    """Return plans as `ExpertData` has them."""
    states = np.stack([_from_first(plan.states, task.steps + 1) for _, _, plan in held])
    controls = [_from_first(plan.controls, task.steps) for _, _, plan in held]
    return {
        "plan_states": states,
        "plan_controls": np.stack(controls),
        "plan_steps": np.array([step for _, step, _ in held]),
        "plan_starts": np.stack([episode.initial_state for episode, _, _ in held]),
        "plan_discs": np.stack([padded_discs(task, episode) for episode, _, _ in held]),
    }


def _from_first(rows: FloatArray, count: int) -> FloatArray:
    """Return so many rows, the first one repeated before the others."""
    return np.concatenate([np.repeat(rows[:1], count - len(rows), axis=0), rows])


def _join(shards: list[Shard]) -> ExpertData:
    offset = 0
    for shard in shards:
        shard["plan"] = shard["plan"] + offset
        offset += len(shard["plan_states"])
    names = [item.name for item in fields(ExpertData) if item.name != "drawn"]
    joined = {name: np.concatenate([shard[name] for shard in shards]) for name in names}
    return ExpertData(**joined, drawn=int(sum(int(shard["drawn"]) for shard in shards)))


def record_of(
    metric: Metric, settings: ExpertDataSettings, task: Task, network: Mlp | None
) -> dict[str, Any]:
    """Return all that the data depend on."""
    expert = Expert(task, metric)
    law = {
        "coefficients": hashlib.sha256(metric.coefficients.tobytes()).hexdigest(),
        "alpha": metric.contraction_rate,
        "region": region_record(metric.region),
        "law": expert.law_name,
        "feedback": asdict(expert.feedback),
    }
    if metric.basis is not None:
        law |= {"basis": list(metric.basis.terms), "point": metric.point}
    record: dict[str, Any] = {"data": asdict(settings), "task": asdict(task), "metric": law}
    if network is not None:
        digest = hashlib.sha256()
        for part in (*network.weights, *network.biases):
            digest.update(part.tobytes())
        record["network"] = digest.hexdigest()
    return record
