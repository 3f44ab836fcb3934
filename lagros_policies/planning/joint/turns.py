"""Joint plans of many agents: all at once until nobody is too near, then one after the other.

The programs of `solve_joint` grow faster than the number of agents, and most of their passes only
save effort. For that it is enough that every agent in turn plans anew around the motions of the
others as they then are. Its program is that of one agent among discs that move; who would come too
near keeps its motion, so that the distances stay kept.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.planning.joint.problem import (
    JointProblem,
    JointScpSettings,
    largest_violation,
)
from lagros_policies.planning.joint.program import ProgramLayout
from lagros_policies.planning.joint.scp import JointSolution, positions_between, solve_joint
from lagros_policies.planning.qp import solve_qp

# Up to so many agents are planned all at once to the end; of more there are so many passes over all
# margins and guesses.
ALL_AT_ONCE, MOST_PASSES = 32, 14
# Sweeps over all agents, at most.
_SWEEPS = 10
# Until the distances are kept: whatever the effort falls by; half-planes as far as this beyond the
# required distance [m] (with 0.5 passes go astray, with 1 they take twice the time); and residuals
# of the programs.
_ANY_EFFORT, _ROUGH_REACH, _ROUGH_TOLERANCE = 1e9, 0.7, 1e-4


def solve_many(
    problem: JointProblem, guess: FloatArray, settings: JointScpSettings
) -> JointSolution:
    """Iterate as `solve_joint` until the distances are kept, and then by turns.

    Args:
        problem: What to plan.
        guess: Positions at the control instants, shape (n, K + 1, 2) [m].
        settings: How to iterate.

    Returns:
        The plan; its `iterations` count a sweep over all agents as one.
    """
    rough = replace(
        settings,
        effort_tolerance=_ANY_EFFORT,
        reach=min(settings.reach, _ROUGH_REACH),
        qp_tolerance=max(settings.qp_tolerance, _ROUGH_TOLERANCE),
    )
    found = solve_joint(problem, guess, rough)
    if not found.solved:
        return found
    states, forces = found.states.copy(), found.forces.copy()
    places = _places(problem, states, forces)
    effort, sweep = float(np.sum(forces**2)), 0
    while sweep < _SWEEPS:
        for agent in range(len(states)):
            one = [agent]
            states[one], forces[one], places[one] = _turn(
                _alone(problem, places, agent), states[one], forces[one], places[one], settings
            )
        sweep += 1
        before, effort = effort, float(np.sum(forces**2))
        if before - effort <= settings.effort_tolerance * effort:
            break
    violation = largest_violation(problem, places)
    status = f"solved, improved by turns in {sweep} sweeps"
    return JointSolution(states, forces, True, status, violation, found.iterations + sweep)


def _turn(
    problem: JointProblem,
    states: FloatArray,
    forces: FloatArray,
    places: FloatArray,
    settings: JointScpSettings,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a motion of one agent from one program around its last, or the last one."""
    layout = ProgramLayout(problem)
    answer = solve_qp(layout.program(problem, places, settings), settings.qp_tolerance)
    if answer.solved:
        news = tuple(
            answer.values[part].transpose(1, 0, 2) for part in (layout.states, layout.forces)
        )
        moved = _places(problem, *news)
        if largest_violation(problem, moved) <= settings.distance_tolerance:
            return *news, moved
    return states, forces, places


def _places(problem: JointProblem, states: FloatArray, forces: FloatArray) -> FloatArray:
    """Return the positions at the control instants, shape (n, K + 1, 2)."""
    return positions_between(states, forces, problem.mass, problem.node_period, problem.substeps)[0]


def _alone(problem: JointProblem, places: FloatArray, agent: int) -> JointProblem:
    """Return the problem of one agent, to whom the others are discs that move."""
    first, second = problem.pairs
    paired = np.flatnonzero((first == agent) | (second == agent))
    others = first[paired] + second[paired] - agent
    instants = places.shape[1]
    standing = np.broadcast_to(problem.obstacles, (instants, *problem.obstacles.shape))
    required = [problem.obstacle_required[:, agent], problem.pair_required[:, paired]]
    return replace(
        problem,
        starts=problem.starts[[agent]],
        goals=problem.goals[[agent]],
        obstacles=np.concatenate([standing, places[others].transpose(1, 0, 2)], axis=1),
        obstacle_required=np.concatenate(required, axis=1)[:, None],
        pair_required=np.zeros((instants, 0)),
        speed_limit=problem.speed_limit[[agent]],
        arrivals=None if problem.arrivals is None else problem.arrivals[[agent]],
    )
