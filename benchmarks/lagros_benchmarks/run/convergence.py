"""How errors die out: their area, and the tightest exponential envelope C e^(-lambda t) over them.

These are the measures of the papers on learned contraction metrics (C3M: Sun, Jha and Fan, CoRL
2020, section 5, with code at github.com/sundw2014/C3M; the envelope as in
github.com/Mgineer117/contractionRL). With e(t) = ||x(t) - x_d(t)|| of an episode that begins beside
its plan, the normalised error is e(t) / e(0). Of several episodes

1. the one whose normalised error has the largest peak decides the overshoot: of all C >= 1 and
   lambda >= 0 with e(t) / e(0) <= C e^(-lambda t) on [0, T], those are taken whose envelope has the
   least area, the integral of C e^(-lambda t) from 0 to T;
2. with that C, each episode has the convergence rate lambda = min_t (ln C - ln(e(t) / e(0))) / t.

The codes search C on a grid; the area is convex in lambda, so that it is minimised here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import FloatArray

_HALVINGS = 200  # of an interval of rates: beyond the last digit
# Errors that are smaller, in units of the first, are no longer told apart.
_LEAST = 1e-12


class Envelope(NamedTuple):
    """The exponential C e^(-lambda t).

    Attributes:
        overshoot: C, at least 1.
        rate: lambda [1/s], at least 0.
    """

    overshoot: float
    rate: float

    def area(self, duration: float) -> float:
        """Return its integral from 0 to a time [s]."""
        if self.rate == 0.0:
            return self.overshoot * duration
        return self.overshoot * -math.expm1(-self.rate * duration) / self.rate


def error_areas(errors: FloatArray, period: float) -> FloatArray:
    """Return the integrals over time of errors at control instants, by the trapezoidal rule.

    Args:
        errors: Shape (episodes, instants).
        period: Between two instants [s].

    Returns:
        Shape (episodes,), in the unit of the error times [s].
    """
    areas: FloatArray = period * (errors[:, 1:] + errors[:, :-1]).sum(axis=1) / 2.0
    return areas


def tightest_envelope(error: FloatArray, period: float) -> Envelope:
    """Return the envelope of least area over a normalised error; step 1 above.

    Args:
        error: At every control instant, shape (instants,); the first is 1.
        period: Between two instants [s].

    Raises:
        ValueError: There are fewer than two instants, or an error is not finite.
    """
    if len(error) < 2 or not np.isfinite(error).all():
        raise ValueError("an envelope needs an error that is finite at two instants or more")
    times: FloatArray = period * np.arange(len(error), dtype=np.float64)
    logs = np.log(np.maximum(error, _LEAST))
    duration = float(times[-1])
    # ln C(lambda) = max_t (ln e + lambda t) and ln of the area of e^(-lambda t) are convex: the
    # least sum is where its slope, which grows, passes zero. Where a later instant than the first
    # binds and lambda > 1 / period, it has.
    low, high = 0.0, 1.0 / period + float(np.max((logs[0] - logs[1:]) / times[1:]).clip(0.0))
    if _slope(low, logs, times, duration) >= 0.0:
        high = low
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if _slope(middle, logs, times, duration) < 0.0:
            low = middle
        else:
            high = middle
    bound = float(np.max(logs + high * times))
    return Envelope(max(math.exp(bound), 1.0), high)


def _slope(rate: float, logs: FloatArray, times: FloatArray, duration: float) -> float:
    """Return d/d lambda of the logarithm of the area of the least envelope of that rate."""
    binding = float(times[np.argmax(logs + rate * times)])
    product = rate * duration
    if product < 1e-6:  # where the difference below would cancel
        return binding - duration * (0.5 - product / 12.0)
    return binding - (
        1.0 / rate - duration / math.expm1(product) if product < 700.0 else 1.0 / rate
    )


def convergence_rates(errors: FloatArray, overshoot: float, period: float) -> FloatArray:
    """Return the largest rate of each normalised error under one overshoot; step 2 above.

    Args:
        errors: Shape (episodes, instants); the first of each is 1.
        overshoot: C.
        period: Between two instants [s].

    Returns:
        lambda [1/s], shape (episodes,); 0 where no decaying envelope with that C holds.
    """
    times = period * np.arange(1, errors.shape[1])
    logs = np.log(np.maximum(errors[:, 1:], _LEAST))
    rates: FloatArray = np.maximum(((math.log(overshoot) - logs) / times).min(axis=1), 0.0)
    return rates
