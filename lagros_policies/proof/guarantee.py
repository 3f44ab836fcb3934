"""What a proved tube around a plan means for the episode: the rules of its task, over the tube.

A tube (`plan_tube`) says how far the flown state can be from x_d, whatever the disturbance does up
to its bound. Here the rules by which the environment judges an episode are evaluated on all states
of the tube at once, by intervals rounded outwards. What comes out is *proved*, of any task of one
body; what cannot be shown is "not shown" and never guessed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.dynamics.system import System
from lagros_envs.numbers import Dual, Interval, exact, functions
from lagros_envs.numbers.interval import Truth
from lagros_envs.task import Task
from lagros_policies.proof.plan_tube import PlanTubes

# Above the rounding of what the environment computes of a state, relative and [m].
_ROUNDING = 1e-9
# Rounds of Picard's iteration, by how much more each set is tried, and the least width.
_ROUNDS, _WIDER, _LEAST = 30, 0.1, 1e-9
# Turns of the direction from a disc to a plan that are tried to part the two [rad].
_TURNS = (0.0, *(side * turn for turn in (0.1, 0.2, 0.35, 0.5, 0.7) for side in (1.0, -1.0)))


@dataclass(frozen=True)
class Guarantees:
    """What is proved of the episodes of p plans, for every disturbance up to the bound.

    Attributes:
        closed: Whether there is a tube, shape (p,).
        reaches: Whether the goal is within the radius of success at the time limit, shape (p,).
        upright: Whether no state of the tube has fallen (`Task.fallen`), shape (p,).
        clear: Whether no straight way of a step touches a disc, shape (p,).
        within: Whether the law never asks for more than the bounds of the control, shape (p,);
            what they take of it is in the tube, so that nothing else depends on it.
        goal_distance: Bound of the distance from the goal at the time limit, shape (p,).
        state: Bounds of |x| by coordinate, at the instants and between them, shape (p, n).
        error: Bounds of |x - x_d|, likewise.
        norm: Bounds of ||x - x_d|| at the control instants, shape (p, N + 1).
        deviation: Bounds of |u - u_d|, shape (p, m).
    """

    closed: BoolArray
    reaches: BoolArray
    upright: BoolArray
    clear: BoolArray
    within: BoolArray
    goal_distance: FloatArray
    state: FloatArray
    error: FloatArray
    norm: FloatArray
    deviation: FloatArray

    @cached_property
    def holds(self) -> BoolArray:
        """Whether an episode is guaranteed: a tube, and everything that is asked, shape (p,)."""
        return self.closed & self.reaches & self.upright & self.clear


def guarantees(
    task: Task,
    goals: FloatArray,
    discs: FloatArray,
    states: FloatArray,
    controls: FloatArray,
    tubes: PlanTubes,
) -> Guarantees:
    """Return what tubes around plans guarantee of their episodes.

    Args:
        task: The task; its rules may choose by `where`, and are otherwise like an equation.
        goals: x_f, shape (p, n).
        discs: Centre and radius of each disc, shape (p, k, 3); of radius zero where there is none.
        states: x_d at the control instants, shape (p, N + 1, n).
        controls: u_d, shape (p, N, m).
        tubes: The tubes, the first n of whose directions are the coordinates.
    """
    n = task.system.state_dim
    closed = np.asarray(tubes.closed, bool)
    # A number in place of what is not known: intervals have no sine of infinity.
    reach = np.where(closed[:, None, None], tubes.outputs[..., :n], 0.0)
    at = _around(states, reach)
    over = nominal_between(task.system, states, controls, task.control_period)
    span = np.where(closed[:, None, None], tubes.between[..., :n], np.inf)
    largest = np.maximum(np.abs(over.lower), np.abs(over.upper)) + span
    distance = np.where(closed, _goal_distance(task, at, goals, states, tubes), np.inf)
    radius = float(task.success_radius(task.control_period * controls.shape[1]))
    deviation = np.where(closed[:, None, None], tubes.deviation, np.inf)
    return Guarantees(
        closed=closed,
        reaches=distance <= radius,
        upright=closed & _never(task, at),
        clear=closed & _clear(task, discs, states, tubes),
        within=closed & _within(task, controls, deviation),
        goal_distance=distance,
        state=largest.max(axis=1) * (1.0 + _ROUNDING),
        error=span.max(axis=1),
        norm=np.where(closed[:, None], tubes.norm, np.inf),
        deviation=deviation.max(axis=1),
    )


def nominal_between(
    system: System, states: FloatArray, controls: FloatArray, period: float
) -> Interval:
    """Enclose x_d over each hold: the motion from x_d(t_k) under u_d without disturbance.

    Picard's iteration finds a set that holds the motion; over it x_d'' is enclosed, and a motion
    leaves the chord between its ends by at most h^2/8 sup |x_d''|.

    Args:
        system: The system.
        states: x_d at the control instants, shape (p, N + 1, n).
        controls: u_d, shape (p, N, m).
        period: Hold h [s].

    Returns:
        Shape (p, N, n); all numbers where no such set was found.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return _nominal_between(system, states, controls, period)
    except (ArithmeticError, ValueError):
        # The motion leaves what the equation is meant for before a set holds it.
        nothing = np.full(states[:, 1:].shape, np.inf)
        return Interval(-nothing, nothing)


