"""Disturbances of worlds side by side, drawn as their episodes go on instead of in advance.

An episode with a stated seed draws its whole disturbance at reset, from a stream of its own. An
episode that begins without one has no seed to answer to, and may end after a few steps: it draws
from a generator that all worlds share, for each step what that step needs.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.balls import INSIDE
from lagros_envs.disturbances import (
    GUST_CORRELATION_TIME,
    GUST_SPREAD,
    SINUSOID_RATES,
    Disturbance,
    switching_steps,
)

# Numbers of draws in a row, where there are fewer worlds: a call costs as much as a hundred draws.
_BLOCK = 64
# In place of the squared length of a vector that is zero.
_TINY = float(np.finfo(np.float64).tiny)


class StepwiseDisturbance:
    """Draws d of worlds side by side, by the laws of `disturbances.Disturbance`.

    A larger bound scales the same realisation. Every step draws for all worlds, so that what a
    world meets does not depend on how long the episodes of the others last; only what `constant`,
    `sinusoid` and `gust` begin with is drawn when an episode begins.

    Arrays have the coordinate first, (n, worlds).

    Args:
        disturbance: Kind, bound and channels. For a feedback kind a step gives the direction of the
            episode, a unit vector.
        worlds: Number of worlds.
        period: Control period [s].
    """

    def __init__(self, disturbance: Disturbance, worlds: int, period: float) -> None:
        """Begin with nothing drawn; `begin` comes before `step`."""
        feedback = disturbance.is_feedback
        self._kind = "constant" if feedback else str(disturbance.kind)
        self._bound = 1.0 if feedback else disturbance.bound
        self._disturbed = np.flatnonzero(disturbance.channels)
        self._all = self._disturbed.size == len(disturbance.channels)
        self._size = len(disturbance.channels), worlds
        shape = self._disturbed.size, worlds
        self._count = max(1, _BLOCK // worlds)
        self._period = period
        # What a world keeps: a direction, or the gust as it is now.
        self._kept = np.zeros(shape)
        self._rate, self._phase = np.zeros(worlds), np.zeros(worlds)
        # A realisation of a kind that looks at nothing, some steps in advance.
        self._block: FloatArray = np.zeros((0, *shape))
        self._next = 0
        self._source: np.random.Generator | None = None

    def begin(self, worlds: IntArray, rng: np.random.Generator) -> None:
        """Draw what the episodes of these worlds begin with, from the generator of all."""
        if self._kind in ("none", "uniform", "sphere", "switching"):
            return
        normals = rng.standard_normal((self._disturbed.size, worlds.size))
        if self._kind == "gust":
            # The stationary law, as at the beginning of every realisation.
            self._kept[:, worlds] = self._spread * normals
            return
        self._kept[:, worlds] = _onto_sphere(normals)
        if self._kind == "sinusoid":
            self._rate[worlds] = rng.uniform(*SINUSOID_RATES, worlds.size)
            self._phase[worlds] = rng.uniform(0.0, 2.0 * math.pi, worlds.size)

    def step(self, steps: IntArray | int, rng: np.random.Generator) -> FloatArray:
        """Draw d of one control step.

        Args:
            steps: How many steps the episode of each world has behind it, shape (worlds,).
            rng: The generator of all; with another one than before all is drawn anew.

        Returns:
            Shape (n, worlds), of norm at most the bound; not written to again.
        """
        return self._scaled(self._unit(steps, rng))

    @property
    def _spread(self) -> float:
        return GUST_SPREAD / math.sqrt(self._disturbed.size)

    def _unit(self, steps: IntArray | int, rng: np.random.Generator) -> FloatArray:
        """Return d of this step in the unit ball, on the disturbed channels."""
        match self._kind:
            case "uniform" | "sphere":
                return self._drawn(rng)
            case "sinusoid":
                times = self._period * steps
                wave: FloatArray = self._kept * np.sin(self._rate * times + self._phase)
                return wave
            case "gust":
                now = self._kept
                # Exact discretisation of an Ornstein-Uhlenbeck process.
                decay = math.exp(-self._period / GUST_CORRELATION_TIME)
                fresh = math.sqrt(1.0 - decay * decay) * self._spread
                self._kept = decay * now + fresh * self._drawn(rng)
                lengths = np.sqrt(np.add.reduce(now * now, axis=0))
                gust: FloatArray = now * (INSIDE / np.maximum(lengths, 1.0))
                return gust
            case "switching":
                due = np.asarray(steps) % switching_steps(self._period) == 0
                self._kept = np.where(due, self._drawn(rng), self._kept)
                return self._kept
            case _:
                return self._kept

    def _drawn(self, rng: np.random.Generator) -> FloatArray:
        """Return the next numbers of a kind that draws in every step."""
        if self._next == len(self._block) or rng is not self._source:
            self._source = rng
            self._block = _LAWS[self._kind](rng, (self._count, *self._kept.shape))
            self._next = 0
        self._next += 1
        numbers: FloatArray = self._block[self._next - 1]
        return numbers

    def _scaled(self, unit: FloatArray) -> FloatArray:
        if self._all:
            scaled: FloatArray = self._bound * unit
            return scaled
        push = np.zeros(self._size)
        push[self._disturbed] = self._bound * unit
        return push


def _onto_sphere(normals: FloatArray) -> FloatArray:
    """Scale the columns (..., n, worlds) to length one."""
    squares = np.add.reduce(normals * normals, axis=-2, keepdims=True)
    unit: FloatArray = normals * (INSIDE / np.sqrt(np.maximum(squares, _TINY)))
    return unit


def _sphere(rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
    return _onto_sphere(rng.standard_normal(shape))


def _ball(rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
    """Draw columns that are uniform in the unit ball.

    A point of the sphere in n + 2 dimensions, seen in n of them, is uniform in their ball. Two
    normals more are only needed for their squares, which add up to twice an exponential.
    """
    normals = rng.standard_normal(shape)
    squares = np.add.reduce(normals * normals, axis=-2, keepdims=True)
    squares += 2.0 * rng.standard_exponential(squares.shape)
    normals *= INSIDE / np.sqrt(np.maximum(squares, _TINY))
    return normals


def _normals(rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
    return rng.standard_normal(shape)


_LAWS: dict[str, Any] = {
    "uniform": _ball,
    "sphere": _sphere,
    "gust": _normals,
    "switching": _sphere,
}
