"""Tubes around plans: what no disturbance within its bound can make the error of a law exceed.

The error along a plan is linear time-varying with a remainder. Its set after k holds is a sum of
balls, one for each disturbance so far, and of segments, one for each remainder; each hold moves the
sum by its slopes and adds to it, so that bounds in any direction are sums that fit as tightly as
those of the linear error (`hold_error`). The step k needs the set at k alone: nothing is iterated.

*Proved*, for the environment's own step: Runge-Kutta with u and d held, an observation and an
action in single precision, and the rounding of all floats, also of those of the bound itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import check_not_negative, check_positive, shown
from lagros_envs.dynamics import System
from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.numbers import functions
from lagros_envs.numbers.taylor import TaylorModel, monomials
from lagros_policies.proof.between import errors_between
from lagros_policies.proof.error_set import ErrorSet, boxed
from lagros_policies.proof.hold_error import HoldOfErrors
from lagros_policies.proof.steering import SINGLE, Controller, LinearGain, Steering

# Plans whose numbers stay in the cache together.
_TOGETHER = 64
# Places along a plan that are looked at for what is not affine there.
_PLACES = 8


@dataclass(frozen=True)
class PlanTubes:
    """Bounds of the errors e = x - x_d along p plans of N holds.

    Attributes:
        closed: Whether anything is known up to the end, shape (p,).
        outputs: Bounds of |l'e| at the control instants for each direction l, (p, N + 1, q); inf
            from where nothing is known.
        between: Bounds of |l'(x(s) - x_d(s))| over each whole hold, of the motions themselves,
            shape (p, N, q); see `between.errors_between`.
        norm: Bounds of ||e|| at the control instants, shape (p, N + 1).
        deviation: Bounds of |u - u_d| over each hold, as it is applied, shape (p, N, m).
        directions: l, shape (q, n).
    """

    closed: BoolArray
    outputs: FloatArray
    between: FloatArray
    norm: FloatArray
    deviation: FloatArray
    directions: FloatArray


def plan_tubes(
    system: System,
    period: float,
    states: FloatArray,
    controls: FloatArray,
    feedback: FloatArray | Controller,
    bound: float,
    *,
    directions: ArrayLike | None = None,
    control_low: ArrayLike = -np.inf,
    control_high: ArrayLike = np.inf,
    control_centre: ArrayLike = 0.0,
    channels: Sequence[bool] | None = None,
    initial: ArrayLike | None = None,
    tell: Callable[[int, int], None] | None = None,
) -> PlanTubes:
    """Bound the errors of a law along plans for every disturbance with ||d|| <= d_bar.

    Args:
        system: The system.
        period: Hold [s].
        states: x_d, shape (p, N + 1, n).
        controls: u_d, shape (p, N, m).
        feedback: K of u = u_d + K e, shape (p, N, m, n), or a law that can be enclosed.
        bound: d_bar, in units of the state per second.
        directions: l, shape (q, n); the coordinates if left out.
        control_low: Least control, shape (m,): the environment clips, and what it may take counts
            as an error of the control.
        control_high: Largest control, likewise.
        control_centre: Control of the action zero, shape (m,).
        channels: Which coordinates d moves; all if left out.
        initial: Bounds of |x(0) - x_d(0)|, shape (n,) or (p, n); what single precision rounds of
            x_d(0) if left out.
        tell: Called with the number of holds that are done, and with that of all.

    Raises:
        ValueError: A shape is wrong, a number is not finite, or the bound is negative.
    """
    check_positive("period", period)
    check_not_negative("bound", bound)
    states, controls = np.asarray(states, np.float64), np.asarray(controls, np.float64)
    n, m = system.state_dim, system.control_dim
    plans, steps = _checked(states, controls, n, m)
    centre = np.asarray(control_centre, np.float64)
    if isinstance(feedback, np.ndarray):
        _check_shape("feedback", feedback, (plans, steps, m, n))
        pieces = [slice(place, place + _TOGETHER) for place in range(0, plans, _TOGETHER)]
        laws: list[Controller] = [LinearGain(feedback[piece], centre) for piece in pieces]
    else:
        pieces, laws = [slice(0, plans)], [feedback]
    mask = np.ones(n, bool) if channels is None else np.asarray(channels, bool)
    _check_shape("channels", mask, (n,))
    asked = np.eye(n) if directions is None else np.asarray(directions, np.float64)
    _check_shape("directions", asked, (len(asked), n))
    begin = SINGLE * np.abs(states[:, 0]) if initial is None else np.asarray(initial, np.float64)
    begin = np.broadcast_to(begin, (plans, n))
    limits = np.asarray(control_low, np.float64), np.asarray(control_high, np.float64)
    hold = HoldOfErrors(system, period, bound, mask, curved(system, period, states, controls))
    every = np.concatenate([np.eye(n), asked])
    found = []
    for index, (piece, law) in enumerate(zip(pieces, laws, strict=True)):
        plan = states[piece], controls[piece]

        def told(step: int, before: int = index * steps) -> None:
            if tell is not None:
                tell(before + step, len(pieces) * steps)

        known, outputs, norm, deviation = _along(
            hold, *plan, law, every, begin[piece], limits, told
        )
        between = errors_between(
            system,
            period,
            *plan,
            outputs[..., :n],
            deviation,
            bound * mask,
            asked,
            outputs[..., n:],
        )
        found.append((known, outputs[..., n:], between, norm, deviation))
    closed, outputs, between, norm, deviation = (
        np.concatenate(parts) for parts in zip(*found, strict=True)
    )
    return PlanTubes(closed, outputs, between, norm, deviation, asked)


def _along(
    hold: HoldOfErrors,
    states: FloatArray,
    controls: FloatArray,
    law: Controller,
    directions: FloatArray,
    initial: FloatArray,
    limits: tuple[FloatArray, FloatArray],
    told: Callable[[int], None],
) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray]:
    """Return which tubes close, and bounds along directions, of the norm and of u - u_d."""
    plans, steps, m = controls.shape
    outputs = np.full((plans, steps + 1, len(directions)), np.inf)
    norm, deviation = np.full((plans, steps + 1), np.inf), np.full((plans, steps, m), np.inf)
    known = np.ones(plans, bool)
    asked = np.broadcast_to(directions, (plans, *directions.shape))
    errors = boxed(initial, int(hold.channels.sum()))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for step in range(steps + 1):
            told(step)
            outputs[known, step] = errors.bound(asked)[known]
            norm[known, step] = errors.norm()[known]
            if step == steps:
                break
            state, control = states[:, step], controls[:, step]
            steering = law.steering(step, errors, state, control)
            steering, reach = _clipped(steering, errors, control, limits)
            known &= np.isfinite(reach).all(axis=1)
            deviation[known, step] = reach[known]
            errors, good = hold.following(errors, steering, state, control, states[:, step + 1])
            known &= good
    return known, outputs, norm, deviation


def _clipped(
    steering: Steering,
    errors: ErrorSet,
    control: FloatArray,
    limits: tuple[FloatArray, FloatArray],
) -> tuple[Steering, FloatArray]:
    """Return what is left of a control by its limits, and a bound of |u - u_d|."""
    reach = errors.support(steering.gain) + steering.radius
    middle = control + steering.offset
    slack = 2.0**-48 * (np.abs(control) + np.abs(steering.offset))
    beyond = np.maximum(middle + reach - limits[1], limits[0] - middle + reach)
    taken = np.maximum(beyond + slack, 0.0)
    deviation = np.abs(steering.offset) + reach + slack
    return Steering(steering.gain, steering.offset, steering.radius + taken), deviation


def curved(system: System, period: float, states: FloatArray, controls: FloatArray) -> BoolArray:
    """Return which states and controls the map of a hold is not affine in, shape (n + m,).

    It is looked at beside a few places of plans (p, N + 1, n) and (p, N, m), where nothing vanishes
    by chance.
    """
    both = np.concatenate([states[:, :-1], controls], axis=-1)
    place = both.reshape(-1, both.shape[-1])
    place = place[np.linspace(0, len(place) - 1, _PLACES).astype(int)]
    place = place + np.random.default_rng(0).uniform(0.01, 0.1, place.shape)
    count = place.shape[1]
    kept = monomials(count, 0, 0)
    numbers = []
    for index in range(count):
        parts = np.zeros((kept.count, len(place)))
        parts[0] = place[:, index]
        parts[1 + index] = 1e-3 * (1.0 + np.abs(place[:, index]))
        numbers.append(TaylorModel(kept, parts, np.zeros(len(place))))
    n = system.state_dim
    ended = rk4_hold(system, numbers[:n], numbers[n:], [0.0] * n, period, functions)
    bent = kept.exponents[kept.of_degree(2)]
    found = np.zeros(count, bool)
    for one in ended:
        seen = np.any(one.parts[kept.of_degree(2)] != 0.0, axis=1)
        found |= np.any(bent[seen] > 0, axis=0)
    # An ellipsoid of no coordinates would be a case of its own.
    found[0] |= not found.any()
    return found


def _checked(states: FloatArray, controls: FloatArray, n: int, m: int) -> tuple[int, int]:
    if states.ndim != 3 or states.shape[2] != n or states.shape[1] < 2:
        raise ValueError(f"states of shape {states.shape} must be (p, N + 1, {n})")
    plans, steps = states.shape[0], states.shape[1] - 1
    _check_shape("controls", controls, (plans, steps, m))
    for name, array in (("states", states), ("controls", controls)):
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name} must be finite: leave out plans that are not solved")
    return plans, steps


def _check_shape(name: str, array: FloatArray | BoolArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name}={shown(array)} of shape {array.shape} must be of shape {shape}")
