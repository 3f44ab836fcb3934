"""Policy (b): online tube MPC. Plan, re-plan while the horizon shrinks, track the plan with u*."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_above, check_whole, shown
from lagros_envs.conventions import settings_of
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction import ContractionMetric, load_metric
from lagros_policies.observed import cartpole_rows
from lagros_policies.planning import Trajectory
from lagros_policies.policy import BasePolicy, PolicyState, row_memories
from lagros_policies.tasks.cartpole.expert import CartPoleExpert, TrackedPlans
from lagros_policies.tasks.cartpole.planner import FORCE_SLACK
from lagros_policies.trained_for import cartpole_design, check_trained_for

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]


# Forces that differ by less are one plan; the solver's own tolerance is below it [N].
_SAME_FORCE = 1e-2


@dataclass
class TubeMpcState:
    """What the planner of one episode remembers.

    Attributes:
        plan: The plan in force; its last step is the time limit. None before the first succeeds.
        tracked: The same, prepared for tracking.
        goal: The goal it was made for.
        plans: Plans asked for.
        failed_plans: Plans that did not hold; the last one stayed in force.
        late_plans: Plans that took longer than the deadline; the last one stayed in force.
        newest: Control step of the last call; -1 before the first.
        saturated_steps: Control steps at which u* asked for more than the force limit.
    """

    plan: Trajectory | None = None
    tracked: TrackedPlans | None = None
    goal: FloatArray = field(default_factory=lambda: np.full(task.STATE_DIM, np.nan))
    plans: int = 0
    failed_plans: int = 0
    late_plans: int = 0
    newest: int = -1
    saturated_steps: int = 0


class TubeMpcPolicy(BasePolicy):
    """Online tube MPC with the CV-STEM control u* around the plan.

    The plan is renewed from the *nominal* state x_d(t), not from the measured one: the tube of
    Theorem 1 surrounds one continuous target trajectory, and u* deals with the error. A re-plan
    follows a goal that moves; without one it confirms the plan. If a plan fails or comes late the
    last one stays in force; before there is any, a late plan is used (the system waits) and a
    failed one means no force for this step. All of it is counted.

    Args:
        settings: The task.
        metric: The contraction metric, or its file; the shipped one if left out.
        replan_every: Control steps between plans.
        deadline: Delta t_max, after which a plan is late [s].
        clock: Source of the time, for tests [s].
        allow_other_settings: Track with the shipped metric also where the cart-pole is another than
            that for which it was designed.

    Raises:
        ValueError: `replan_every` is less than one, the deadline is not positive, or the cart-pole
            is another.
    """

    name = "tube-mpc"
    restricted = True  # `policy.make` tells it whether other settings are allowed

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        metric: ContractionMetric | str | Path | None = None,
        replan_every: int = 1,
        deadline: float = 0.1,
        clock: Callable[[], float] = time.perf_counter,
        allow_other_settings: bool = False,
    ) -> None:
        """Build planner and law."""
        check_whole("replan_every", replan_every)
        check_above("deadline", deadline, 0)
        self.settings = settings_of(task.CartPoleSettings(), settings)
        if metric is None:
            check_shipped_metric(self.settings, allow_other_settings)
        if metric is None or isinstance(metric, str | Path):
            metric = load_metric(metric, task.STATE_DIM)
        if not all(hasattr(metric, name) for name in ("contraction_rate", "condition_bound")):
            raise ValueError(f"metric={shown(metric)} must be a contraction metric, or its file")
        if not callable(clock):
            raise ValueError(f"clock={shown(clock)} must be a function that returns seconds")
        self.expert = CartPoleExpert(metric, self.settings)
        self.replan_every = replan_every
        self.deadline = deadline
        self._clock = clock

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Plan if it is time, and track; see `Policy.predict`. The state is one per row.

        Raises:
            ValueError: The observation is not one of the task, or not finite, or the state is not
                of these rows.
        """
        rows = np.atleast_2d(cartpole_rows(observation, np.float64))
        memories: list[TubeMpcState | None] = row_memories(
            state, episode_start, len(rows), "episodes", TubeMpcState
        )
        # Copies: what was returned before stays what it was.
        fresh = [TubeMpcState() if memory is None else copy(memory) for memory in memories]
        force = np.empty((len(rows), 1))
        for place, row, memory in zip(force, rows, fresh, strict=True):
            place[:] = self._applied(self._force(row, memory), memory)
        action = (force / self.settings.force_scale).astype(np.float32)
        return (action if np.ndim(observation) == 2 else action[0]), fresh

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return how many plans were made, failed and were late, over the episodes of a state.

        Where the task has a force limit, `saturated_steps` are the control steps at which u* asked
        for more.
        """
        names = ["plans", "failed_plans", "late_plans"]
        if self.settings.force_limit is not None:
            names.append("saturated_steps")
        return {name: sum(getattr(memory, name) for memory in state) for name in names}

    def _force(self, row: FloatArray, memory: TubeMpcState) -> FloatArray:
        settings = self.settings
        step = round(float(row[task.TIME]) / settings.control_period)
        if step < memory.newest:
            raise ValueError(
                f"the time went back from step {memory.newest} to {step}: pass state=None, or "
                "episode_start, when an episode starts"
            )
        memory.newest = step
        # Past the time limit the plan has ended: hold its last nominal state.
        step = min(step, settings.steps - 1)
        goal = row[task.GOAL]
        moved = not np.array_equal(goal, memory.goal)
        if memory.plan is None or moved or step % self.replan_every == 0:
            self._renew(row, goal, step, memory)
        if memory.tracked is None:
            return np.zeros(1)
        state = row[None, task.STATE]
        force = self.expert.wanted(memory.tracked, np.zeros(1, int), np.full(1, step), state)
        return force.reshape(1)

    def _applied(self, force: FloatArray, memory: TubeMpcState) -> FloatArray:
        """Return what the limit leaves of a force (1,) [N], and count where it takes some."""
        limit = self.settings.force_limit
        if limit is None:
            return force
        memory.saturated_steps += bool(abs(force[0]) > limit + FORCE_SLACK)
        return np.clip(force, -limit, limit)

    def _renew(self, row: FloatArray, goal: FloatArray, step: int, memory: TubeMpcState) -> None:
        plan = memory.plan
        if plan is None:
            start = row[task.STATE] if step else row[task.INITIAL_STATE]
        else:
            start = plan.states[step - (self.settings.steps - plan.horizon)]
        begun = self._clock()
        renewed = self.expert.planner.plan(start, goal, step, plan)
        late = self._clock() - begun > self.deadline
        memory.plans += 1
        memory.late_plans += late
        memory.failed_plans += not renewed.solved
        if not renewed.solved or (late and plan is not None):
            return
        memory.goal = goal.copy()
        if plan is not None and _confirms(renewed, plan):
            return
        memory.plan = renewed
        memory.tracked = self.expert.track(renewed.states[None], renewed.controls[None], step)


def check_shipped_metric(settings: task.CartPoleSettings, allow_other_settings: bool) -> None:
    """Check that the shipped metric was designed for the task's cart-pole.

    Raises:
        ValueError: It was designed for another, and no other is allowed.
    """
    made_for = cartpole_design(CartPole())
    check_trained_for({}, "the shipped metric", None, settings, made_for, allow_other_settings)


def _confirms(renewed: Trajectory, plan: Trajectory) -> bool:
    """Whether a re-plan is the rest of the plan in force, to the planner's accuracy."""
    change = np.abs(renewed.controls - plan.controls[-renewed.horizon :])
    return bool(np.max(change) <= _SAME_FORCE)
