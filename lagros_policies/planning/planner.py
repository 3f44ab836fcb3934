"""Target trajectories of a task of one body: its `Problem`, and the planner that solves it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import shown
from lagros_envs.task import Numbers, Scenario, Task
from lagros_policies.planning.guess import PlannerSettings, plan_trajectory
from lagros_policies.planning.problem import DISTANCE_SLACK, Discs, Problem
from lagros_policies.planning.scp import solve_scp
from lagros_policies.planning.trajectory import Trajectory
from lagros_policies.room import part_of


class Planner(Protocol):
    """What plans the target trajectories of a task.

    Attributes:
        settings: How it plans, a frozen dataclass.
    """

    settings: Any

    def plan(
        self,
        initial_state: FloatArray,
        goal: FloatArray,
        start_step: int = 0,
        guess: Trajectory | None = None,
        discs: FloatArray | None = None,
    ) -> Trajectory:
        """Plan from a state at a control instant to the goal at the time limit.

        Args:
            initial_state: x at the instant, shape (n,).
            goal: x_f, shape (n,).
            start_step: Index k of the instant; the plan covers the steps that remain.
            guess: A plan whose last part is the warm start.
            discs: Centre and radius of each disc, shape (k, 3); none if left out.

        Returns:
            The plan, over `task.steps - start_step` steps.

        Raises:
            ValueError: No step remains, the guess is shorter than what remains, a state is
                misshapen or not finite, or one lies in a disc.
        """


def planner_of(task: Task) -> Planner:
    """Return the planner of a task: its own, or the general one."""
    found: Planner = part_of(task, "PLANNER", "lagros_policies.planning.planner:TaskPlanner")(task)
    return found


def problem_of(
    task: Task, scenario: Scenario, first_step: int = 0, start: FloatArray | None = None
) -> Problem:
    """Return what a task asks of a planner.

    Bounds, scales, discs and the reference control are those of the task. Where the start or the
    goal is nearer to a disc than the task's margin, the margin grows from what is there.

    Args:
        task: The task.
        scenario: Start, goal and discs.
        first_step: Control step at which the plan begins; it ends at the time limit.
        start: x at that step, shape (n,); that of the scenario if left out.

    Raises:
        ValueError: No step remains, or a state is misshapen, not finite or in a disc.
    """
    start = np.asarray(scenario.initial_state if start is None else start, np.float64)
    goal = np.asarray(scenario.goal, np.float64)
    n, m = task.system.state_dim, task.system.control_dim
    check_states(n, initial_state=start, goal=goal)
    return Problem(
        task.system,
        task.control_period,
        steps_left(task, first_step),
        start,
        goal,
        state_low=_filled(task.state_low, n, -np.inf),
        state_high=_filled(task.state_high, n, np.inf),
        control_low=_filled(task.control_low, m, -np.inf),
        control_high=_filled(task.control_high, m, np.inf),
        reference_control=_filled(task.control_centre, m, 0.0),
        state_scale=_filled(task.state_scale, n, 1.0),
        control_scale=_filled(task.control_spread, m, 1.0),
        discs=_discs(task, scenario.discs, start, goal, steps_left(task, first_step)),
        keep=task.keep,
    )


def check_states(n: int, **states: FloatArray) -> None:
    """Check vectors of n finite numbers each.

    Raises:
        ValueError: One is not.
    """
    for name, vector in states.items():
        if np.shape(vector) != (n,) or not np.all(np.isfinite(vector)):
            raise ValueError(f"{name}={shown(vector)} must be {n} finite numbers")


def steps_left(task: Task, start_step: int, guess: Trajectory | None = None) -> int:
    """Return the number of steps of a plan that begins at a step.

    Raises:
        ValueError: There are none, or the guess has fewer.
    """
    left = task.steps - start_step
    if not 1 <= left <= task.steps:
        raise ValueError(
            f"start_step={start_step} is not one of the {task.steps} steps before the time limit"
        )
    if guess is not None and guess.horizon < left:
        raise ValueError(
            f"guess covers {guess.horizon} steps, but {left} remain from start_step={start_step}"
        )
    return left


class TaskPlanner:
    """Plans (x_d, u_d) of least effort that ends at the goal at the time limit."""

    def __init__(self, task: Task, settings: PlannerSettings | None = None) -> None:
        self.task, self.settings = task, settings or PlannerSettings()

    def plan(
        self,
        initial_state: FloatArray,
        goal: FloatArray,
        start_step: int = 0,
        guess: Trajectory | None = None,
        discs: FloatArray | None = None,
    ) -> Trajectory:
        """Plan, from the guess alone where it leads to a plan; see `Planner.plan`."""
        left = steps_left(self.task, start_step, guess)
        around = np.zeros((0, 3)) if discs is None else discs
        problem = problem_of(self.task, Scenario(initial_state, goal, around), start_step)
        if guess is not None:
            warm = guess.states[-(left + 1) :], guess.controls[-left:]
            plan = solve_scp(problem, warm, self.settings.scp)
            if plan.solved:
                return plan
        return plan_trajectory(problem, self.settings)


def _filled(given: Numbers, count: int, none: float) -> FloatArray:
    return np.array(given if given else (none,) * count)


def _discs(
    task: Task, discs: FloatArray, start: FloatArray, goal: FloatArray, steps: int
) -> Discs | None:
    # Rows of zeros stand for discs that are missing.
    discs = discs[discs[:, 2] > 0.0]
    if not len(discs) or not task.position:
        return None
    first, second = task.position
    ends = np.stack([start, goal])[:, None, [first, second]]
    room = np.linalg.norm(ends - discs[:, :2], axis=-1) - discs[:, 2] - task.body_radius
    margin = np.array(task.margin)
    least = np.maximum(np.min(room, axis=1) - DISTANCE_SLACK, 0.0)
    if np.any(least < margin):
        # From what there is at an end to the whole margin within a second, from rest.
        grown = task.margin * (task.control_period * np.arange(steps + 1)) ** 2
        margin = np.minimum(margin, np.minimum(least[0] + grown, least[1] + grown[::-1]))
    return Discs(discs[:, :2], discs[:, 2], task.body_radius, margin, (first, second))
