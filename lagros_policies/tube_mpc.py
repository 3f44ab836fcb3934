"""Policy (b): online tube MPC. Plan, plan again when something calls for it, track with u*."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_above, check_name, check_not_negative, check_whole, shown
from lagros_envs.task import Task
from lagros_policies.contraction import ContractionMetric, load_metric
from lagros_policies.expert import LAWS, WITHIN_METRIC, Expert, PointwiseLaw, TrackedPlans
from lagros_policies.observed import observed_rows
from lagros_policies.planning import Trajectory
from lagros_policies.policy import BasePolicy, PolicyState, row_memories
from lagros_policies.room import task_of
from lagros_policies.trained_for import body_values, check_trained_for, usual

# Controls that differ by less are one plan, in scales of the plan; the solver's own tolerance is
# below it.
_SAME_CONTROL = 1e-2
# A plan may exceed the bounds of the control by so much, in the same.
_BOUND_SLACK = 1e-6


@dataclass
class TubeMpcState:
    """What the planner of one episode remembers.

    Attributes:
        plan: The plan in force; its last step is the time limit. None before the first succeeds.
        tracked: The same, prepared for tracking.
        asked: The goal and the discs that it was made for.
        plans: Plans asked for.
        failed_plans: Plans that did not hold; the last one stayed in force.
        late_plans: Plans that took longer than the deadline; the last one stayed in force.
        newest: Control step of the last call; -1 before the first.
        saturated_steps: Control steps at which u* asked for more than the bounds of the control.
        fallbacks: Control steps at which the law had no answer of its own, where it may have none.
    """

    plan: Trajectory | None = None
    tracked: TrackedPlans | None = None
    asked: FloatArray = field(default_factory=lambda: np.zeros(0))
    plans: int = 0
    failed_plans: int = 0
    late_plans: int = 0
    newest: int = -1
    saturated_steps: int = 0
    fallbacks: int = 0


class TubeMpcPolicy(BasePolicy):
    """Online tube MPC: a plan, and the law of `Expert` around it.

    A plan is made when there is none and when the goal or the discs have moved, over the horizon
    that is left: the rest of a plan of least effort is the plan of least effort from x_d(t), so
    that asking at every step only confirms it. It begins at the *nominal* state x_d(t), not at the
    measured one: the tube of Theorem 1 surrounds one continuous target trajectory, and u* deals
    with the error. If a plan fails or comes late the last one stays in force; before there is any,
    a late plan is used (the system waits) and a failed one means the reference control for this
    step. All of it is counted.

    Attributes:
        keeps_plan: Whether the first plan stays while goal and discs do, so that the flight is that
            of u* around it.

    Args:
        settings: The task; None for the paper's.
        metric: The contraction metric, or its file, in which u* is to contract; if left out, that
            along the plan, or the task's own where the law needs it.
        replan_every: Control steps between plans that nothing calls for; None for none of them.
        deadline: Delta t_max, after which a plan is late [s]; None for the control period.
        clock: Source of the time, for tests [s].
        allow_other_settings: Track with the task's own metric also where the system is another than
            that for which it was designed.
        law: One of `lagros_policies.expert.LAWS`, or a law of the state and the target alone; None
            for the shipped one, or for "tuned" with a metric.

    Raises:
        FileNotFoundError: The task's metric has not been made.
        ValueError: `replan_every` is less than one, the deadline is not positive, or the system is
            another.
    """

    name = "tube-mpc"
    restricted = True  # `policy.make` tells it whether other settings are allowed
    keeps_plan: ClassVar[bool] = True

    def __init__(
        self,
        settings: Task | None = None,
        metric: ContractionMetric | str | Path | None = None,
        replan_every: int | None = None,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
        allow_other_settings: bool = False,
        law: str | PointwiseLaw | None = None,
    ) -> None:
        self.settings = task = task_of(settings)
        if replan_every is not None:
            check_whole("replan_every", replan_every)
        deadline = task.control_period if deadline is None else deadline
        check_above("deadline", deadline, 0)
        if isinstance(law, str):
            check_name("law", law, LAWS)
        elif law is not None and not (callable(law) and hasattr(law, "name")):
            raise ValueError(f"law={shown(law)} must be one of {', '.join(LAWS)}, or a law itself")
        if metric is None:
            if law in WITHIN_METRIC:
                check_own_metric(task, allow_other_settings)
        elif law is not None and law not in WITHIN_METRIC:
            raise ValueError(
                f"metric: the law {law!r} is in none of the task; leave one of both out"
            )
        elif isinstance(metric, str | Path):
            metric = load_metric(metric, task.system.state_dim)
        elif not all(hasattr(metric, name) for name in ("contraction_rate", "condition_bound")):
            raise ValueError(f"metric={shown(metric)} must be a contraction metric, or its file")
        if not callable(clock):
            raise ValueError(f"clock={shown(clock)} must be a function that returns seconds")
        if isinstance(law, str):
            self.name = "lqr-plan" if law == "lqr" else f"{self.name}:{law}"
        elif law is not None:
            self.name = law.name
        elif metric is not None:
            law = "tuned"
        self.expert = Expert(task, metric, law=law)
        self.planner = self.expert.planner
        self.replan_every = replan_every
        self.deadline = deadline
        self._clock = clock
        self._layout = task.layout
        self._unit = np.array(task.control_spread or (1.0,) * task.system.control_dim)
        low, high = np.array(task.control_low), np.array(task.control_high)
        self._slack = low - _BOUND_SLACK * self._unit, high + _BOUND_SLACK * self._unit
        self._bounded = bool(np.any(np.isfinite([low, high])))

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Plan if it is time, and track; see `Policy.predict`. The state is one per row.

        Raises:
            ValueError: The observation is not one of the task, or not finite, or the state is not
                of these rows.
        """
        rows = np.atleast_2d(observed_rows(observation, self._layout.size, np.float64))
        memories: list[TubeMpcState | None] = row_memories(
            state, episode_start, len(rows), "episodes", TubeMpcState
        )
        # Copies: what was returned before stays what it was.
        fresh = [TubeMpcState() if memory is None else copy(memory) for memory in memories]
        control = np.empty((len(rows), len(self._unit)))
        for place, row, memory in zip(control, rows, fresh, strict=True):
            place[:] = self._applied(self._control(row, memory), memory)
        action = self.settings.action(control).astype(np.float32)
        return (action if np.ndim(observation) == 2 else action[0]), fresh

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return how many plans were made, failed and were late, over the episodes of a state.

        Where the control has bounds, `saturated_steps` are the control steps at which u* asked for
        more.
        """
        return {name: sum(getattr(memory, name) for memory in state) for name in self._counted}

    @property
    def _counted(self) -> tuple[str, ...]:
        names = ("plans", "failed_plans", "late_plans")
        return (*names, "saturated_steps") if self._bounded else names

    def _control(self, row: FloatArray, memory: TubeMpcState) -> FloatArray:
        """Return u*, shape (m,), whatever the bounds of the control are."""
        task, layout = self.settings, self._layout
        step = round(float(row[layout.time]) / task.control_period)
        if step < memory.newest:
            raise ValueError(
                f"the time went back from step {memory.newest} to {step}: pass state=None, or "
                "episode_start, when an episode starts"
            )
        memory.newest = step
        # Past the time limit the plan has ended: hold its last nominal state.
        step = min(step, task.steps - 1)
        asked = np.concatenate([row[layout.goal], row[layout.discs]])
        moved = not np.array_equal(asked, memory.asked)
        if memory.plan is None or moved or self._due(step):
            self._renew(row, asked, step, memory)
        if memory.tracked is None:
            return np.array(task.control_centre, np.float64)
        return self._wanted(memory.tracked, step, row[layout.state], memory)

    def _wanted(
        self, tracked: TrackedPlans, step: int, state: FloatArray, memory: TubeMpcState
    ) -> FloatArray:
        """Return the law's u, shape (m,), at a state (n,) that follows one plan."""
        wanted = self.expert.wanted(tracked, np.zeros(1, int), np.full(1, step), state[None])
        control: FloatArray = wanted[0]
        return control

    def _due(self, step: int) -> bool:
        """Whether a plan is to be made at a step for no other reason than the time."""
        return self.replan_every is not None and step % self.replan_every == 0

    def _applied(self, control: FloatArray, memory: TubeMpcState) -> FloatArray:
        """Return what the bounds leave of a control (m,), and count where they take some."""
        if self._bounded:
            low, high = self._slack
            memory.saturated_steps += bool(np.any((control < low) | (control > high)))
        return self.expert.applied(control)

    def _renew(self, row: FloatArray, asked: FloatArray, step: int, memory: TubeMpcState) -> None:
        plan, layout = memory.plan, self._layout
        start = self._start(row, step, plan)
        begun = self._clock()
        renewed = self._planned(start, row[layout.goal], layout.discs_of(row), step, memory)
        late = self._clock() - begun > self.deadline
        memory.plans += 1
        memory.late_plans += late
        memory.failed_plans += not renewed.solved
        if not renewed.solved or (late and plan is not None):
            return
        moved = not np.array_equal(asked, memory.asked)
        if plan is not None and not moved and self._confirms(renewed, plan):
            return
        memory.asked = asked
        memory.plan = renewed
        memory.tracked = self.expert.track(renewed.states[None], renewed.controls[None], step)

    def _planned(
        self, start: FloatArray, goal: FloatArray, discs: FloatArray, step: int, last: TubeMpcState
    ) -> Trajectory:
        """Return a plan from a state to the goal at the time limit."""
        plan: Trajectory = self.planner.plan(start, goal, step, last.plan, discs)
        return plan

    def _start(self, row: FloatArray, step: int, plan: Trajectory | None) -> FloatArray:
        """Return the state from which to plan, shape (n,)."""
        if plan is None:
            start: FloatArray = row[self._layout.state if step else self._layout.initial_state]
            return start
        nominal: FloatArray = plan.states[step - (self.settings.steps - plan.horizon)]
        return nominal

    def _confirms(self, renewed: Trajectory, plan: Trajectory) -> bool:
        """Whether a re-plan is the rest of the plan in force, to the planner's accuracy."""
        change = np.abs(renewed.controls - plan.controls[-renewed.horizon :]) / self._unit
        return bool(np.max(change) <= _SAME_CONTROL)


