"""States around plans: closed loops under random disturbance, and what surrounds them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.balls import into_unit_ball
from lagros_envs.dynamics import hold_step
from lagros_envs.task import Task
from lagros_policies.expert import Expert, TrackedPlans
from lagros_policies.learning.rounds import draw_pushes, fallen

if TYPE_CHECKING:
    from lagros_policies.learning.dataset import ExpertDataSettings


def tube_states(
    rng: np.random.Generator,
    expert: Expert,
    tracked: TrackedPlans,
    settings: ExpertDataSettings,
    first: IntArray | None = None,
) -> tuple[FloatArray, IntArray, IntArray]:
    """Fill the tube around each plan: u* in closed loop under random disturbances (Theorem 4).

    Each plan is flown once, to a fall, under a kind and a bound of its own; a ball the size of one
    more step of disturbance surrounds every state that is met.

    Args:
        rng: Random generator.
        expert: The law u*.
        tracked: The plans.
        settings: What to generate.
        first: Step at which each plan begins, shape (p,); all at the first if left out.

    Returns:
        States (s, n), the plan and the step of each.
    """
    states = tracked.states
    plans, steps = tracked.controls.shape[:2]
    every = np.arange(plans)
    first = np.zeros(plans, int) if first is None else first
    task, period = expert.task, expert.task.control_period
    pushes = draw_pushes(rng, plans, task, settings.disturbance_bound)
    state = states[:, 0]
    met = np.full((plans, steps, states.shape[-1]), np.nan)
    down = np.zeros(plans, bool)
    for step in range(steps):
        met[~down, step] = state[~down]
        control = expert.control(tracked, every, np.full(plans, step), state)
        following = hold_step(task.system, state, control, period, pushes[:, step])
        down |= fallen(task, following)
        state = np.where((~down & (first <= step))[:, None], following, state)
    return around(rng, task, met, settings, first)


def around(
    rng: np.random.Generator,
    task: Task,
    met: FloatArray,
    settings: ExpertDataSettings,
    first: IntArray,
) -> tuple[FloatArray, IntArray, IntArray]:
    """Surround the states of flights by a ball the size of one more step of disturbance.

    Args:
        rng: Random generator.
        task: The task.
        met: States at each control step, shape (p, N, n); not finite where there is none.
        settings: What to generate.
        first: Step at which each flight begins, shape (p,).

    Returns:
        States (s, n), the plan and the step of each.
    """
    plans, steps = met.shape[:2]
    spread = settings.spread * settings.disturbance_bound * task.control_period
    noise = into_unit_ball(rng.standard_normal(met.shape)) * rng.random((plans, steps, 1))
    # The start is known exactly; the tube has radius zero there.
    noise[np.arange(plans), first] = 0.0
    moved = met + spread * noise
    under_way = np.arange(steps) >= first[:, None]
    finite = np.all(np.isfinite(moved), axis=-1) & under_way
    plan_of, step_of = np.nonzero(finite)
    return moved[finite], plan_of, step_of
