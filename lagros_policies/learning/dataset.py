"""Algorithm 1: random episodes, target trajectories, states in their tubes, labels u*.

The work is cut into shards that depend on nothing but the settings and their index; see `shards`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
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
from lagros_envs.disturbances import OPEN_LOOP, into_unit_ball
from lagros_envs.dynamics import hold_step
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole import task
from lagros_policies.backends import LOKY, Backend
from lagros_policies.contraction import Metric
from lagros_policies.contraction.metric_files import region_record
from lagros_policies.learning.shards import Shard, make_shards
from lagros_policies.tasks.cartpole.expert import CartPoleExpert, TrackedPlans

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

# Give up where fewer than one state in so many is inside the verified region.
_PATIENCE = 100
# Kinds of disturbance whose closed loops fill the tube; `none` would only repeat the plan.
_KINDS = ("uniform", "sphere", "constant", "sinusoid", "gust")


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
        observation: What the policy sees at the state, shape (s, 13).
        control: u*, shape (s, 1) [N].
        plan: Which plan each sample belongs to, shape (s,).
        plan_states: x_d, shape (p, N + 1, 4).
        plan_controls: u_d, shape (p, N, 1) [N].
        drawn: States drawn in all, with those outside the verified region.
    """

    observation: FloatArray
    control: FloatArray
    plan: IntArray
    plan_states: FloatArray
    plan_controls: FloatArray
    drawn: int

    def nominal_pairs(self, settings: task.CartPoleSettings) -> tuple[FloatArray, FloatArray]:
        """Return the observations along the plans, (p N, 13), and u_d, (p N, 1): data of (a)."""
        steps = np.tile(np.arange(settings.steps), len(self.plan_states))
        plan = np.repeat(np.arange(len(self.plan_states)), settings.steps)
        states = self.plan_states[plan, steps]
        observation = observations(states, self.plan_states[plan], steps, settings)
        return observation, self.plan_controls[plan, steps]


def observations(
    states: FloatArray, plans: FloatArray, steps: IntArray, settings: task.CartPoleSettings
) -> FloatArray:
    """Return what the environment shows at states (s, 4) of episodes with plans (s, N + 1, 4)."""
    observation = np.empty((len(states), task.OBSERVATION_DIM))
    observation[:, task.STATE] = states
    observation[:, task.GOAL] = plans[:, -1]
    observation[:, task.INITIAL_STATE] = plans[:, 0]
    observation[:, task.TIME] = steps * settings.control_period
    return observation


def generate(
    folder: Path,
    metric: Metric,
    settings: ExpertDataSettings,
    task_settings: task.CartPoleSettings | None = None,
    jobs: int = 1,
    on_shard: Callable[[int], None] | None = None,
    backend: Backend = LOKY,
) -> ExpertData:
    """Generate expert data, or finish what an interrupted call began.

    Args:
        folder: Where the shards are kept.
        metric: The contraction metric behind u*.
        settings: What to generate.
        task_settings: The task.
        jobs: Processes.
        on_shard: Called with the number of shards that are finished.
        backend: Whose processes they are.

    Returns:
        All samples, in an order that does not depend on the processes.

    Raises:
        ValueError: The folder holds data of other settings, or a shard is damaged.
    """
    task_settings = task_settings or task.CartPoleSettings()
    make = partial(make_shard, metric=metric, settings=settings, task_settings=task_settings)
    record = _record(metric, settings, task_settings)
    return _join(make_shards(folder, settings.shards, make, record, jobs, on_shard, backend))


