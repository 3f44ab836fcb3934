"""Model predictive control without a metric: plan from the measured state at every step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import shown
from lagros_envs.task import Task
from lagros_policies.planning import PlannerSettings, Trajectory
from lagros_policies.planning.planner import Planner, planner_of
from lagros_policies.tube_mpc import ReplanningTubeMpcPolicy, TubeMpcState

# A plan that is made again a step later is asked for no more than its first control needs:
# violations in scales, the share of the merit and the step at which it ends.
_ROUGH = {"defect_tolerance": 1e-3, "effort_tolerance": 1e-2, "step_tolerance": 0.1}


class MpcPolicy(ReplanningTubeMpcPolicy):
    """Plans from the measured state at every step and applies the first control of the plan.

    The horizon ends at the time limit, where the plan is to be at the goal; it shrinks. The first
    plan is made as that of (b) is; the next ones begin from what is left of the last one and are
    iterated roughly, most of them once. Where a plan fails or is late the last one stays in force
    and a regulator of no metric (`lqr-plan`) follows it, which is counted as `failed_plans` and
    `late_plans`; so does it within `last_plan` of the time limit, where a plan that has to end at
    the goal would ask for any control.

    Args:
        settings: The task; None for the paper's.
        last_plan: Time before the time limit after which no plan is made unless the goal or the
            discs move [s].
        planning: `replan_every`, `deadline` and `clock` of `TubeMpcPolicy`.

    Raises:
        ValueError: As of `TubeMpcPolicy`, or `last_plan` is negative.
    """

    restricted = False  # nothing of it was made before

    def __init__(
        self, settings: Task | None = None, last_plan: float = 1.0, **planning: Any
    ) -> None:
        if "law" in planning:
            raise ValueError(
                f"law={shown(planning['law'])}: mpc has the law of a plan; leave it out"
            )
        super().__init__(settings, last_plan=last_plan, law="lqr", **planning)
        self.name = "mpc"
        self._rough = rough(self.settings)

    def _planned(
        self, start: FloatArray, goal: FloatArray, discs: FloatArray, step: int, last: TubeMpcState
    ) -> Trajectory:
        same = last.plan is not None and np.array_equal(last.asked[: len(goal)], goal)
        if same and np.array_equal(last.asked[len(goal) :], discs.ravel()):
            return self._rough.plan(start, goal, step, last.plan, discs)
        return super()._planned(start, goal, discs, step, last)


def rough(task: Task) -> Planner:
    """Return the planner of a task, iterated as little as a plan needs that is soon made again.

    A planner whose settings have no `scp` stays as it is.
    """
    planner = planner_of(task)
    scp = getattr(planner.settings, "scp", None)
    if scp is not None:
        changes: dict[str, Any] = {"scp": replace(scp, **_ROUGH)}
        if isinstance(planner.settings, PlannerSettings):
            changes["attempts"] = 1  # the other guesses go another way than the last plan
        planner.settings = replace(planner.settings, **changes)
    return planner
