"""The invariant ellipsoid of the spacecraft's axes under a held control, for all states.

From instant to instant e' = F e + g v + w with w = int F(h - s) d(s) ds. By Cauchy and Schwarz
(p'w)^2 <= p'S p with S = d_bar^2 h int F F' ds, so that w lies in the ellipsoid of S. The ellipsoid
of W is kept, e'W^-1 e <= 1, by v = K e if for some tau in (0, 1)

    (F + g K) W (F + g K)' / (1 - tau) + S / tau <= W.

Such a K exists if the condition holds along N = (1, -h/2), which g does not reach, and W > S / tau.
With W = [[a, b], [b, c]] that is one linear inequality, met with equality here,

    h (2 - tau) b = -tau (a + h^2 c / 4) - (1 - tau) N S N' / tau,

and a and c are free. Axes share one W: the sum of their e'W^-1 e stays below one, for a d_bar that
bounds the disturbance of all of them together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_positive
from lagros_policies.contraction.double_integrator import flow

# W is enlarged by this share, so that the exact proof has room for its rounding.
_ROOM = 1e-9


@dataclass(frozen=True)
class AxisEllipsoid:
    """An ellipsoid e'W^-1 e <= 1 of the error (position, velocity) that a held v = K e keeps.

    Attributes:
        dual: W, shape (2, 2), for d_bar = 1; it grows with the square of d_bar.
        gain: K, shape (2,) [1/s^2, 1/s].
        share: tau.
        period: h [s].
    """

    dual: FloatArray
    gain: FloatArray
    share: float
    period: float

    @property
    def position_at_instants(self) -> float:
        """The bound of the position error at the control instants, per unit of d_bar [m]."""
        return math.sqrt(float(self.dual[0, 0]))

    @property
    def position(self) -> float:
        """The bound of the position error at all times, per unit of d_bar [m].

        Between instants the position differs from the straight line between its ends by h^2/8 of
        |K e| and by (h/2 + h^2/8) d_bar.
        """
        h = self.period
        acceleration = math.sqrt(float(self.gain @ self.dual @ self.gain))
        return self.position_at_instants + h * h / 8.0 * acceleration + h / 2.0 + h * h / 8.0

    @property
    def state(self) -> float:
        """The bound of ||e|| at the control instants, per unit of d_bar."""
        return math.sqrt(float(np.linalg.eigvalsh(self.dual)[-1]))


def design_axis_ellipsoid(
    period: float = 0.1, objective: Literal["state", "position"] = "position"
) -> AxisEllipsoid:
    """Return the least ellipsoid.

    Args:
        period: h [s].
        objective: What is to be least: lambda_max(W), or the position's entry of W.

    Raises:
        ValueError: The period is not positive.
    """
    from scipy.optimize import minimize

    check_positive("period", period)

    def size(values: FloatArray) -> float:
        share = 1.0 / (1.0 + math.exp(-values[0]))
        dual = _least_dual(share, math.exp(values[1]), period)
        if dual is None:
            return 1e6
        return float(dual[0, 0] if objective == "position" else np.linalg.eigvalsh(dual)[-1])

    starts = [(tau, c) for tau in (-3.0, -1.5) for c in (0.5, 2.5)]
    options = {"xatol": 1e-9, "fatol": 1e-12, "maxiter": 1000}
    answers = [
        minimize(size, np.array(start), method="Nelder-Mead", options=options) for start in starts
    ]
    best = min(answers, key=lambda answer: float(answer.fun))
    share = 1.0 / (1.0 + math.exp(-best.x[0]))
    dual = _least_dual(share, math.exp(best.x[1]), period)
    if dual is None:
        raise ValueError(f"no ellipsoid was found for period={period!r}")
    dual = dual * (1.0 + _ROOM)
    return AxisEllipsoid(dual, _gain(dual, share, period), share, period)


def prove_axis_ellipsoid(tube: AxisEllipsoid) -> bool:
    """Return whether the ellipsoid is kept, by exact rational arithmetic on its doubles."""
    h, tau = Fraction(tube.period), Fraction(tube.share)
    dual = [[Fraction(float(entry)) for entry in row] for row in tube.dual]
    gain = [Fraction(float(entry)) for entry in tube.gain]
    push = [h * h / 2, h]
    step = [
        [1 + push[0] * gain[0], h + push[0] * gain[1]],
        [push[1] * gain[0], 1 + push[1] * gain[1]],
    ]
    moved = [
        [
            sum(step[i][k] * dual[k][m] * step[j][m] for k in range(2) for m in range(2))
            for j in range(2)
        ]
        for i in range(2)
    ]
    source = [[h * (h + h**3 / 3), h * h * h / 2], [h * h * h / 2, h * h]]
    left = [
        [dual[i][j] - moved[i][j] / (1 - tau) - source[i][j] / tau for j in range(2)]
        for i in range(2)
    ]
    definite = dual[0][0] > 0 and dual[0][0] * dual[1][1] > dual[0][1] * dual[1][0]
    kept = left[0][0] >= 0 and left[0][0] * left[1][1] >= left[0][1] * left[1][0]
    symmetric = dual[0][1] == dual[1][0]
    return bool(0 < tau < 1 and symmetric and definite and kept and left[1][1] >= 0)


def worst_output(gain: FloatArray, period: float, output: FloatArray, steps: int = 3000) -> float:
    """Return the largest |c'e| at an instant under v = K e, over all d with ||d(t)|| <= 1.

    It is exact but for the tail: the sum over the past of int ||c'(F + g K)^k F(s)|| ds.

    Args:
        gain: K, shape (2,).
        period: h [s].
        output: c, shape (2,).
        steps: Instants of the past that count.
    """
    nodes, weights = np.polynomial.legendre.leggauss(8)
    flows = np.stack([flow(0.5 * period * (node + 1.0)) for node in nodes])
    step = flow(period) + np.outer([0.5 * period**2, period], gain)
    row, total = np.asarray(output, dtype=np.float64), 0.0
    for _ in range(steps):
        total += float(0.5 * period * weights @ np.linalg.norm(row @ flows, axis=-1))
        row = row @ step
    return total


def source_of(period: float) -> FloatArray:
    """Return S for d_bar = 1, shape (2, 2)."""
    h = period
    return h * np.array([[h + h**3 / 3.0, h * h / 2.0], [h * h / 2.0, h]])


def _least_dual(share: float, velocity: float, period: float) -> FloatArray | None:
    """Return the W of least a for tau and c, or None if there is none: b^2 = ... is a quadratic."""
    h = period
    source = source_of(h) / share
    across = np.array([1.0, -0.5 * h])
    scale = h * (2.0 - share)
    slope = -share / scale
    rest = (
        -(share * h * h * velocity / 4.0 + (1.0 - share) * float(across @ source @ across)) / scale
    )
    room = velocity - source[1, 1]
    if room <= 0.0:
        return None
    # (a - S11) room = (slope a + rest - S12)^2, the smaller root with a > S11.
    shift = rest - source[0, 1]
    quadratic = [slope**2, 2.0 * slope * shift - room, shift**2 + source[0, 0] * room]
    under = quadratic[1] ** 2 - 4.0 * quadratic[0] * quadratic[2]
    if under <= 0.0:
        return None
    a = (-quadratic[1] - math.sqrt(under)) / (2.0 * quadratic[0]) * (1.0 + _ROOM)
    if a <= source[0, 0]:
        return None
    b = slope * a + rest
    return np.array([[a, b], [b, velocity]])


def _gain(dual: FloatArray, share: float, period: float) -> FloatArray:
    """Return the K that brings e nearest to zero in the metric of W - S / tau."""
    matrix = np.linalg.inv(dual - source_of(period) / share)
    push = np.array([0.5 * period**2, period])
    pull = push @ matrix
    gain: FloatArray = -(pull @ flow(period)) / float(pull @ push)
    return gain
