"""Proof of the contraction condition on continuous boxes, by interval arithmetic and bisection.

Theorem 2 asks, with A = A(x, x_d, u_d) of `state_dependent_coefficient`, for

    -dW_bar/dt(x) + 2 sym(A W_bar(x)) - 2 nu B(x) B(x)' + 2 alpha W_bar(x) < 0.             (*)

A is the mean of J(y, u_d) = d(f + B u_d)/dx(y) over the segment from x_d to x, and (*) is affine in
A. So it is enough, and this is what is proved, that for every x of the box, every point y of the
box whose angle and rate differ from those of x by the errors allowed, and every force of the box

    -dW_bar/dt(x) + 2 sym(J(y, u_d) W_bar(x)) - 2 nu B(x) B(x)' + 2 alpha W_bar(x) < 0.    (**)

The box is convex, so y runs over the whole segment and (*) follows by averaging, for a W_bar that
depends on the angle too. With errors of zero, y is x and (**) is the differential condition (of
infinitesimal displacements); for a W_bar that depends on x that alone does not imply (*).

Proved is the condition on the derivative, for the coefficients of the motion as the doubles that
the code computes with. It says nothing of the hold of the control between its instants, nor of the
term by which a disturbance moves W_bar.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import System, control_matrix, jacobian
from lagros_envs.dynamics.cartpole import ANGLE, ANGULAR_RATE, VELOCITY
from lagros_policies.contraction.intervals import (
    Interval,
    exact,
    interval_jacobian,
    matmul,
    negative_definite,
    transpose,
)
from lagros_policies.contraction.metric import Metric

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Coordinates of the search: angle and rate of x, those of y less those of x, speed of y, force.
_COORDINATES = 6
_X_ANGLE, _X_RATE, _ANGLE_GAP, _RATE_GAP, _SPEED, _FORCE = range(_COORDINATES)
# Boxes of one pass: enough to hide NumPy's cost per call, few enough to stay in the cache.
_BATCH = 2000


@dataclass(frozen=True)
class ProofBox:
    """The continuous set on which the condition is proved, symmetric about the upright.

    The position enters neither the metric nor the motion and is free.

    Attributes:
        angle: Largest |theta| of x and x_d [rad].
        velocity: Largest |dp/dt| of x and x_d [m/s].
        angular_rate: Largest |dtheta/dt| of x and x_d [rad/s].
        force: Largest |u_d| [N].
        angle_error: Largest |theta - theta_d| [rad].
        angular_rate_error: Largest error of the rate [rad/s].

    Raises:
        ValueError: A bound is negative or not finite, or the angle is not below pi/2.
    """

    angle: float
    velocity: float
    angular_rate: float
    force: float
    angle_error: float = 0.0
    angular_rate_error: float = 0.0

    def __post_init__(self) -> None:
        """Check the bounds."""
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name}={value!r} must be finite and >= 0")
        if self.angle >= math.pi / 2:
            raise ValueError(f"angle={self.angle!r} must be below pi/2")

    def scaled(self, factor: float) -> ProofBox:
        """Return the box with every bound times a factor."""
        return replace(
            self, **{name: factor * getattr(self, name) for name in self.__dataclass_fields__}
        )


@dataclass(frozen=True)
class Violation:
    """A point at which interval arithmetic shows that (**) fails.

    Attributes:
        state: x, shape (4,).
        nominal: y, which may serve as x_d, shape (4,).
        control: u_d, shape (1,).
    """

    state: FloatArray
    nominal: FloatArray
    control: FloatArray


@dataclass(frozen=True)
class ContractionProof:
    """What the search for a proof came to.

    Attributes:
        box: The set asked about.
        contraction_rate: alpha [1/s].
        proved: Whether (**), and so (*), holds on the whole set.
        boxes: Small boxes examined.
        seconds: Time taken [s].
        violation: A point where the condition fails, or None.
        undecided: One small box left undecided, ends (2, 6) of [theta, dtheta/dt, theta_y - theta,
            their rates' difference, dp/dt of y, u_d]; None if proved or violated.
    """

    box: ProofBox
    contraction_rate: float
    proved: bool
    boxes: int
    seconds: float
    violation: Violation | None = None
    undecided: FloatArray | None = None


@dataclass(frozen=True)
class ProvedBounds:
    """Bounds that hold for every |theta| <= angle.

    Attributes:
        angle: Largest |theta| [rad].
        least: least I <= S W_bar S.
        largest: S W_bar S <= largest I.
        control_gain: b_bar, bound of ||B(x)||.
    """

    angle: float
    least: float
    largest: float
    control_gain: float

    @property
    def condition(self) -> float:
        """A bound of chi, the condition number in the units of the scaling S."""
        return math.nextafter(self.largest / self.least, math.inf)


def prove_contraction(
    system: System,
    metric: Metric,
    box: ProofBox,
    contraction_rate: float | None = None,
    *,
    most_boxes: int = 1_000_000,
    most_seconds: float = 60.0,
) -> ContractionProof:
    """Prove the condition of Theorem 2, equation (14), on a box, or find where it fails.

    Args:
        system: A cart-pole.
        metric: The metric.
        box: Where to prove it.
        contraction_rate: alpha [1/s]; None for that of the metric.
        most_boxes: Small boxes after which the search gives up.
        most_seconds: Time after which it gives up [s].

    Returns:
        The proof, or why there is none.
    """
    start = time.monotonic()
    rate = metric.contraction_rate if contraction_rate is None else contraction_rate
    metric = replace(metric, contraction_rate=rate)
    upper = np.array(
        [
            box.angle,
            box.angular_rate,
            min(box.angle_error, 2.0 * box.angle),
            min(box.angular_rate_error, 2.0 * box.angular_rate),
            box.velocity,
            box.force,
        ]
    )
    waiting = Interval(-upper[None], upper[None])
    seen = 0
    while len(waiting.lower):
        # The newest first: depth first finds a violation soon and keeps the list short.
        batch, rest = waiting[-_BATCH:], waiting[:-_BATCH]
        seen += len(batch.lower)
        left = ~_holds(system, metric, box, batch)
        batch = batch[left]
        violation = _violation(system, metric, box, batch)
        if violation is not None:
            return ContractionProof(
                box, rate, False, seen, time.monotonic() - start, violation=violation
            )
        late = time.monotonic() - start > most_seconds or seen > most_boxes
        if late and len(batch.lower) + len(rest.lower):
            some = batch if len(batch.lower) else rest
            ends = np.stack([some.lower[-1], some.upper[-1]])
            return ContractionProof(
                box, rate, False, seen, time.monotonic() - start, undecided=ends
            )
        low, high = _halves(batch, _effects(system, metric, box, batch))
        waiting = Interval(np.concatenate([rest.lower, low]), np.concatenate([rest.upper, high]))
    return ContractionProof(box, rate, True, seen, time.monotonic() - start)


def largest_proved(
    system: System,
    metric: Metric,
    box: ProofBox,
    contraction_rate: float | None = None,
    *,
    rounds: int = 8,
    most_seconds: float = 60.0,
) -> ContractionProof:
    """Find the largest multiple, at most one, of a box on which the condition can be proved.

    Args:
        system: A cart-pole.
        metric: The metric.
        box: The shape, and the largest size, of the box.
        contraction_rate: alpha [1/s]; None for that of the metric.
        rounds: Halvings of the range of the multiple.
        most_seconds: Time for all of it [s]; each attempt gets an equal share.

    Returns:
        The proof for the largest box that was proved; if none was, the last attempt.
    """
    share = most_seconds / (rounds + 1)
    best = prove_contraction(system, metric, box, contraction_rate, most_seconds=share)
    if best.proved:
        return best
    low, high = 0.0, 1.0
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        trial = prove_contraction(
            system, metric, box.scaled(middle), contraction_rate, most_seconds=share
        )
        low, high = (middle, high) if trial.proved else (low, middle)
        if trial.proved or not best.proved:
            best = trial
    return best


def prove_bounds(system: System, metric: Metric, angle: float, cells: int = 2000) -> ProvedBounds:
    """Enclose the eigenvalues of S W_bar S and the norm of B for every |theta| <= angle.

    Args:
        system: A cart-pole.
        metric: The metric.
        angle: Largest |theta| [rad].
        cells: Equal intervals of the angle.

    Returns:
        The bounds.

    Raises:
        ValueError: W_bar cannot be shown to be positive definite with so many cells.
    """
    ends = np.linspace(-angle, angle, cells + 1)
    thetas = Interval(ends[:-1], ends[1:])
    scale = metric.scaling[:, None] * metric.scaling[None, :]
    # S_i S_j rounds; as an interval it is enclosed.
    scaled = _dual(metric, thetas)[0] * exact(metric.scaling[:, None]) * metric.scaling[None, :]
    values = np.linalg.eigvalsh(scaled.midpoint)
    # Weyl: the eigenvalues move by no more than the largest row sum of the radii.
    slack = float(scaled.radius.sum(axis=-1).max()) + 1e-9 * float(np.abs(scale).max())
    least, largest = float(values.min()) - slack, float(values.max()) + slack
    identity = np.eye(len(metric.scaling))
    proved = negative_definite(scaled - largest * identity) & negative_definite(
        least * identity - scaled
    )
    if least <= 0.0 or not np.all(proved):
        raise ValueError(
            f"W_bar is not shown to be positive definite for |theta| <= {angle} with "
            f"cells={cells}: use more cells, or another metric"
        )
    states = np.zeros((cells, system.state_dim))
    low, high = states.copy(), states.copy()
    low[:, ANGLE], high[:, ANGLE] = thetas.lower, thetas.upper
    gain = interval_jacobian(system, Interval(low, high), exact([0.0] * system.control_dim))[1]
    # The Frobenius norm bounds the spectral norm, and is it for one control.
    squares = np.maximum(np.abs(gain.lower), np.abs(gain.upper)) ** 2
    norm = math.sqrt(float(squares.sum(axis=(-1, -2)).max())) * (1.0 + 1e-12)
    return ProvedBounds(angle, least, largest, norm)


def _holds(system: System, metric: Metric, box: ProofBox, boxes: Interval) -> BoolArray:
    """Return on which of the boxes (k, 6) the condition is proved, shape (k,)."""
    angle, rate = boxes[:, _X_ANGLE], boxes[:, _X_RATE]
    near_angle, empty = _clipped(angle + boxes[:, _ANGLE_GAP], box.angle)
    near_rate, outside = _clipped(rate + boxes[:, _RATE_GAP], box.angular_rate)
    x_low, x_high = np.zeros((2, len(boxes.lower), system.state_dim))
    x_low[:, ANGLE], x_high[:, ANGLE] = angle.lower, angle.upper
    y_low, y_high = x_low.copy(), x_high.copy()
    for place, part in (
        (ANGLE, near_angle),
        (ANGULAR_RATE, near_rate),
        (VELOCITY, boxes[:, _SPEED]),
    ):
        y_low[:, place], y_high[:, place] = part.lower, part.upper
    _, gain = interval_jacobian(system, Interval(x_low, x_high), exact(np.zeros(1)))
    dual, slope = _dual(metric, angle)
    constant = matmul(gain, transpose(gain)) * (-2.0 * metric.control_weight)
    constant = constant + dual * (2.0 * metric.contraction_rate)
    proved = np.ones(len(boxes.lower), dtype=bool)
    # (**) is affine in the force (the system is) and in the rate of x (y's is kept apart): it
    # holds on the box if it does at the four corners.
    for force in (boxes.lower[:, _FORCE], boxes.upper[:, _FORCE]):
        full, _ = interval_jacobian(system, Interval(y_low, y_high), exact(force[:, None]))
        product = matmul(full, dual)
        moving = product + transpose(product) + constant
        for speed in (rate.lower, rate.upper):
            proved &= negative_definite(moving - slope * speed[:, None, None])
    return proved | empty | outside


def _clipped(value: Interval, bound: float) -> tuple[Interval, BoolArray]:
    """Cut intervals to [-bound, bound]; say which have nothing in common with it."""
    low, high = np.maximum(value.lower, -bound), np.minimum(value.upper, bound)
    empty: BoolArray = low > high
    return Interval(np.where(empty, 0.0, low), np.where(empty, 0.0, high)), empty


def _dual(metric: Metric, angle: Interval) -> tuple[Interval, Interval]:
    """Enclose W_bar and dW_bar/dtheta over intervals of the angle, each (k, 4, 4).

    The polynomial is expanded about the cosine of the midpoint, itself by intervals: its
    coefficients are large and of both signs, and intervals would not see that they cancel.
    """
    centre = np.cos(angle.midpoint)[:, None, None]
    weights = exact(metric.coefficients)
    powers = [exact(np.ones_like(centre))]
    for _ in range(metric.degree):
        powers.append(powers[-1] * centre)
    shifted = []
    for order in range(metric.degree + 1):
        total = powers[0] * weights[order]
        for index in range(order + 1, metric.degree + 1):
            total = total + powers[index - order] * (weights[index] * float(comb(index, order)))
        shifted.append(total)
    gap = angle.cos()[:, None, None] - centre
    value, slope = shifted[-1], exact(np.zeros_like(centre)) * shifted[-1]
    for part in reversed(shifted[:-1]):
        slope = slope * gap + value
        value = value * gap + part
    return value, slope * -(angle.sin()[:, None, None])


def _points(box: ProofBox, places: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return x, y and u_d at points (..., 6) of the search, y moved into the box."""
    state = np.zeros((*places.shape[:-1], 4))
    state[..., ANGLE], state[..., ANGULAR_RATE] = places[..., _X_ANGLE], places[..., _X_RATE]
    state[..., VELOCITY] = places[..., _SPEED]
    nominal = state.copy()
    nominal[..., ANGLE] += places[..., _ANGLE_GAP]
    nominal[..., ANGULAR_RATE] += places[..., _RATE_GAP]
    nominal[..., ANGLE] = np.clip(nominal[..., ANGLE], -box.angle, box.angle)
    nominal[..., ANGULAR_RATE] = np.clip(
        nominal[..., ANGULAR_RATE], -box.angular_rate, box.angular_rate
    )
    return state, nominal, places[..., _FORCE, None]


def _condition(system: System, metric: Metric, box: ProofBox, places: FloatArray) -> FloatArray:
    """Return the left side of (**) in plain numbers at points (..., 6), shape (..., 4, 4)."""
    state, nominal, control = _points(box, places)
    slope, _ = jacobian(system, nominal, control)
    gain = control_matrix(system, state)
    dual = metric.dual(state)
    product = slope @ dual
    left: FloatArray = product + np.swapaxes(product, -1, -2) - metric.dual_rate(state)
    left -= 2.0 * metric.control_weight * gain @ np.swapaxes(gain, -1, -2)
    return left + 2.0 * metric.contraction_rate * dual


def _violation(system: System, metric: Metric, box: ProofBox, boxes: Interval) -> Violation | None:
    """Look for a failure at the midpoints, at either end of the force and of the rate."""
    middle = boxes.midpoint
    if not len(middle):
        return None
    places = np.stack([middle] * 4)
    places[:2, :, _FORCE], places[2:, :, _FORCE] = boxes.lower[:, _FORCE], boxes.upper[:, _FORCE]
    places[::2, :, _X_RATE] = boxes.lower[:, _X_RATE]
    places[1::2, :, _X_RATE] = boxes.upper[:, _X_RATE]
    places = places.reshape(-1, _COORDINATES)
    # Far from rounding, so that a number above zero is a failure and not an accident.
    values, vectors = np.linalg.eigh(_condition(system, metric, box, places))
    worst = int(np.argmax(values[:, -1]))
    if values[worst, -1] <= 0.0:
        return None
    state, nominal, control = _points(box, places[worst])
    return (
        Violation(state, nominal, control)
        if _fails(system, metric, state, nominal, control, vectors[worst, :, -1])
        else None
    )


def _fails(
    system: System,
    metric: Metric,
    state: FloatArray,
    nominal: FloatArray,
    control: FloatArray,
    direction: FloatArray,
) -> bool:
    """Show by intervals that the form (**) is positive in a direction."""
    slope, _ = interval_jacobian(system, exact(nominal), exact(control))
    _, gain = interval_jacobian(system, exact(state), exact(control))
    dual, dual_slope = _dual(metric, exact(state[ANGLE : ANGLE + 1]))
    product = matmul(slope, dual[0])
    left = product + transpose(product) - dual_slope[0] * float(state[ANGULAR_RATE])
    left = left + matmul(gain, transpose(gain)) * (-2.0 * metric.control_weight)
    left = left + dual[0] * (2.0 * metric.contraction_rate)
    form = matmul(matmul(exact(direction[None, :]), left), exact(direction[:, None]))
    return bool(form.lower[0, 0] > 0.0)


def _effects(system: System, metric: Metric, box: ProofBox, boxes: Interval) -> FloatArray:
    """Return how much each coordinate moves the condition across its width, shape (k, 6)."""
    middle, half = boxes.midpoint, 0.5 * (boxes.upper - boxes.lower)
    steps = half[:, None, :] * np.eye(_COORDINATES)
    ahead = _condition(system, metric, box, middle[:, None, :] + steps)
    behind = _condition(system, metric, box, middle[:, None, :] - steps)
    values, vectors = np.linalg.eigh(_condition(system, metric, box, middle))
    basis = (vectors / np.sqrt(np.maximum(-values, 1e-6))[:, None, :])[:, None]
    change = np.swapaxes(basis, -1, -2) @ (ahead - behind) @ basis
    effect: FloatArray = np.sqrt(np.sum(change**2, axis=(-1, -2)))
    # The corners take care of force and rate, unless nothing else is left to halve; a coordinate
    # that moves nothing in plain numbers may still widen the intervals.
    effect[:, _FORCE] *= 0.1
    effect[:, _X_RATE] *= 0.1
    return np.where(half > 0.0, effect + 1e-6 * half, -1.0)


def _halves(boxes: Interval, effects: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Halve each box across the coordinate of the largest effect; ends (2k, 6)."""
    rows = np.arange(len(boxes.lower))
    along = np.argmax(effects, axis=-1)
    cut = boxes.midpoint[rows, along]
    first_high, second_low = boxes.upper.copy(), boxes.lower.copy()
    first_high[rows, along] = cut
    second_low[rows, along] = cut
    return np.concatenate([boxes.lower, second_low]), np.concatenate([first_high, boxes.upper])
