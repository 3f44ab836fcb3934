"""Sums over the past of an axis under a held gain, which bound its outputs; rounded upwards.

From instant to instant e' = (F + g K) e + (what comes in). So c'e(t_k) is the sum over all lags j
of c'(F + g K)^j times what came in that long ago, and its bound the sum of the magnitudes. The
powers are computed in floats; what each step of that is off is enclosed, and counted against bounds
of e.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import Interval, exact
from lagros_policies.contraction.axis_gain import AxisGain

# Above the rounding of sums of at most some thousand numbers >= 0, relative.
SUM = 1e-12


def size_of(value: Interval) -> FloatArray:
    """Return the largest magnitude of each interval."""
    largest: FloatArray = np.maximum(np.abs(value.lower), np.abs(value.upper))
    return largest


def stacked(numbers: Sequence[Interval]) -> Interval:
    """Put intervals of one number each into an array, shape (n,)."""
    return Interval([one.lower for one in numbers], [one.upper for one in numbers])


class _Response:
    """c'(F + g K)^j for some outputs c and lags j, in floats, and what it is off.

    Attributes:
        rows: Shape (q, lags + 1, 2).
        off: Bounds of |row_j (F + g K) - row_{j+1}| and, first, of |c - row_0|; the same shape.
    """

    def __init__(self, gain: AxisGain, outputs: Interval, lags: int) -> None:
        h = exact(gain.period)
        push = h * h * 0.5, h
        one, k = exact(np.ones(())), gain.gain
        entries = [one + push[0] * k[0], h + push[0] * k[1], push[1] * k[0], one + push[1] * k[1]]
        step = Interval(
            np.reshape([entry.lower for entry in entries], (2, 2)),
            np.reshape([entry.upper for entry in entries], (2, 2)),
        )
        middle = step.midpoint
        rows = [outputs.midpoint]
        for _ in range(lags):
            rows.append(rows[-1] @ middle)
        self.rows = np.stack(rows, axis=1)
        moved = _product(self.rows[:, :-1], step) - self.rows[:, 1:]
        first = (outputs - self.rows[:, 0])[:, None]
        self.off = np.concatenate([size_of(first), size_of(moved)], axis=1)


def _product(rows: FloatArray, step: Interval) -> Interval:
    """Enclose rows (..., 2) times a matrix (2, 2)."""
    return rows[..., :1] * step[0] + rows[..., 1:] * step[1]


class AxisPast:
    """What comes in at each lag of an axis' past, by the output that it reaches.

    Attributes:
        response: The powers.
        push: Of d in position and velocity, shape (q, lags).
        control: Of an acceleration, shape (q, lags).
        place, speed: Of a step's shortfall, shape (q, lags).
    """

    def __init__(self, gain: AxisGain, outputs: Interval, lags: int) -> None:
        self.response = _Response(gain, outputs, lags)
        rows = self.response.rows[:, :lags]
        h = exact(gain.period)
        first, second = h * rows[..., 0], h * h * 0.5 * rows[..., 0] + h * rows[..., 1]
        self.push = np.hypot(size_of(first), size_of(second)) * (1.0 + SUM)
        self.control = size_of(second)
        self.place, self.speed = np.abs(rows[..., 0]), np.abs(rows[..., 1])

    def bounds(self, come: FloatArray, start: FloatArray, sizes: FloatArray) -> FloatArray:
        """Return the bounds of the outputs at every instant, shape (..., q, lags + 1).

        Args:
            come: What comes in at each lag, shape (..., q, lags).
            start: Bounds of e(0), shape (..., 2).
            sizes: Bounds of e at all times, shape (..., 2).
        """
        rows, off = self.response.rows, self.response.off
        lost = np.einsum("qjx,...x->...qj", off, sizes)
        gone = np.cumsum(come + lost[..., 1:], axis=-1)
        kept = np.einsum("qjx,...x->...qj", np.abs(rows), start)
        total = kept + lost[..., :1]
        total[..., 1:] += gone
        bounds: FloatArray = total * (1.0 + SUM)
        return bounds
