"""Sequential convex programming with a trust region for least-effort trajectories.

The problem is the paper's (19): min of the integral of ||u - u_ref||^2 subject to the dynamics, a
given initial state, a given terminal state, bounds on states and controls, distances from discs,
and whatever else a task keeps at or below zero; see `problem`. Each pass linearises the held
Runge-Kutta dynamics, the distances and what is kept, solves one sparse quadratic program, and
accepts the step if it lowers an exact penalty of the true problem. The defects are those of the
true dynamics at every pass; the slopes come from a coarser Runge-Kutta step, which moves the limit
by far less than the tolerance on effort and halves the cost of a pass.

A disc is imposed at the nodes, as the half-plane beside it that the last trajectory points at. By
as much as the trajectory comes nearer between two nodes than it is at them, both must keep more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_above, check_fields, check_not_negative
from lagros_envs.dynamics import hold_step, linearise_hold
from lagros_envs.dynamics.integrate import SUBSTEPS
from lagros_envs.dynamics.system import components
from lagros_envs.numbers import functions
from lagros_policies.planning.problem import DISTANCE_SLACK, Problem
from lagros_policies.planning.program import Point, Programs
from lagros_policies.planning.qp import QpSolver, solve_qp
from lagros_policies.planning.trajectory import Trajectory
from lagros_policies.planning.vectors import segment_distance

# Shares of a step that are tried in turn where the trust region alone is slow to find a decrease.
_SHARES = (0.5, 0.25, 0.125)


@dataclass(frozen=True, slots=True)
class ScpSettings:
    """How long and how precisely to iterate. Scales are those of the problem.

    Attributes:
        max_iterations: Quadratic programs at most.
        defect_tolerance: Largest violation of the true dynamics of an accepted plan.
        effort_tolerance: Once a pass lowers the merit by less than this share of it, the trust
            region closes until the plan obeys the dynamics, whatever its step; zero for never.
        step_tolerance: Stop when no state (and no control, times the period) moves by more, in
            scales.
        qp_tolerance: Residual of the quadratic programs.
        trust_weight: Weight of the squared step, the trust region in its penalty form, at first.
        trust_weight_max: Give up when the weight that a decrease would need exceeds this.
        line_search_weight: From this trust weight on, a step that does not lower the merit is
            shortened before the weight grows.
        keep_weight: Whether the trust weight stays, and does not fall, after a step that was
            accepted at the second attempt or later.
        penalty: Weight of violations, in scales, in the merit function.
        slope_substeps: Runge-Kutta substeps behind the slopes.
        disc_reach: Discs are imposed at nodes nearer than required plus this many scales, and what
            is kept at or below zero where it is above minus this.
        disc_spare: How much more than required is asked for at the nodes, in scales, of both.
        qp_solver: Which solver is asked first.

    Raises:
        ValueError: A value is not positive, or the solver is not known.
    """

    max_iterations: int = 60
    defect_tolerance: float = 1e-7
    effort_tolerance: float = 0.0
    step_tolerance: float = 1e-3
    qp_tolerance: float = 1e-8
    trust_weight: float = 1e-3
    trust_weight_max: float = 1e6
    line_search_weight: float = 1.0
    keep_weight: bool = False
    penalty: float = 1e3
    slope_substeps: int = 2
    disc_reach: float = 1.0
    disc_spare: float = 1e-3
    qp_solver: QpSolver = "piqp"

    def __post_init__(self) -> None:
        check_fields(self)
        for item in fields(self):
            if item.name in ("disc_spare", "effort_tolerance"):
                check_not_negative(item.name, getattr(self, item.name))
            elif item.name not in ("keep_weight", "qp_solver"):
                check_above(item.name, getattr(self, item.name), 0)


def solve_scp(
    problem: Problem,
    guess: tuple[FloatArray, FloatArray] | None = None,
    settings: ScpSettings | None = None,
) -> Trajectory:
    """Plan from a guess.

    Args:
        problem: What to plan.
        guess: States (N + 1, n) and controls (N, m) to start from, which need not obey anything; a
            straight line under the reference control without.
        settings: How to iterate.

    Returns:
        The plan; `solved` is False, and `status` says why, where it does not hold.

    Raises:
        ValueError: The guess is misshapen or not finite.
    """
    return _Iteration(problem, settings or ScpSettings()).run(guess)


class _Iteration:
    """The passes over one problem."""

    def __init__(self, problem: Problem, settings: ScpSettings) -> None:
        self.problem, self.settings = problem, settings
        self.programs = Programs(
            problem, settings.penalty, settings.disc_reach, settings.disc_spare
        )
        self.bounded = (
            problem.control_low.max() > -math.inf or problem.control_high.min() < math.inf
        )
        discs = problem.discs
        self.required = None
        if discs is not None and len(discs.centres) > 0:
            self.axes = list(discs.position)
            self.required = discs.required(problem.steps)
            self.distance_scale = float(np.max(problem.state_scale[self.axes]))

    def run(self, guess: tuple[FloatArray, FloatArray] | None) -> Trajectory:
        settings, problem = self.settings, self.problem
        weight = settings.trust_weight
        point = self._point(*self._begin(guess))
        slopes = self._slopes(point)
        status = f"no convergence in {settings.max_iterations} quadratic programs"
        iterations = 0
        solved = closing = refused = False
        while iterations < settings.max_iterations:
            program = self.programs.around(point, slopes, weight)
            iterations += 1
            answer = solve_qp(program, settings.qp_tolerance, settings.qp_solver)
            if not answer.solved:
                status = f"quadratic program {iterations} failed ({answer.status})"
                break
            new, share = self._step(point, answer.values, weight)
            if new is None:
                refused = True
                weight = max(8.0 * weight, 1e-2)
                if weight > settings.trust_weight_max:
                    status = f"trust region exhausted at weight {weight:.0e}"
                    break
                continue
            step = self._length(point, new)
            fell = point.merit - new.merit
            settled = share == 1.0 and fell <= settings.effort_tolerance * new.merit
            closing = closing or (settings.effort_tolerance > 0.0 and settled)
            point = new
            if closing:
                weight = 8.0 * weight
            elif not (refused and settings.keep_weight):
                weight = max(weight / 8.0, settings.trust_weight)
            refused = False
            # Once the effort hardly falls it does not matter how far the last step went.
            at_rest = closing or (share == 1.0 and step <= settings.step_tolerance)
            if (
                at_rest
                and point.defect <= settings.defect_tolerance
                and point.clearance >= -DISTANCE_SLACK
                and point.excess <= DISTANCE_SLACK
            ):
                solved, status = True, "solved"
                break
            slopes = self._slopes(point)
        return Trajectory(
            point.states,
            point.controls,
            problem.period,
            solved,
            status,
            point.defect,
            iterations,
            point.clearance,
            point.excess,
            problem.reference_control,
        )

    def _begin(self, guess: tuple[FloatArray, FloatArray] | None) -> tuple[FloatArray, FloatArray]:
        problem = self.problem
        given = problem.given_end
        n, m = problem.system.state_dim, problem.system.control_dim
        if guess is None:
            end = np.where(given, problem.terminal_state, problem.initial_state)
            states = np.linspace(problem.initial_state, end, problem.steps + 1)
            return states, np.tile(problem.reference_control, (problem.steps, 1))
        states, controls = (np.array(part, dtype=np.float64) for part in guess)
        for name, part, shape in (
            ("states", states, (problem.steps + 1, n)),
            ("controls", controls, (problem.steps, m)),
        ):
            if part.shape != shape or not np.all(np.isfinite(part)):
                raise ValueError(
                    f"{name} of the guess, of shape {part.shape}, must be {shape} and finite"
                )
        # A warm start need not end where this problem ends: the linearisation pulls it there.
        states[0] = problem.initial_state
        states[-1, given] = problem.terminal_state[given]
        return states, controls

    def _step(self, point: Point, values: FloatArray, weight: float) -> tuple[Point | None, float]:
        """Return the step of a program or, where that alone lowers the merit, a share of it."""
        following, controls = self.programs.states_and_controls(values)
        states = np.vstack([point.states[:1], following])
        # Differences below the programs' own tolerance say nothing.
        allowed = point.merit + 1e-6 * (1.0 + abs(point.merit))
        new = self._point(states, controls)
        if new.merit <= allowed:
            return new, 1.0
        if weight >= self.settings.line_search_weight:
            for share in _SHARES:
                new = self._point(
                    point.states + share * (states - point.states),
                    point.controls + share * (controls - point.controls),
                )
                if new.merit < point.merit:
                    return new, share
        return None, 0.0

    def _length(self, point: Point, new: Point) -> float:
        """Return how far the trajectory moves, in scales; controls count times the period."""
        problem = self.problem
        states = np.max(np.abs(new.states - point.states) / problem.state_scale)
        controls = np.max(np.abs(new.controls - point.controls) / problem.control_scale)
        return max(float(states), problem.period * float(controls))

    def _slopes(self, point: Point) -> tuple[FloatArray, FloatArray]:
        _, by_state, by_control = linearise_hold(
            self.problem.system,
            point.states[:-1],
            point.controls,
            self.problem.period,
            self.settings.slope_substeps,
        )
        return by_state, by_control

    def _point(self, states: FloatArray, controls: FloatArray) -> Point:
        """Return a trajectory with its defects, its distances and its merit (exact penalty)."""
        problem = self.problem
        required, clearance, short = None, math.inf, 0.0
        if self.required is None:
            following = hold_step(problem.system, states[:-1], controls, problem.period)
        else:
            path = self._flow(states, controls)
            following = path[-1]
            required, clearance, short = self._distances(states, np.stack(path))
        later, scale = states[1:], problem.state_scale
        violation = (np.abs(following - later) / scale).sum()
        violation += (np.maximum(problem.state_low - later, 0.0) / scale).sum()
        violation += (np.maximum(later - problem.state_high, 0.0) / scale).sum()
        if self.bounded:
            # A guess may exceed the bounds of the controls; no program does.
            beyond = np.maximum(problem.control_low - controls, controls - problem.control_high)
            violation += (np.maximum(beyond, 0.0) / problem.control_scale).sum()
        excess = -math.inf
        if problem.keep is not None:
            kept = np.stack([*problem.keep(components(later), functions)], axis=-1)
            excess = float(np.max(kept))
            short += float(np.maximum(kept + self.settings.disc_spare, 0.0).sum())
        effort = ((controls - problem.reference_control) ** 2).sum() * problem.period
        effort /= problem.control_scale.max() ** 2
        merit = float(effort + self.settings.penalty * (violation + short))
        return Point(states, controls, following, required, clearance, excess, merit)

    def _flow(self, states: FloatArray, controls: FloatArray) -> list[FloatArray]:
        """Return x_k, and the states after each Runge-Kutta step of its hold, each (N, n)."""
        path = [states[:-1]]
        for _ in range(SUBSTEPS):
            step = self.problem.period / SUBSTEPS
            path.append(hold_step(self.problem.system, path[-1], controls, step, substeps=1))
        return path

    def _distances(self, states: FloatArray, path: FloatArray) -> tuple[FloatArray, float, float]:
        """Return what the nodes must keep, the least clearance, and the violation in scales.

        Args:
            states: x_0 ... x_N, shape (N + 1, n).
            path: States along the holds, shape (substeps + 1, N, n).
        """
        discs, required = self.problem.discs, self.required
        assert discs is not None
        assert required is not None
        at_nodes = np.linalg.norm(states[:, None, self.axes] - discs.centres, axis=-1)
        place = path[..., self.axes]
        between = np.min(segment_distance(place[:-1], place[1:], discs.centres), axis=0)
        nearer = np.maximum(np.minimum(at_nodes[:-1], at_nodes[1:]) - between, 0.0)
        more = np.zeros_like(required)
        more[:-1] = nearer
        more[1:] = np.maximum(more[1:], nearer)
        least = np.minimum(required[:-1], required[1:])
        clearance = min(float(np.min(at_nodes - required)), float(np.min(between - least)))
        asked = required + more + self.settings.disc_spare * self.distance_scale
        inner = slice(1, -1) if np.all(self.problem.given_end[self.axes]) else slice(1, None)
        short = np.maximum(asked - at_nodes, 0.0)[inner]
        return asked, clearance, float(np.sum(short)) / self.distance_scale
