"""Errors between the instants of control: of the motion itself, which the environment samples.

Over a hold u and d are constant. The motion x(s) that begins at the environment's x(t_k), and
x_d(s) that begins at x_d(t_k) under u_d, leave the chords between their ends by at most h^2/8 times
their second derivatives; and the end of a motion is not the Runge-Kutta step, from which it differs
by a truncation error of fifth order. Both are enclosed over sets that hold the motion (Picard's
iteration), so that one bound covers the sampled error and the continuous one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.dynamics import System
from lagros_envs.dynamics.integrate import SUBSTEPS, rk4_hold
from lagros_envs.numbers import Interval, Series, exact, functions, variable
from lagros_policies.proof.enclosures import constant, slopes

_ORDER = 5  # of the truncation error
# Rounds of Picard's iteration, by how much more each set is tried, and the least room in it, for
# what the integration errs by.
_ROUNDS, _WIDER, _ROOM = 20, 0.05, 1e-3
_WIDE = 1.0 + 1e-12
# Terms of the matrix exponential; beyond this norm its tail is not known.
_TERMS, _STIFFEST = 16, 6.0


@dataclass(frozen=True)
class Holds:
    """What motions do over holds, arrays of any shape (...).

    Attributes:
        bend: Enclosures of x'' along the motion, n intervals (...).
        defect: Bounds of the distance of its end from the Runge-Kutta step, shape (..., n).
        known: Where a set that holds the motion was found, shape (...).
    """

    bend: Sequence[Interval]
    defect: FloatArray
    known: BoolArray


def holds(
    system: System,
    begin: Sequence[Interval],
    control: Sequence[Interval],
    push: Sequence[Interval | float],
    period: float,
) -> Holds:
    """Enclose motions over holds.

    Args:
        system: The system.
        begin: Where they begin, n intervals (...).
        control: u, m intervals (...).
        push: d, n of them; zeros for none.
        period: Hold h [s].

    Raises:
        ZeroDivisionError: The equation has no value somewhere, or no derivative.
        ValueError: Likewise.
    """
    sets, known = _sets(system, begin, control, push, period)
    # Places of which nothing is known take part with a motion that is.
    series = _motion(system, sets, control, push, _ORDER)
    step = period / SUBSTEPS
    clock: Any = variable(Interval(0.0, step), _ORDER)
    stepped = rk4_hold(system, sets, control, push, clock, functions, 1)
    local = [
        _size(one[_ORDER] - _part(other, _ORDER)) * step**_ORDER * _WIDE
        for one, other in zip(series, stepped, strict=True)
    ]
    shape = begin[0].shape
    errors = np.stack([np.broadcast_to(one, shape) for one in local], axis=-1)
    defect, tame = _carried(system, sets, control, errors, period)
    room = np.stack([np.broadcast_to(_room(one), shape) for one in begin], axis=-1)
    known = known & tame & np.all(defect <= room, axis=-1)
    return Holds([one[2] * 2.0 for one in series], defect, known)


def errors_between(
    system: System,
    period: float,
    states: FloatArray,
    controls: FloatArray,
    boxes: FloatArray,
    deviation: FloatArray,
    push: FloatArray,
    directions: FloatArray,
    outputs: FloatArray,
) -> FloatArray:
    """Bound |l'(x(s) - x_d(s))| over whole holds.

    Args:
        system: The system.
        period: Hold [s].
        states: x_d, shape (p, N + 1, n).
        controls: u_d, shape (p, N, m).
        boxes: Bounds of |x - x_d| at the instants, shape (p, N + 1, n).
        deviation: Bounds of |u - u_d|, shape (p, N, m).
        push: Bounds of |d|, shape (n,).
        directions: l, shape (q, n).
        outputs: Bounds of |l'(x - x_d)| at the instants, shape (p, N + 1, q).

    Returns:
        Shape (p, N, q); inf where nothing is known.
    """
    known = np.isfinite(boxes[:, :-1]).all(axis=2) & np.isfinite(outputs[:, 1:]).all(axis=2)
    known &= np.isfinite(deviation).all(axis=2)
    begin = states[:, :-1][known]
    between = np.full((*known.shape, len(directions)), np.inf)
    if not known.any():
        return between
    control, reach = controls[known], boxes[:, :-1][known]
    force = _around(control, deviation[known])
    pushes = [Interval(-one, one) if one > 0.0 else 0.0 for one in push.tolist()]
    nothing, still = np.zeros_like(control), [0.0] * len(push)
    planned_from = _around(begin, 0.0 * reach), _around(control, nothing), still, period
    try:
        # Sets that grow until they overflow hold nothing, and are known to.
        with np.errstate(over="ignore", invalid="ignore"):
            flown = holds(system, _around(begin, reach), force, pushes, period)
            planned = holds(system, *planned_from)
            step = rk4_hold(system, *planned_from, functions)
    except (ArithmeticError, ValueError):
        return between
    following = states[:, 1:][known]
    missed = [_size(one - following[:, index]) for index, one in enumerate(step)]
    defect = flown.defect + planned.defect + np.stack(missed, axis=-1)
    bends = [_size(one - other) for one, other in zip(flown.bend, planned.bend, strict=True)]
    bend = np.stack([np.broadcast_to(one, len(begin)) for one in bends], axis=-1)
    size = np.abs(directions).T
    with np.errstate(invalid="ignore"):  # of what has overflown: no number, and so not known
        ends = np.maximum(outputs[:, :-1][known], outputs[:, 1:][known] + defect @ size * _WIDE)
        found = (ends + (0.125 * period * period) * (bend @ size)) * _WIDE
    shown = (flown.known & planned.known)[:, None] & ~np.isnan(found)
    between[known] = np.where(shown, found, np.inf)
    return between


def _sets(
    system: System,
    begin: Sequence[Interval],
    control: Sequence[Interval],
    push: Sequence[Any],
    period: float,
) -> tuple[list[Interval], BoolArray]:
    """Return sets that hold the motion with some room, and where they do."""
    clock = Interval(0.0, period)
    room = [_room(one) for one in begin]
    sets = [one + Interval(-some, some) for one, some in zip(begin, room, strict=True)]
    found = np.zeros(begin[0].shape, bool)
    for _ in range(_ROUNDS):
        rates = system.derivative(sets, control, functions)
        moved = [
            one + (rate + along) * clock + Interval(-some, some)
            for one, rate, along, some in zip(begin, rates, push, room, strict=True)
        ]
        inside = [
            (old.lower <= new.lower) & (new.upper <= old.upper)
            for old, new in zip(sets, moved, strict=True)
        ]
        found = np.asarray(np.all(inside, axis=0))
        if found.all():
            break
        sets = [
            Interval(
                np.where(found, old.lower, new.lower - _WIDER * (new.upper - new.lower)),
                np.where(found, old.upper, new.upper + _WIDER * (new.upper - new.lower)),
            )
            for old, new in zip(sets, moved, strict=True)
        ]
    return sets, found


def _room(begin: Interval) -> FloatArray:
    """Return the room around a motion that its integration may use."""
    size: FloatArray = _ROOM * (1.0 + _size(begin)) + 1e-3 * (begin.upper - begin.lower)
    return size


def _motion(
    system: System,
    sets: Sequence[Interval],
    control: Sequence[Interval],
    push: Sequence[Any],
    order: int,
) -> list[list[Interval]]:
    """Enclose the Taylor coefficients in time of all motions through sets, n lists."""
    parts = [[one] for one in sets]
    for k in range(order):
        rates = system.derivative([Series(list(one)) for one in parts], control, functions)
        for one, rate, along in zip(parts, rates, push, strict=True):
            found = _part(rate, k) + along if k == 0 else _part(rate, k)
            one.append(found / float(k + 1))
    return parts


def _part(number: Any, order: int) -> Interval:
    """Return a coefficient of a series, or of what does not depend on its variable."""
    if isinstance(number, Series):
        return number.parts[order]
    value = number if isinstance(number, Interval) else exact(number)
    return value if order == 0 else exact(np.zeros(value.shape))


def _carried(
    system: System,
    sets: Sequence[Interval],
    control: Sequence[Interval],
    local: FloatArray,
    period: float,
) -> tuple[FloatArray, BoolArray]:
    """Return what the local errors of the substeps come to: at most 4 exp(M h) of one.

    M bounds the slopes by their sizes, so that all terms of the exponential are positive.
    """
    by_state, _ = slopes(system, *([constant(x, 0) for x in part] for part in (sets, control)))
    matrix = _size(by_state.parts[0]) * period
    tame = matrix.sum(axis=-1).max(axis=-1) <= _STIFFEST
    matrix = np.where(tame[..., None, None], matrix, 0.0)
    total = term = SUBSTEPS * local
    for order in range(1, _TERMS):
        term = np.einsum("...ij,...j->...i", matrix, term) / order
        total = total + term
    # The terms after the last one halve at least, by the norm of the matrix.
    tail = 2.0 * term.max(axis=-1, keepdims=True)
    return (total + tail) * _WIDE, tame


def _around(middle: FloatArray, reach: FloatArray) -> list[Interval]:
    return [
        exact(middle[..., index]) + Interval(-reach[..., index], reach[..., index])
        for index in range(middle.shape[-1])
    ]


def _size(one: Interval) -> FloatArray:
    size: FloatArray = np.maximum(np.abs(one.lower), np.abs(one.upper))
    return size
