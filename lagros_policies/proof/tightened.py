"""Theorem 3 with the tube that is proved: plan, bound the error along the plan, plan with its room.

The tube depends on the plan and the room of a plan on the tube, so the two take turns until a plan
keeps the room of its own tube. What counts as kept is what the environment judges: discs and falls,
and bounds of the control (`guarantee`); bounds of the state are wishes of the planner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_whole
from lagros_envs.task import Scenario, Task
from lagros_policies.expert import Expert
from lagros_policies.planning.guess import plan_trajectory
from lagros_policies.planning.planner import problem_of
from lagros_policies.planning.problem import Problem
from lagros_policies.planning.trajectory import Trajectory
from lagros_policies.proof.guarantee import Guarantees, guarantees
from lagros_policies.proof.plan_tube import PlanTubes, plan_tubes

# Directions of the plane in which the tube of a position is bounded, over half a turn.
_DIRECTIONS = 8
# More room than the last tube asks for: the next one is a little wider or narrower.
_MORE = 1.02


@dataclass(frozen=True)
class TubePlan:
    """A plan and the tube around it.

    Attributes:
        plan: The last plan.
        tubes: Its tube, of one plan; directions are the coordinates and, of a body among discs,
            several of its plane.
        guarantees: What the tube shows, of one plan.
        room: Room that the plan was asked to keep from discs at its nodes, shape (N + 1,); the
            task's own margin in the first round.
        rounds: Plans that were made.
    """

    plan: Trajectory
    tubes: PlanTubes
    guarantees: Guarantees
    room: FloatArray
    rounds: int

    @property
    def holds(self) -> bool:
        """Whether the plan keeps the room of its own tube, for every disturbance."""
        found = self.guarantees
        return self.plan.solved and bool((found.closed & found.clear & found.within).all())


def planned_with_tube(
    expert: Expert, scenario: Scenario, bound: float, rounds: int = 6
) -> TubePlan:
    """Plan so that the tube around the plan keeps clear of discs and bounds of the control.

    Args:
        expert: Planner and law; its law is a gain along the plan.
        scenario: Start, goal and discs, one each.
        bound: d_bar.
        rounds: Plans that are made at most.

    Returns:
        The first plan that holds, or the last one that was found.

    Raises:
        ValueError: The law is no gain, or the start or the goal lies in a disc.
    """
    check_whole("rounds", rounds, 1)
    task = expert.task
    problem = problem_of(task, scenario)
    plan = expert.planner.plan(scenario.initial_state, scenario.goal, discs=scenario.discs)
    room = np.broadcast_to(0.0 if problem.discs is None else problem.discs.margin, len(plan.states))
    found = _bounded(expert, scenario, plan, bound, room, 1)
    controls = np.zeros(plan.controls.shape)
    kept = np.zeros(len(plan.states))
    while not found.holds and found.rounds < rounds and found.tubes.closed[0]:
        kept = np.maximum(kept, _MORE * _radii(task, found.tubes))
        controls = np.maximum(controls, _MORE * found.tubes.deviation[0])
        try:
            asked = _with_room(problem, kept, controls)
        except ValueError:
            break  # nothing is left between the bounds, or an end has not that much room
        plan = plan_trajectory(asked)
        if not plan.solved:
            break
        found = _bounded(expert, scenario, plan, bound, kept, found.rounds + 1)
    return found


def _bounded(
    expert: Expert,
    scenario: Scenario,
    plan: Trajectory,
    bound: float,
    room: FloatArray,
    rounds: int,
) -> TubePlan:
    task = expert.task
    states, controls = plan.states[None], plan.controls[None]
    gains = expert.track(states, controls).feedback
    if gains is None:
        raise ValueError(f"the law {expert.law_name!r} is no gain along the plan: take another")
    tubes = plan_tubes(
        task.system,
        task.control_period,
        states,
        controls,
        gains,
        bound,
        directions=_directions(task),
        control_low=np.array(task.control_low),
        control_high=np.array(task.control_high),
        control_centre=np.array(task.control_centre),
    )
    discs = task.all_discs(scenario.discs)[None]
    shown = guarantees(task, scenario.goal[None], discs, states, controls, tubes)
    return TubePlan(plan, tubes, shown, room, rounds)


def _directions(task: Task) -> FloatArray:
    """Return the coordinates and directions of the plane of the position, shape (q, n)."""
    found = np.eye(task.system.state_dim)
    if not (task.position and task.most_discs):
        return found
    turns = math.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    rays = np.zeros((_DIRECTIONS, len(found)))
    rays[:, list(task.position)] = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    return np.concatenate([found, rays])


def _radii(task: Task, tubes: PlanTubes) -> FloatArray:
    """Bound how far the position is from the plan around each node, shape (N + 1,).

    A vector is longest along some direction, and one of those asked for is within half a gap of it.
    """
    rays = tubes.outputs[0, :, task.system.state_dim :]
    if not rays.shape[1]:
        return np.zeros(len(rays))
    radii = rays.max(axis=1) / math.cos(0.5 * math.pi / _DIRECTIONS)
    # The way to a node and from it needs the room of both of its ends.
    around = np.pad(radii, 1, mode="edge")
    widest: FloatArray = np.maximum(np.maximum(around[:-2], around[1:-1]), around[2:])
    return widest


def _with_room(problem: Problem, room: FloatArray, controls: FloatArray) -> Problem:
    """Return a problem whose plan keeps room from discs, in place of a margin, and from bounds."""
    finite = np.isfinite(problem.control_low) | np.isfinite(problem.control_high)
    asked = problem.tightened(controls=np.where(finite, controls, 0.0))
    if problem.discs is None:
        return asked
    return replace(asked, discs=replace(problem.discs, margin=room))