class ReplanningTubeMpcPolicy(TubeMpcPolicy):
    """Tube MPC that plans anew from the *measured* state, as the horizon shrinks.

    u* tracks the newest plan, whose error begins at zero. Where disturbance has pushed the body,
    the plan goes with it: the error around the plan in force is that of a few steps, but the plans
    wander, and no tube around the first of them is about such a flight. What would be is a bound on
    where the sequence of plans can be driven to; there is none here. Near the time limit a plan
    that has to end at the goal would ask for any control, so that the last one is made `last_plan`
    before it and tracked to the end.

    Args:
        settings: The task; None for the paper's.
        metric: The contraction metric, or its file; the task's own if left out.
        replan_every: Control steps between plans.
        last_plan: Time before the time limit after which no plan is made unless the goal or the
            discs move [s].
        planning: All else that `TubeMpcPolicy` takes.

    Raises:
        FileNotFoundError: The task's metric has not been made.
        ValueError: As of `TubeMpcPolicy`, or `last_plan` is negative.
    """

    name = "tube-mpc:replan"
    keeps_plan = False

    def __init__(
        self,
        settings: Task | None = None,
        metric: ContractionMetric | str | Path | None = None,
        replan_every: int = 1,
        last_plan: float = 1.0,
        **planning: Any,
    ) -> None:
        check_not_negative("last_plan", last_plan)
        super().__init__(settings, metric, replan_every, **planning)
        self.last_plan = last_plan

    def _due(self, step: int) -> bool:
        left = (self.settings.steps - step) * self.settings.control_period
        return super()._due(step) and left >= self.last_plan

    def _start(self, row: FloatArray, step: int, plan: Trajectory | None) -> FloatArray:
        return super()._start(row, step, None)

    def _confirms(self, renewed: Trajectory, plan: Trajectory) -> bool:
        return False


def check_own_metric(task: Task, allow_other_settings: bool) -> None:
    """Check that a task's own metric was designed for its system.

    Raises:
        ValueError: It was designed for another, and no other is allowed.
    """
    made_for = {"equal": body_values(usual(task).system)}
    check_trained_for({}, "the shipped metric", None, task, made_for, allow_other_settings)