def make_shard(
    index: int, metric: Metric, settings: ExpertDataSettings, task_settings: task.CartPoleSettings
) -> Shard:
    """Generate one shard: plan, fill the tubes, keep the verified region, label."""
    expert = CartPoleExpert(metric, task_settings)
    count = settings.plans // settings.shards
    seeds = episode_seeds(settings.seed, settings.plans)[index * count : (index + 1) * count]
    plans = []
    for seed in seeds:
        scenario = task.sample_scenario(episode_streams(seed).scenario, task_settings)
        plan = expert.planner.plan(scenario.initial_state, scenario.goal)
        # A plan that does not hold is no target; the share is reported with the data.
        if plan.solved:
            plans.append(plan)
    if not plans:
        raise ValueError(f"none of the {count} episodes of shard {index} has a plan")
    states = np.stack([plan.states for plan in plans])
    controls = np.stack([plan.controls for plan in plans])
    tracked = expert.track(states, controls)
    rng = np.random.default_rng([settings.seed, index])
    wanted = settings.samples // settings.shards
    parts: list[tuple[FloatArray, FloatArray, IntArray]] = []
    kept = drawn = 0
    while kept < wanted:
        if drawn > _PATIENCE * wanted:
            raise ValueError(
                f"only {kept} of {drawn} states lie in the verified region {metric.region}: "
                "verify a larger region or lower disturbance_bound"
            )
        points, plan_of, step = tube_states(rng, expert, tracked, settings)
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
        parts.append((observations(points, states[plan_of], step, task_settings), label, plan_of))
        kept += len(points)
    observation, control, plan_of = (np.concatenate(part) for part in zip(*parts, strict=True))
    return {
        "observation": observation,
        "control": control,
        "plan": plan_of,
        "plan_states": states,
        "plan_controls": controls,
        "drawn": np.array(drawn),
    }


def tube_states(
    rng: np.random.Generator,
    expert: CartPoleExpert,
    tracked: TrackedPlans,
    settings: ExpertDataSettings,
) -> tuple[FloatArray, IntArray, IntArray]:
    """Fill the tube around each plan: u* in closed loop under random disturbances (Theorem 4).

    Each plan is flown once, under a kind and a bound of its own; a ball the size of one more step
    of disturbance surrounds every state that is met.

    Args:
        rng: Random generator.
        expert: The law u*.
        tracked: The plans.
        settings: What to generate.

    Returns:
        States (p N, 4), the plan and the step of each.
    """
    states = tracked.states
    plans, steps = tracked.controls.shape[:2]
    every = np.arange(plans)
    period = expert.task.control_period
    # Every bound down to zero: the tube of a small disturbance lies inside that of a large one.
    bound: FloatArray = settings.disturbance_bound * rng.random((plans, 1, 1))
    pushes = np.stack(
        [
            OPEN_LOOP[_KINDS[rng.integers(len(_KINDS))]].realise(
                rng, steps, states.shape[-1], period
            )
            for _ in range(plans)
        ]
    )
    pushes *= bound
    state = states[:, 0]
    met = np.empty((plans, steps, states.shape[-1]))
    for step in range(steps):
        met[:, step] = state
        control = expert.control(tracked, every, np.full(plans, step), state)
        state = hold_step(expert.task.system, state, control, period, pushes[:, step])
    spread = settings.spread * settings.disturbance_bound * period
    noise = into_unit_ball(rng.standard_normal(met.shape)) * rng.random((plans, steps, 1))
    # The start is known exactly; the tube has radius zero there.
    noise[:, 0] = 0.0
    met += spread * noise
    finite = np.all(np.isfinite(met), axis=-1)
    plan_of, step_of = np.nonzero(finite)
    return met[finite], plan_of, step_of


def _join(shards: list[Shard]) -> ExpertData:
    offset = 0
    for shard in shards:
        shard["plan"] = shard["plan"] + offset
        offset += len(shard["plan_states"])
    joined = {
        name: np.concatenate([shard[name] for shard in shards])
        for name in ("observation", "control", "plan", "plan_states", "plan_controls")
    }
    return ExpertData(**joined, drawn=int(sum(int(shard["drawn"]) for shard in shards)))


def _record(
    metric: Metric, settings: ExpertDataSettings, task_settings: task.CartPoleSettings
) -> dict[str, Any]:
    """Return all that the data depend on."""
    law = {
        "coefficients": hashlib.sha256(metric.coefficients.tobytes()).hexdigest(),
        "alpha": metric.contraction_rate,
        "region": region_record(metric.region),
        "feedback": asdict(CartPoleExpert(metric, task_settings).feedback),
    }
    if metric.basis is not None:
        law |= {"basis": list(metric.basis.terms), "point": metric.point}
    return {"data": asdict(settings), "task": asdict(task_settings), "metric": law}