def _nominal_between(
    system: System, states: FloatArray, controls: FloatArray, period: float
) -> Interval:
    n = system.state_dim
    begin = [exact(part) for part in np.moveaxis(states[:, :-1], -1, 0)]
    force = [exact(part) for part in np.moveaxis(controls, -1, 0)]
    time = Interval(0.0, period)
    sets, found = begin, np.zeros(controls.shape[:2], bool)
    for _ in range(_ROUNDS):
        rates = system.derivative(sets, force, functions)
        moved = [x + rate * time for x, rate in zip(begin, rates, strict=True)]
        found = np.all([_inside(one, other) for one, other in zip(moved, sets, strict=True)], 0)
        if found.all():
            break
        sets = [
            _chosen(found, other, _widened(one)) for one, other in zip(moved, sets, strict=True)
        ]
    bends = _second_rates(system, sets, force)
    first = system.derivative(begin, force, functions)
    ends = []
    for index in range(n):
        bend = bends[index] * (0.5 * period * period)
        end = begin[index] + first[index] * period + bend
        off = 0.25 * np.maximum(np.abs(bend.lower), np.abs(bend.upper)) * (1.0 + _ROUNDING)
        lower = np.minimum(begin[index].lower, end.lower) - off
        upper = np.maximum(begin[index].upper, end.upper) + off
        ends.append((np.where(found, lower, -np.inf), np.where(found, upper, np.inf)))
    return Interval(*(np.stack(side, axis=-1) for side in zip(*ends, strict=True)))


def _second_rates(
    system: System, sets: Sequence[Interval], force: Sequence[Interval]
) -> list[Interval]:
    """Enclose x'' = (df/dx) x' over sets of states under constant controls."""
    rates = system.derivative(sets, force, functions)
    along = [
        Dual(x, rate if isinstance(rate, Interval) else exact(rate))
        for x, rate in zip(sets, rates, strict=True)
    ]
    still = exact(np.zeros(force[0].shape))
    found = system.derivative(along, [Dual(u, still) for u in force], functions)
    return [one.gradient if isinstance(one, Dual) else still for one in found]


def _widened(one: Interval) -> Interval:
    wide = _WIDER * (one.upper - one.lower) + _LEAST
    return Interval(one.lower - wide, one.upper + wide)


def _chosen(first: BoolArray, one: Interval, other: Interval) -> Interval:
    lower = np.where(first, one.lower, other.lower)
    return Interval(lower, np.where(first, one.upper, other.upper))


def _inside(one: Interval, other: Interval) -> BoolArray:
    inside: BoolArray = (other.lower <= one.lower) & (one.upper <= other.upper)
    return inside


def _around(states: FloatArray, reach: FloatArray) -> list[Interval]:
    """Return the coordinates of the box around each state, rounded outwards."""
    box = exact(states) + Interval(-reach, reach)
    return [box[..., index] for index in range(states.shape[-1])]


def _never(task: Task, at: Sequence[Interval]) -> BoolArray:
    """Return which plans have no fallen state in their tube, shape (p,)."""
    try:
        fallen: Any = task.fallen(at, functions)
    except (TypeError, ValueError, ArithmeticError, AttributeError):
        # A rule that intervals cannot follow shows nothing.
        return np.zeros(len(at[0].lower), bool)
    can = fallen.can if isinstance(fallen, Truth) else fallen
    some = np.broadcast_to(np.asarray(can, bool), at[0].shape).any(axis=1)
    return np.asarray(~some)


