"""What the turn of a body does within a hold, where its wrench is held in the body's axes.

The wrench is made for the heading in the middle of the hold. The environment's Runge-Kutta stages
meet the headings

    delta_i = (s_i - h/2) omega + (b_i - h^2/8) a_phi + s_i d_phi + b_i d_omega

beside that one, so that position and velocity at the end are off by the sum of (R(delta_i) - I) a
over the weights of the stages, R(delta) a turn by delta. Its part that is linear in d_phi and
d_omega shares the norm of d with the push in the plane; the rest is bounded by the bounds of omega,
of a_phi and of the acceleration a.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import Interval, exact
from lagros_envs.tasks.spacecraft.world import SUBSTEPS
from lagros_policies.contraction.axis_response import SUM, size_of, stacked


@dataclass(frozen=True)
class _Stages:
    """The Runge-Kutta stages of one control step, each attribute of shape (stages,).

    Attributes:
        time: s_i, what d_phi and omega turn the body by at the stage [s].
        square: b_i, likewise a_phi and d_omega [s^2].
        speed: Weight of the stage's acceleration in the velocity at the end [s].
        place: Likewise in the position [s^2].
    """

    time: Interval
    square: Interval
    speed: Interval
    place: Interval


def _stages(period: float) -> _Stages:
    """Return the stages of `SUBSTEPS` Runge-Kutta steps in a hold."""
    step = exact(period) / float(SUBSTEPS)
    half = step * 0.5
    rows: list[tuple[Interval, ...]] = []
    for index in range(SUBSTEPS):
        begun, left = step * float(index), step * float(SUBSTEPS - 1 - index)
        before = begun * begun * 0.5
        times = begun, begun + half, begun + half, begun + step
        squares = (
            before,
            before + half * begun,
            before + half * begun + half * half,
            before + step * begun + step * step * 0.5,
        )
        for time, square, share, own in zip(
            times, squares, (1, 2, 2, 1), (1, 1, 1, 0), strict=True
        ):
            speed = step * (share / 1.0) / 6.0
            rows.append((time, square, speed, step * step * float(own) / 6.0 + left * speed))
    return _Stages(*(stacked(column) for column in zip(*rows, strict=True)))


def _total(values: Interval) -> Interval:
    """Enclose the sums over the last axis."""
    total = values[..., 0]
    for index in range(1, values.shape[-1]):
        total = total + values[..., index]
    return total


@dataclass(frozen=True)
class Turned:
    """What the turn of a body in a hold does, per unit of its acceleration.

    Attributes:
        stages: The stages.
        period: h [s].
        each: |weight of every stage|, shape (q, lags, stages).
        spin, rate, by_heading, by_spin: |sum of the weights by what turns the body|, (q, lags).
    """

    stages: _Stages
    period: float
    each: FloatArray
    spin: FloatArray
    rate: FloatArray
    by_heading: FloatArray
    by_spin: FloatArray

    def angles(self, bound: float, angles: FloatArray, beside: float) -> FloatArray:
        """Bound |delta_i| at every stage, shape (stages,) [rad]."""
        h, stages = exact(self.period), self.stages
        drift = np.hypot(size_of(stages.time), size_of(stages.square)) * bound
        value: FloatArray = (
            size_of(stages.time - h * 0.5) * angles[1]
            + size_of(stages.square - h * h / 8.0) * angles[2]
            + drift
            + beside
        ) * (1.0 + SUM)
        return value

    def come(
        self,
        pushed: FloatArray,
        acceleration: FloatArray,
        bound: float,
        angles: FloatArray,
        delta: FloatArray,
        beside: float,
    ) -> FloatArray:
        """Bound what comes in at each lag from d and from the turn, shape (n, q, lags)."""
        force = acceleration[:, None, None]
        shared = np.hypot(self.by_heading, self.by_spin)
        curved = self.each @ (0.5 * delta**2 + delta**3 / 6.0)
        rest = self.spin * angles[1] + self.rate * angles[2] + curved + self.each.sum(-1) * beside
        value: FloatArray = (bound * np.hypot(pushed, force * shared) + force * rest) * (1.0 + SUM)
        return value


def turned(rows: FloatArray, period: float) -> Turned:
    """Weigh the stages by rows (q, lags, 2)."""
    stages, h = _stages(period), exact(period)
    place, speed = exact(rows[..., :1]), exact(rows[..., 1:])
    weight = place * stages.place + speed * stages.speed
    by = (
        stages.time - h * 0.5,
        stages.square - h * h / 8.0,
        stages.time,
        stages.square,
    )
    return Turned(stages, period, size_of(weight), *(size_of(_total(weight * one)) for one in by))
