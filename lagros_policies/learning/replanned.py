"""The data of (a): u_d, planned from states off the plan.

The paper's (a) sees target trajectories and nothing beside them, so that whatever pushes it off
them brings it where it was never shown what to do. Here it gets what (c) gets: states of flights
under disturbance, within the tube of u* first and then where its own network comes to (DAgger). The
label at each is the control of a plan from there; a plan labels states along it, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray, IntArray
from lagros_envs.task import Scenario, Task
from lagros_policies.backends import LOKY, Backend
from lagros_policies.contraction import Metric
from lagros_policies.expert import Expert
from lagros_policies.learning.dataset import (
    ExpertDataSettings,
    Planned,
    ask_once,
    episodes_of,
    observations,
    plan_arrays,
    planned_episodes,
    record_of,
)
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.rounds import LATEST, draw_pushes, fallen, flown, trouble
from lagros_policies.learning.shards import Shard, make_shards
from lagros_policies.learning.tubes import tube_states
from lagros_policies.planning import Trajectory
from lagros_policies.planning.planner import Planner
from lagros_policies.room import task_of

# Labels of one plan: at the state from which it is made, and at others further on.
_EACH = 10
# Give up where fewer than one plan in so many holds.
_PATIENCE = 20

# Episode, control step and state from which to plan, and a plan as a guess.
_Asked = tuple[int, int, FloatArray, Trajectory | None]


@dataclass(frozen=True)
class ReplannedData:
    """Labelled states.

    Attributes:
        observation: What the policy sees at the state, shape (s, o).
        control: u_d there, shape (s, m).
        plan: Which episode each sample belongs to, shape (s,).
        asked: Plans asked for.
        failed: Those of them that did not hold.
    """

    observation: FloatArray
    control: FloatArray
    plan: IntArray
    asked: int
    failed: int


def generate_replanned(
    folder: Path,
    metric: Metric,
    settings: ExpertDataSettings,
    task: Task | None = None,
    jobs: int = 1,
    on_shard: Callable[[int], None] | None = None,
    backend: Backend = LOKY,
    network: Mlp | None = None,
) -> ReplannedData:
    """Generate data of (a), or finish what an interrupted call began.

    Args:
        folder: Where the shards are kept.
        metric: The contraction metric behind u*, whose flights fill the tube.
        settings: What to generate.
        task: The task; the paper's if left out.
        jobs: Processes.
        on_shard: Called with the number of shards that are finished.
        backend: Whose processes they are.
        network: Plan from where it comes to, and not from the tube of u*.

    Returns:
        All samples, in an order that does not depend on the processes.

    Raises:
        ValueError: The folder holds data of other settings, or a shard is damaged.
    """
    task = task_of(task)
    make = partial(replanned_shard, metric=metric, settings=settings, task=task, network=network)
    record = record_of(metric, settings, task, network) | {"labels": "u_d"}
    shards = make_shards(folder, settings.shards, make, record, jobs, on_shard, backend)
    of_shard = settings.plans // settings.shards
    for index, shard in enumerate(shards):
        shard["plan"] = shard["plan"] + index * of_shard
    observation, control, plan = (
        np.concatenate([shard[name] for shard in shards])
        for name in ("observation", "control", "plan")
    )
    asked, failed = (sum(int(shard[name]) for shard in shards) for name in ("asked", "failed"))
    return ReplannedData(observation, control, plan, asked, failed)


def replanned_shard(
    index: int,
    metric: Metric,
    settings: ExpertDataSettings,
    task: Task,
    network: Mlp | None = None,
) -> Shard:
    """Generate one shard: fly episodes, plan from where they come to, label along the plans.

    Raises:
        ValueError: Hardly any plan holds.
    """
    expert = Expert(task, metric)
    rng = np.random.default_rng([settings.seed, index])
    episodes = episodes_of(index, settings, task)
    if network is None:
        held = [(one, plan) for one, _, plan in planned_episodes(expert, episodes)]
        episodes = [one for one, _ in held]
        met = _tube(rng, expert, settings, held)
    else:
        met = _flights(rng, task, network, settings, episodes)
    ask_once(expert)
    wanted = settings.samples // settings.shards
    asked = failed = kept = 0
    parts: list[tuple[FloatArray, FloatArray, IntArray]] = []
    while kept < wanted:
        if asked > _PATIENCE * (1 + wanted // _EACH):
            raise ValueError(
                f"only {asked - failed} of {asked} plans from flights of shard {index} hold: lower "
                "disturbance_bound"
            )
        which, step, state, guess = next(met)
        plan = _replanned(expert.planner, episodes[which], step, state, guess)
        asked, failed = asked + 1, failed + (plan is None)
        if plan is not None:
            part = _labels(rng, task, which, (episodes[which], step, plan), wanted - kept)
            parts.append(part)
            kept += len(part[0])
    observation, control, of = (np.concatenate(part) for part in zip(*parts, strict=True))
    counted = {"asked": np.array(asked), "failed": np.array(failed)}
    return {"observation": observation, "control": control, "plan": of, **counted}


def _tube(
    rng: np.random.Generator,
    expert: Expert,
    settings: ExpertDataSettings,
    held: list[tuple[Scenario, Trajectory]],
) -> Iterator[_Asked]:
    """Yield states in the tubes of u* around plans, in random order, without end."""
    task = expert.task
    if not held:
        raise ValueError("no episode of a shard has a plan: generate more in each")
    arrays = plan_arrays(task, [(episode, 0, plan) for episode, plan in held])
    tracked = expert.track(arrays["plan_states"], arrays["plan_controls"])
    while True:
        points, plan_of, step = tube_states(rng, expert, tracked, settings)
        standing = (step <= LATEST * task.steps) & ~fallen(task, points)
        for one in rng.permutation(len(points)):
            if standing[one]:
                which = int(plan_of[one])
                yield which, int(step[one]), points[one], held[which][1]


def _flights(
    rng: np.random.Generator,
    task: Task,
    network: Mlp,
    settings: ExpertDataSettings,
    episodes: list[Scenario],
) -> Iterator[_Asked]:
    """Yield states of flights of a network, from before they end badly, without end."""
    while True:
        pushes = draw_pushes(rng, len(episodes), task, settings.disturbance_bound)
        states = flown(task, network, episodes, pushes)
        ended = trouble(task, episodes, states)
        well = np.cumsum(ended, axis=1) == 0
        well &= np.arange(task.steps) <= LATEST * task.steps
        which, step = np.nonzero(well)
        if not len(which):
            raise ValueError("every flight of a shard ends badly at once: generate more in each")
        for one in rng.permutation(len(which)):
            yield int(which[one]), int(step[one]), states[which[one], step[one]], None


def _replanned(
    planner: Planner, episode: Scenario, step: int, state: FloatArray, guess: Trajectory | None
) -> Trajectory | None:
    """Return a plan from a state of an episode; None where there is none that holds."""
    try:
        plan = planner.plan(state, episode.goal, step, guess, episode.discs)
    except ValueError:  # the state lies in a disc
        return None
    return plan if plan.solved else None


def _labels(
    rng: np.random.Generator, task: Task, which: int, planned: Planned, most: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return observations, u_d and episode at the first state of a plan and at others of it."""
    _, begin, plan = planned
    later: BoolArray = np.zeros(plan.horizon, bool)
    later[0] = True
    later[rng.integers(0, plan.horizon, _EACH - 1)] = True
    chosen = np.flatnonzero(later)[:most]
    arrays = plan_arrays(task, [planned])
    none = np.zeros(len(chosen), int)
    seen = observations(task, plan.states[chosen], begin + chosen, none, arrays)
    return seen, plan.controls[chosen], np.full(len(chosen), which)
