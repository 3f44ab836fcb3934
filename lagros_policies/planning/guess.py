"""Plans of one body from first guesses of its own.

A guess need not obey anything. It chooses the side on which the body passes each disc, which the
quadratic programs that follow cannot change, and lets the position move along a shortest way; the
other coordinates go straight from their beginning to their end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields, check_whole
from lagros_envs.dynamics import vector_field
from lagros_policies.planning.grid_path import GridSettings, shortest_paths, walk
from lagros_policies.planning.problem import Problem
from lagros_policies.planning.scp import ScpSettings, solve_scp
from lagros_policies.planning.trajectory import Trajectory

Guess = tuple[FloatArray, FloatArray]

# The grid's cell and border as shares of the least and the largest distance to keep.
_CELL, _BORDER = 0.25, 1.5
_AS_IS, _MIRROR = np.ones(2), np.array([1.0, -1.0])


def _general() -> ScpSettings:
    return ScpSettings(
        max_iterations=100, effort_tolerance=1e-3, trust_weight=1e-2, keep_weight=True
    )


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """How to plan from nothing.

    Attributes:
        attempts: Guesses that are tried at most, the likeliest first.
        scp: How to iterate from each. The default stops where a pass lowers the merit by less than
            a thousandth.

    Raises:
        ValueError: A value is out of range.
    """

    attempts: int = 4
    scp: ScpSettings = field(default_factory=_general)

    def __post_init__(self) -> None:
        check_fields(self)
        check_whole("attempts", self.attempts, 1)


def plan_trajectory(problem: Problem, settings: PlannerSettings | None = None) -> Trajectory:
    """Plan from one guess after the other until a plan holds.

    Returns:
        The first plan that holds or, where none does, the one that comes closest; its `iterations`
        are those of all attempts.
    """
    settings = settings or PlannerSettings()
    closest: Trajectory | None = None
    iterations = 0
    for _, guess in zip(range(settings.attempts), guesses(problem), strict=False):
        plan = solve_scp(problem, guess, settings.scp)
        iterations += plan.iterations
        if closest is None or plan.solved or _violation(plan) < _violation(closest):
            closest = plan
        if plan.solved:
            break
    assert closest is not None  # there is always a straight line
    return replace(closest, iterations=iterations)


def guesses(problem: Problem) -> Iterator[Guess]:
    """Yield states (N + 1, n) and controls (N, m) to start from, the likeliest first.

    The shortest way around the discs, with the side left that was preferred where both are as good;
    the same with more room and at an even pace; and the straight line, which comes first where
    there is no disc, or no place to end at.
    """
    given = problem.given_end
    end = np.where(given, problem.terminal_state, problem.initial_state)
    states = np.linspace(problem.initial_state, end, problem.steps + 1)
    controls = np.tile(problem.reference_control, (problem.steps, 1))
    discs = problem.discs
    if discs is not None and len(discs.centres) and np.all(given[list(discs.position)]):
        axes = list(discs.position)
        keep = np.max(discs.required(problem.steps), axis=0)
        for flip, room, even in ((_AS_IS, 1.0, False), (_MIRROR, 1.0, False), (_AS_IS, 1.2, True)):
            path = flip * _way(flip * states[[0, -1]][:, axes], flip * discs.centres, room * keep)
            share = np.linspace(0.0, 1.0, problem.steps + 1)
            moved = states.copy()
            moved[:, axes] = walk(path, share if even else _pace(problem, path, share))
            yield moved, controls
    yield states, controls


def _way(ends: FloatArray, centres: FloatArray, keep: FloatArray) -> FloatArray:
    """Return the shortest polyline (points, 2) between two ends (2, 2) around the discs."""
    cell = _CELL * max(float(np.min(keep)), 0.1 * float(np.max(keep)))
    grid = GridSettings(cell=cell, border=_BORDER * float(np.max(keep)))
    return shortest_paths(ends[:1], ends[1:], centres, keep, grid)[0]


def _pace(problem: Problem, path: FloatArray, share: FloatArray) -> FloatArray:
    """Return the shares of the way at shares of the time, from the speeds at both ends.

    A cubic between the speeds that the system has along the way under its reference control.
    """
    assert problem.discs is not None
    axes = list(problem.discs.position)
    legs = np.diff(path, axis=0)
    length = max(float(np.sum(np.linalg.norm(legs, axis=1))), 1e-9)
    speeds = []
    for state, leg in ((problem.initial_state, legs[0]), (problem.terminal_state, legs[-1])):
        state = np.where(np.isnan(state), problem.initial_state, state)
        rate = vector_field(problem.system, state, problem.reference_control)[axes]
        along = float(rate @ leg) / max(float(np.linalg.norm(leg)), 1e-9)
        # A cubic with slopes of up to three goes forwards only.
        speeds.append(min(max(along * problem.period * problem.steps / length, 0.0), 3.0))
    first, last = speeds
    value: FloatArray = share * (
        first + share * (3.0 - 2.0 * first - last + share * (first + last - 2.0))
    )
    return value


def _violation(plan: Trajectory) -> float:
    return max(plan.defect, -plan.clearance, plan.excess)