def _goal_distance(
    task: Task, at: Sequence[Interval], goals: FloatArray, states: FloatArray, tubes: PlanTubes
) -> FloatArray:
    """Bound the distance from the goal at the end of each plan, shape (p,)."""
    end = [part[:, -1] for part in at]
    bound = np.full(len(goals), np.inf)
    try:
        by_box = task.goal_distance(end, [exact(part) for part in goals.T], functions)
        bound = np.broadcast_to(getattr(by_box, "upper", by_box), bound.shape)
    except (TypeError, ValueError, ArithmeticError, AttributeError):
        pass
    if type(task).goal_distance is Task.goal_distance:
        # A distance of some coordinates moves by no more than the state does.
        here = task.goal_distance(list(states[:, -1].T), list(goals.T), functions)
        bound = np.minimum(bound, here + tubes.norm[:, -1])
    return bound * (1.0 + _ROUNDING) + _ROUNDING


def _within(task: Task, controls: FloatArray, deviation: FloatArray) -> BoolArray:
    """Return where u_d and all deviations from it keep the bounds of the control, shape (p,)."""
    low, high = np.array(task.control_low), np.array(task.control_high)
    kept = (controls - deviation >= low) & (controls + deviation <= high)
    return np.asarray(np.all(kept | (np.isinf(low) & np.isinf(high)), axis=(1, 2)))


def _clear(task: Task, discs: FloatArray, states: FloatArray, tubes: PlanTubes) -> BoolArray:
    """Return which plans keep every straight way of a step in their tube off the discs, (p,).

    A line between disc and way parts the two: the way lies beyond it if both of its ends do, for
    every error that the tube allows there.
    """
    count = len(states)
    if not discs.shape[1] or not task.position:
        return np.ones(count, bool)
    place = states[..., list(task.position)]
    begin, end = place[:, :-1, None], place[:, 1:, None]
    centre, contact = discs[:, None, :, :2], discs[:, None, :, 2] + task.body_radius
    way = end - begin
    square = np.einsum("...c,...c->...", way, way)
    along = np.einsum("...c,...c->...", centre - begin, way) / np.where(square > 0.0, square, 1.0)
    nearest = begin + np.clip(along, 0.0, 1.0)[..., None] * way - centre
    length = np.linalg.norm(nearest, axis=-1, keepdims=True)
    nearest = nearest / np.where(length > 0.0, length, 1.0)
    apart = np.broadcast_to(discs[:, None, :, 2] <= 0.0, nearest.shape[:-1]).copy()
    for turn in _TURNS:
        cosine, sine = math.cos(turn), math.sin(turn)
        ray = nearest @ np.array([[cosine, sine], [-sine, cosine]])
        reach = _reach(task, tubes, ray)
        first = np.einsum("...c,...c->...", begin - centre, ray) - reach[0]
        last = np.einsum("...c,...c->...", end - centre, ray) - reach[1]
        apart |= np.minimum(first, last) >= contact * (1.0 + _ROUNDING) + _ROUNDING
    return np.asarray(apart.all(axis=(1, 2)))


def _reach(task: Task, tubes: PlanTubes, ray: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bound ray'e of the position at both ends of each step, for rays (p, N, k, 2) of length one.

    A ray is a sum of any two directions of the tube in the plane: its bound that of theirs.
    """
    place, directions = list(task.position), tubes.directions
    others = np.delete(directions, place, axis=1)
    flat = np.flatnonzero(~others.any(axis=1) & directions.any(axis=1))
    ends = tubes.outputs[:, :-1], tubes.outputs[:, 1:]
    norms = tubes.norm[:, :-1, None], tubes.norm[:, 1:, None]
    found = [np.broadcast_to(norm, ray.shape[:-1]) for norm in norms]
    for pair in combinations(flat, 2):
        basis = directions[list(pair)][:, place].T
        if abs(np.linalg.det(basis)) < 1e-6 * np.linalg.norm(basis) ** 2:
            continue
        weights = np.abs(ray @ np.linalg.inv(basis).T)
        for side, outputs in enumerate(ends):
            bound = np.einsum("pskw,psw->psk", weights, outputs[..., list(pair)])
            found[side] = np.minimum(found[side], bound)
    return found[0] * (1.0 + _ROUNDING), found[1] * (1.0 + _ROUNDING)
