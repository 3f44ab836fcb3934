"""The cart-pole planning problem in CasADi, by multiple shooting, for IPOPT and fatrop.

The same problem as `CartPolePlanner`: the project's own equation of motion, evaluated on CasADi
symbols, and its own Runge-Kutta substeps, effort and bounds. Solvers are built once per horizon,
with start and goal as parameters; only solving is timed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.tasks.cartpole.physics import ANGLE
from lagros_policies.tasks.cartpole.planner import CartPolePlanner

FloatArray = NDArray[np.float64]

_STATES, _CONTROLS = 4, 1
_STAGE = _STATES + _CONTROLS
# The planner's plans obey the dynamics to 1e-7; the peers' default is 1e-8.
_TOLERANCE = 1e-6
_OPTIONS: dict[str, dict[str, Any]] = {
    "ipopt": {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": _TOLERANCE},
    "fatrop": {
        "fatrop.print_level": 0,
        "fatrop.tolerance": _TOLERANCE,
        "structure_detection": "auto",
    },
}
# IPOPT stays near a warm start only if it is told to.
_WARM_IPOPT = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-4,
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
}


@dataclass(frozen=True)
class Answer:
    """A solution: unknowns, multipliers of bounds and of constraints, and what it is worth.

    Attributes:
        unknowns: [x_0, u_0, x_1, ..., x_N].
        bound_multipliers: One per unknown.
        multipliers: One per constraint.
        effort: Integral of ||u||^2.
        solved: Whether the solver met its tolerance.
        iterations: Its iterations.
    """

    unknowns: FloatArray
    bound_multipliers: FloatArray
    multipliers: FloatArray
    effort: float
    solved: bool
    iterations: int


def available(solver: str) -> bool:
    """Return whether the installed CasADi has this solver."""
    return bool(casadi.has_nlpsol(solver))


class CasadiPlanner:
    """Plans the last part of an episode.

    Args:
        planner: States the problem.
        solver: "ipopt" or "fatrop".
        start_step: Control step at which the plans begin.
        warm: Whether IPOPT is set up for warm starts.
    """

    def __init__(
        self, planner: CartPolePlanner, solver: str, start_step: int = 0, warm: bool = False
    ) -> None:
        """Build the solver."""
        task = planner.task
        self.horizon = task.steps - start_step
        step = _hold(planner)
        states = [casadi.MX.sym(f"x{k}", _STATES) for k in range(self.horizon + 1)]
        controls = [casadi.MX.sym(f"u{k}", _CONTROLS) for k in range(self.horizon)]
        ends = casadi.MX.sym("ends", 2 * _STATES)
        # fatrop finds the stages by itself if unknowns and constraints come stage by stage.
        unknowns, constraints = [states[0]], []
        for k, control in enumerate(controls):
            unknowns += [control, states[k + 1]]
            constraints.append(states[k + 1] - step(states[k], control))
            if k == 0:
                constraints.append(states[0] - ends[:_STATES])
        constraints.append(states[-1] - ends[_STATES:])
        problem = {
            "x": casadi.vertcat(*unknowns),
            "p": ends,
            "f": task.control_period * casadi.sumsqr(casadi.vertcat(*controls)),
            "g": casadi.vertcat(*constraints),
        }
        # Expanded to scalar operations the derivatives are fastest.
        options = {"expand": True, "print_time": False, **_OPTIONS[solver]}
        if solver == "fatrop":
            options["equality"] = [True] * problem["g"].numel()
        elif warm:
            options |= _WARM_IPOPT
        self._solve = casadi.nlpsol("plan", solver, problem, options)
        times = task.control_period * np.arange(start_step, task.steps + 1.0)
        widest = np.full((self.horizon + 1, _STAGE), np.inf)
        widest[1:-1, ANGLE] = planner.angle_limit(times)[1:-1]
        self._widest = widest.ravel()[:-_CONTROLS]

    def plan(self, start: FloatArray, goal: FloatArray, guess: Answer | None = None) -> Answer:
        """Plan from a straight line, or from an earlier solution over the same horizon."""
        if guess is None:
            line = np.zeros((self.horizon + 1, _STAGE))
            line[:, :_STATES] = np.linspace(start, goal, self.horizon + 1)
            first = {"x0": line.ravel()[:-_CONTROLS]}
        else:
            first = {
                "x0": guess.unknowns,
                "lam_x0": guess.bound_multipliers,
                "lam_g0": guess.multipliers,
            }
        found = self._solve(
            **first,
            p=np.concatenate([start, goal]),
            lbx=-self._widest,
            ubx=self._widest,
            lbg=0.0,
            ubg=0.0,
        )
        stats = self._solve.stats()
        return Answer(
            unknowns=np.asarray(found["x"]).ravel(),
            bound_multipliers=np.asarray(found["lam_x"]).ravel(),
            multipliers=np.asarray(found["lam_g"]).ravel(),
            effort=float(found["f"]),
            solved=bool(stats["success"]),
            iterations=int(stats["iter_count"]),
        )


def rest_of(answer: Answer) -> Answer:
    """Return a solution without its first stage: the guess for planning one step later."""
    multipliers = answer.multipliers
    # Per stage: the dynamics, and in the first one the initial state, whose place the multiplier
    # of the dynamics that led here takes.
    dynamics, rest = multipliers[:_STATES], multipliers[2 * _STATES :]
    return Answer(
        unknowns=answer.unknowns[_STAGE:],
        bound_multipliers=answer.bound_multipliers[_STAGE:],
        multipliers=np.concatenate([rest[:_STATES], dynamics, rest[_STATES:]]),
        effort=answer.effort,
        solved=answer.solved,
        iterations=answer.iterations,
    )


def _hold(planner: CartPolePlanner) -> Any:
    """Return F(x, u), one control step of the true dynamics, as a CasADi function."""
    state, control = casadi.SX.sym("x", _STATES), casadi.SX.sym("u", _CONTROLS)
    following = rk4_hold(
        planner.task.system,
        [state[index] for index in range(_STATES)],
        [control[0]],
        [0.0] * _STATES,
        planner.task.control_period,
        casadi,
    )
    return casadi.Function("hold", [state, control], [casadi.vertcat(*following)])
