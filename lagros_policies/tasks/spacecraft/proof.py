"""Proof of the spacecraft's contraction for all states, in exact rational arithmetic.

Every double is a fraction, so nothing is rounded but exp(-2 alpha h), which is bounded by its
alternating series. Two facts carry the proof:

- **B reaches every acceleration, equally at every heading.** B(phi) is affine in cos phi and
  sin phi, so that B B' is a trigonometric polynomial of degree two in the heading. One that is
  constant at five headings is constant, and five headings have rational sines and cosines.
- **The condition is one number.** Since B reaches the velocities and nothing else, the terms of
  the heading and of u_d in A(x, x_d, u_d) are reached by B too and Finsler's lemma removes them:
  each axis is a double integrator, with one direction that its control does not reach.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.physics import HEADING, VELOCITY_X, Spacecraft, check_spacecraft
from lagros_policies.contraction.axis_gain import AxisGain
from lagros_policies.contraction.double_integrator import AxisMetric
from lagros_policies.contraction.statement import Statement, at_most

# The condition of an optimal metric is an equality, which rounding may miss by one unit in the last
# place; it is proved for a rate that is less by this share.
_SHORTFALL = Fraction(1, 10**9)
# Half angles' tangents of the five headings.
_TANGENTS = (Fraction(0), Fraction(1), Fraction(-2), Fraction(1, 3), Fraction(-3, 4))
_AXES = 3
# Terms of the series of the exponential, for arguments up to one: the last is below 1e-25.
_TERMS = 26


@dataclass(frozen=True)
class AxisProof:
    """What was proved of one axis, for every state.

    Attributes:
        rate: alpha that was proved [1/s], the metric's own but for one part in 1e9.
        period: Hold [s]; 0 for a control at will.
        holds: Whether W is positive definite and contracts at that rate.
        condition: A bound of chi of W = [[1, q], [q, s]]; infinite if W is not positive definite.
    """

    rate: float
    period: float
    holds: bool
    condition: float


def control_square(body: Spacecraft) -> tuple[Fraction, Fraction, Fraction] | None:
    """Return the diagonal of the velocities' block of B B' if it is one at every heading.

    Returns:
        The diagonal, exactly; None if B B' depends on the heading, is not diagonal, reaches the
        positions, or the free motion is not uniform.

    Raises:
        TypeError: The body is no spacecraft.
    """
    check_spacecraft(body, "control_square")
    squares = [_square_at(body, tangent) for tangent in _TANGENTS]
    first = squares[0]
    if first is None or any(square != first for square in squares):
        return None
    diagonal = tuple(first[axis][axis] for axis in range(_AXES))
    mixed = [first[i][j] for i in range(_AXES) for j in range(_AXES) if i != j]
    if any(mixed) or not all(entry > 0 for entry in diagonal):
        return None
    return diagonal[0], diagonal[1], diagonal[2]


def prove_axis(metric: AxisMetric) -> AxisProof:
    """Prove the contraction of one axis in its metric.

    Args:
        metric: W = [[1, q], [q, s]], rate and period.
    """
    rate = Fraction(metric.rate) * (1 - _SHORTFALL)
    coupling, stiffness = Fraction(metric.coupling), Fraction(metric.stiffness)
    period = Fraction(metric.period)
    if period == 0:
        contracts = coupling + rate <= 0
    else:
        # N F W F' N' and N W N' for N = (1, -h/2), which the held control does not reach.
        share = 1 + period**2 * stiffness / 4
        decay = _exponential_below(2 * rate * period)
        contracts = share + period * coupling <= decay * (share - period * coupling)
    definite = stiffness > coupling**2
    condition = _condition_above(coupling, stiffness) if definite else float("inf")
    return AxisProof(float(rate), metric.period, bool(contracts and definite), condition)


def prove_gain(gain: AxisGain) -> bool:
    """Return whether K contracts its W over a hold for every e, exactly.

    With A = F + g K that is exp(-2 alpha h) W - A W A' >= 0, for alpha (1 - 1e-9).

    Args:
        gain: The gain, whose W and rate are taken as they are written.
    """
    h, k = Fraction(gain.period), [Fraction(entry) for entry in gain.gain.tolist()]
    dual = [[Fraction(entry) for entry in row] for row in gain.dual.tolist()]
    push = (h * h / 2, h)
    step = [[1 + push[0] * k[0], h + push[0] * k[1]], [push[1] * k[0], 1 + push[1] * k[1]]]
    decay = _exponential_below(2 * Fraction(gain.rate) * (1 - _SHORTFALL) * h)
    left = [
        [
            decay * dual[i][j]
            - sum(step[i][k] * dual[k][m] * step[j][m] for k in range(2) for m in range(2))
            for j in range(2)
        ]
        for i in range(2)
    ]
    definite = dual[0][0] > 0 and dual[0][0] * dual[1][1] > dual[0][1] * dual[1][0]
    symmetric = dual[0][1] == dual[1][0]
    kept = min(left[0][0], left[1][1]) >= 0 and left[0][0] * left[1][1] >= left[0][1] * left[1][0]
    return bool(gain.rate > 0.0 and symmetric and definite and kept)


def prove_spacecraft(
    plane: AxisMetric, turning: AxisMetric | None = None, body: Spacecraft | None = None
) -> list[Statement]:
    """Prove the spacecraft's contraction for all states.

    Args:
        plane: Metric of x and y.
        turning: Metric of the heading; that of the plane if left out.
        body: The spacecraft; the paper's if left out.

    Returns:
        The statements, of kind "proved".
    """
    start = time.monotonic()
    square = control_square(body or Spacecraft())
    text = "B B' is not shown to be the same diagonal at every heading"
    if square is not None:
        entries = ", ".join(f"{float(entry):g}" for entry in square)
        text = (
            f"B B' = diag(0, 0, 0, {entries}) at every heading: for every state, x_d and u_d the "
            "error of each axis is a double integrator driven by the control"
        )
    statements = [Statement(text, "proved", square is not None, time.monotonic() - start)]
    for name, metric in (("x and y", plane), ("heading", turning or plane)):
        start = time.monotonic()
        proof = prove_axis(metric)
        when = (
            f"for an acceleration held for {proof.period:g} s V falls from instant to instant by "
            f"exp(-2 alpha h)"
            if proof.period > 0.0
            else "dV/dt <= -2 alpha V"
        )
        text = (
            f"{name}: some control makes V contract for all states, {when} with alpha = "
            f"{metric.rate:g} (1 - 1e-9) 1/s; W is positive definite with chi <= "
            f"{at_most(proof.condition, 6)}"
        )
        seconds = time.monotonic() - start
        holds = proof.holds and square is not None
        statements.append(Statement(text, "proved", holds, seconds))
    return statements


def contracts_at_will(
    dual: FloatArray, rate: float, weight: float, gain: Fraction, push: float
) -> bool:
    """Return whether (14) is shown for the six states, in the numbers as they are written.

    With W = [[a, q], [q, s]] for every axis and C the derivative of the acceleration by the
    heading, ||C|| <= c, the left side of (14), with 2 alpha W brought over, has the blocks
    P = 2 (q + alpha a) I, Q = (s + 2 alpha q) I + a C and R = 2 alpha s I + q (C + C') - 2 nu g:
    negative definite by a Schur complement if P is and

        2 nu g > 2 alpha s + 2 |q| c + (|s + 2 alpha q| + a c)^2 / (-2 (q + alpha a)).

    Args:
        dual: W, shape (2, 2).
        rate: alpha [1/s].
        weight: nu.
        gain: The least entry g of B B'.
        push: c, a bound of the acceleration of u_d at every heading.
    """
    alpha, bound = Fraction(rate), Fraction(push)
    first, coupling, stiffness = _entries(dual)
    room = -2 * (coupling + alpha * first)
    if room <= 0 or first <= 0:
        return False
    mixed = abs(stiffness + 2 * alpha * coupling) + first * bound
    size = 2 * alpha * stiffness + 2 * abs(coupling) * bound + mixed**2 / room
    return 2 * Fraction(weight) * gain > size


def lies_between(dual: FloatArray, low: Fraction, high: Fraction) -> bool:
    """Return whether low I <= W <= high I, exactly, for a symmetric W of shape (2, 2)."""
    first, coupling, stiffness = _entries(dual)

    def semidefinite(one: Fraction, other: Fraction) -> bool:
        return one >= 0 and other >= 0 and one * other >= coupling**2

    return semidefinite(first - low, stiffness - low) and semidefinite(
        high - first, high - stiffness
    )


def _entries(dual: FloatArray) -> tuple[Fraction, Fraction, Fraction]:
    first, coupling, stiffness = (Fraction(float(dual[i, j])) for i, j in ((0, 0), (0, 1), (1, 1)))
    return first, coupling, stiffness


class _Circle:
    """Sine and cosine of the one heading whose half angle has a rational tangent."""

    def __init__(self, tangent: Fraction) -> None:
        self.tangent = tangent

    def sin(self, _: Any) -> Fraction:
        return 2 * self.tangent / (1 + self.tangent**2)

    def cos(self, _: Any) -> Fraction:
        return (1 - self.tangent**2) / (1 + self.tangent**2)


def _square_at(body: Spacecraft, tangent: Fraction) -> list[list[Fraction]] | None:
    """Return the velocities' block of B B' at a heading, or None where B has another shape."""
    numbers: Any = {name: Fraction(getattr(body, name)) for name in ("mass", "inertia")}
    arms: Any = {name: Fraction(getattr(body, name)) for name in ("arm", "side_arm")}
    exact = replace(body, **numbers, **arms)
    circle = _Circle(tangent)
    speeds = [Fraction(3), Fraction(-5), Fraction(7)]
    state: list[Any] = [Fraction(0)] * (HEADING + 1) + speeds
    free = exact.derivative(state, [Fraction(0)] * body.control_dim, circle)
    if list(free) != [*speeds, 0, 0, 0]:
        return None
    columns = []
    for thruster in range(body.control_dim):
        control = [Fraction(int(index == thruster)) for index in range(body.control_dim)]
        pushed = exact.derivative(state, control, circle)
        column = [rate - rest for rate, rest in zip(pushed, free, strict=True)]
        if any(column[:VELOCITY_X]):
            return None
        columns.append(column[VELOCITY_X:])
    return [
        [sum((column[i] * column[j] for column in columns), Fraction(0)) for j in range(_AXES)]
        for i in range(_AXES)
    ]


def _exponential_below(argument: Fraction) -> Fraction:
    """Return a fraction just below exp(-argument), for a positive argument."""
    halvings = 0
    while argument > 1:
        argument, halvings = argument / 2, halvings + 1
    total, term = Fraction(1), Fraction(1)
    # An alternating series with falling terms that ends with a negative one lies below its limit.
    for order in range(1, 2 * (_TERMS // 2)):
        term *= -argument / order
        total += term
    for _ in range(halvings):
        total = total**2
    return total


def _condition_above(coupling: Fraction, stiffness: Fraction) -> float:
    """Return a double that is no less than the condition number of W, and little more."""
    trace, determinant = 1 + stiffness, stiffness - coupling**2
    # chi + 1/chi + 2 = trace^2 / det, increasing in chi: raise a guess until it is no less.
    size = float(trace**2 / determinant) - 2.0
    guess = Fraction(max(0.5 * (size + max(size * size - 4.0, 0.0) ** 0.5), 1.0))
    while (guess + 1) ** 2 * determinant < trace**2 * guess:
        guess *= 1 + Fraction(1, 2**40)
    return float(guess * (1 + Fraction(1, 2**50)))
