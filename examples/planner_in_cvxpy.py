"""The planner's quadratic program written in CVXPY, to read and to change.

`lagros_policies.planning` assembles the same program by hand, forty times as fast. Here it can
be read line by line and be given another cost or constraint; the loop around it plans a car among
discs. Needs `pip install 'lagros[train]'`.

    python examples/planner_in_cvxpy.py
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cvxpy
import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import hold_step, linearise_hold
from lagros_policies.planning import Discs, Problem
from lagros_policies.planning.guess import guesses

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Car:
    """[x, y, theta, v] under turn rate [rad/s] and acceleration [m/s^2]."""

    state_dim: int = 4
    control_dim: int = 2

    def derivative(self, state: Any, control: Any, functions: Any) -> Any:
        """Return dx/dt."""
        _, _, heading, speed = state
        return speed * functions.cos(heading), speed * functions.sin(heading), *control


def convex_program(
    problem: Problem,
    states: FloatArray,
    controls: FloatArray,
    trust_weight: float,
    penalty: float = 1e3,
    slope_substeps: int = 2,
) -> tuple[cvxpy.Problem, cvxpy.Variable, cvxpy.Variable]:
    """Return the program around a trajectory, and its unknowns x (N + 1, n) and u (N, m)."""
    x, u = cvxpy.Variable(states.shape), cvxpy.Variable(controls.shape)
    # Effort, and the trust region in its penalty form; all without units.
    unit = np.max(problem.control_scale)
    effort = problem.period * cvxpy.sum_squares((u - problem.reference_control[None]) / unit)
    step = cvxpy.sum_squares(cvxpy.multiply(x[1:] - states[1:], 1.0 / problem.state_scale[None]))
    step += cvxpy.sum_squares(cvxpy.multiply(u - controls, 1.0 / problem.control_scale[None]))
    cost = effort + 0.5 * trust_weight * step
    # The ends, the bounds, and the dynamics linearised around the trajectory.
    given = np.flatnonzero(problem.given_end)
    rules = [x[0] == problem.initial_state, x[-1, given] == problem.terminal_state[given]]
    for value, low, high in (
        (x[1:], problem.state_low, problem.state_high),
        (u, problem.control_low, problem.control_high),
    ):
        for bound, sign in ((low, -1.0), (high, 1.0)):
            rows, columns = np.nonzero(np.isfinite(bound))
            if rows.size:
                rules.append(sign * value[rows, columns] <= sign * bound[rows, columns])
    following = hold_step(problem.system, states[:-1], controls, problem.period)
    hold = states[:-1], controls, problem.period, slope_substeps
    _, by_state, by_control = linearise_hold(problem.system, *hold)
    for k in range(problem.steps):
        change = by_state[k] @ (x[k] - states[k]) + by_control[k] @ (u[k] - controls[k])
        rules.append(x[k + 1] == following[k] + change)
    # Beside each disc the half-plane that the trajectory points at, for a price if need be.
    if problem.discs is not None:
        axes = list(problem.discs.position)
        scale = np.max(problem.state_scale[axes])
        last = problem.steps - 1 if np.all(problem.given_end[axes]) else problem.steps
        nodes = np.arange(1, last + 1)
        required = problem.discs.required(problem.steps)[nodes]
        for disc, centre in enumerate(problem.discs.centres):
            away = states[nodes][:, axes] - centre
            normal = away / np.linalg.norm(away, axis=1, keepdims=True)
            distance = cvxpy.sum(cvxpy.multiply(normal, x[nodes][:, axes] - centre[None]), axis=1)
            cost += penalty * cvxpy.sum(cvxpy.pos(required[:, disc] - distance)) / scale
    return cvxpy.Problem(cvxpy.Minimize(cost), rules), x, u


def main(passes: int = 6) -> list[float]:
    """Plan by full steps under a fixed trust weight; return the defect after each pass."""
    problem = Problem(
        Car(),
        period=0.1,
        steps=60,
        initial_state=np.array([0.0, 0.0, 0.0, 1.5]),
        terminal_state=np.array([9.0, 0.5, 0.0, 1.5]),
        state_low=np.array([-np.inf, -np.inf, -np.inf, 1.0]),
        state_high=np.array([np.inf, np.inf, np.inf, 2.0]),
        discs=Discs(np.array([[3.0, 0.2], [6.0, 0.8]]), np.array(0.5), body_radius=0.2),
    )
    states, controls = next(guesses(problem))
    defects = []
    for _ in range(passes):
        program, x, u = convex_program(problem, states, controls, trust_weight=0.1)
        program.solve(solver="CLARABEL")
        states, controls = x.value, u.value
        ahead = hold_step(problem.system, states[:-1], controls, problem.period)
        defects.append(float(np.max(np.abs(ahead - states[1:]))))
        effort = problem.period * float(np.sum(controls**2))
        print(f"effort {effort:.4f}, largest defect {defects[-1]:.1e}")
    return defects


if __name__ == "__main__":
    main()
