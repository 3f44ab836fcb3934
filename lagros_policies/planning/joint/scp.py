"""Joint sequential convex programming for many planar double integrators among discs.

    min  1/2 sum_i int ||F_i||^2 dt
    s.t. dp_i/dt = v_i, dv_i/dt = F_i / m, F_i held over a node step, given ends, |v_i| <= v_max,
         |F_i| <= F_max per axis where there is a limit,
         ||p_i(t) - o_j|| >= R_ij(t) and ||p_i(t) - p_j(t)|| >= R_ij(t)

The dynamics are linear, so that only the distances are linearised: along the unit vector e from
the obstacle (or the other agent) to the agent in the last plan, ||p - o|| >= e'(p - o). Each
half-plane lies inside the true set. A plan that keeps the half-planes therefore keeps the
distances at the instants where they were imposed, the effort falls from pass to pass, and no trust
region is needed. The half-planes are imposed at the nodes and, where agents come near, at the
control instants between them; those far from the last plan are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.planning.joint.problem import (
    JointProblem,
    JointScpSettings,
    largest_violation,
)
from lagros_policies.planning.joint.program import ProgramLayout
from lagros_policies.planning.qp import solve_qp


@dataclass(frozen=True)
class JointSolution:
    """What the iteration ended with.

    Attributes:
        states: [p, v] at the nodes, shape (n, N + 1, 4).
        forces: F, shape (n, N, 2) [N].
        solved: Whether every distance is kept at every control instant, within the tolerance.
        status: Why the iteration stopped, in words.
        violation: Largest violation of a distance at a control instant [m].
        iterations: Quadratic programs solved.
    """

    states: FloatArray
    forces: FloatArray
    solved: bool
    status: str
    violation: float
    iterations: int


def positions_between(
    states: FloatArray, forces: FloatArray, mass: float, node_period: float, substeps: int
) -> tuple[FloatArray, FloatArray]:
    """Evaluate a plan between its nodes, exactly.

    Args:
        states: [p, v] at the nodes, shape (n, N + 1, 4).
        forces: F held between them, shape (n, N, 2) [N].
        mass: m [kg].
        node_period: Time from node to node [s].
        substeps: Instants per node step.

    Returns:
        Positions and velocities, both of shape (n, N * substeps + 1, 2).
    """
    time = (np.arange(substeps) * (node_period / substeps))[:, None]
    place, speed = states[:, :-1, None, :2], states[:, :-1, None, 2:]
    pull = forces[:, :, None, :] / mass
    place = place + time * speed + 0.5 * time**2 * pull
    speed = speed + time * pull
    shape = len(states), -1, 2
    return (
        np.concatenate([place.reshape(shape), states[:, -1:, :2]], axis=1),
        np.concatenate([speed.reshape(shape), states[:, -1:, 2:]], axis=1),
    )


def solve_joint(
    problem: JointProblem, guess: FloatArray, settings: JointScpSettings
) -> JointSolution:
    """Iterate from a guess of the positions.

    Args:
        problem: What to plan.
        guess: Positions at the control instants, shape (n, K + 1, 2) [m].
        settings: How to iterate.

    Returns:
        The plan of the last pass; `solved` says whether it keeps the distances.
    """
    layout = ProgramLayout(problem)
    places = guess
    n, nodes = len(problem.starts), problem.nodes
    states, forces = np.repeat(problem.starts[:, None], nodes + 1, axis=1), np.zeros((n, nodes, 2))
    effort = violation = np.inf
    best, stale = np.inf, 0
    status = f"distances not met in {settings.max_iterations} quadratic programs"
    iterations = 0
    while iterations < settings.max_iterations:
        program = layout.program(problem, places, settings)
        answer = solve_qp(program, settings.qp_tolerance)
        iterations += 1
        if not answer.solved:
            status = f"quadratic program {iterations} failed ({answer.status})"
            violation = np.inf
            break
        states = answer.values[layout.states].transpose(1, 0, 2)
        forces = answer.values[layout.forces].transpose(1, 0, 2)
        places, _ = positions_between(
            states, forces, problem.mass, problem.node_period, problem.substeps
        )
        violation = largest_violation(problem, places)
        before, effort = effort, 0.5 * problem.node_period * float(np.sum(forces**2))
        if violation <= settings.distance_tolerance:
            if before - effort <= settings.effort_tolerance * effort:
                status = "solved"
                break
            status = "solved, effort still falling"
        else:
            status = f"distances not met in {settings.max_iterations} quadratic programs"
            stale = 0 if violation < 0.5 * best else stale + 1
            if stale >= settings.patience:
                status = f"violation stays at {violation:.3f} m"
                break
        best = min(best, violation)
    solved = violation <= settings.distance_tolerance
    return JointSolution(states, forces, solved, status, float(violation), iterations)
