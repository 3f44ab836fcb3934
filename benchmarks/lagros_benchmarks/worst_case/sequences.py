"""Bounded sequences of a disturbance: few numbers in, d/d_bar at every control step out.

Every parametrisation maps an unconstrained vector to a sequence in the unit ball, so that an
optimiser can move freely and the bound d_bar holds whatever it proposes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.balls import into_unit_ball, onto_unit_sphere
from lagros_envs.disturbances import Situation


@dataclass(frozen=True)
class Parametrisation:
    """A map from vectors to sequences in the unit ball, over pieces of the episode.

    Attributes:
        steps: Control steps of the episode.
        channels: Coordinates of d.
        pieces: Pieces of the episode.

    Raises:
        ValueError: There are more pieces than steps, or a number is below one.
    """

    steps: int
    channels: int
    pieces: int

    def __post_init__(self) -> None:
        if min(self.steps, self.channels, self.pieces) < 1 or self.pieces > self.steps:
            raise ValueError(
                f"steps={self.steps}, channels={self.channels} and pieces={self.pieces} must be "
                "at least 1, and pieces at most steps"
            )

    @property
    def dimension(self) -> int:
        """Number of parameters: one vector per piece."""
        return self.pieces * self.channels

    def sequences(self, points: FloatArray) -> FloatArray:
        """Return sequences (p, steps, channels) in the unit ball for points (p, dimension)."""
        raise NotImplementedError


class Segments(Parametrisation):
    """One direction per piece, of equal length but for rounding; every push has length one."""

    def sequences(self, points: FloatArray) -> FloatArray:
        """Return sequences; see `Parametrisation`."""
        rays = _unit(points.reshape(len(points), self.pieces, self.channels))
        piece = np.arange(self.steps) * self.pieces // self.steps
        return rays[:, piece]


class Knots(Parametrisation):
    """Vectors at the ends of the pieces, linear between them, shortened to length one."""

    @property
    def dimension(self) -> int:
        """One vector per knot."""
        return (self.pieces + 1) * self.channels

    def sequences(self, points: FloatArray) -> FloatArray:
        """Return sequences; see `Parametrisation`."""
        values = points.reshape(len(points), self.pieces + 1, self.channels)
        place = np.linspace(0.0, self.pieces, self.steps)
        left = np.minimum(place.astype(np.intp), self.pieces - 1)
        share = (place - left)[:, None]
        return into_unit_ball((1.0 - share) * values[:, left] + share * values[:, left + 1])


class Switching(Parametrisation):
    """One direction whose sign switches between the pieces, at free times: bang-bang."""

    @property
    def dimension(self) -> int:
        """The direction and the switching times."""
        return self.channels + self.pieces - 1

    def sequences(self, points: FloatArray) -> FloatArray:
        """Return sequences; see `Parametrisation`."""
        direction = _unit(points[:, : self.channels])
        # A logistic map keeps the times inside the episode without a bound for the optimiser.
        times = self.steps / (1.0 + np.exp(-np.clip(points[:, self.channels :], -30.0, 30.0)))
        passed = np.count_nonzero(np.arange(self.steps)[:, None] >= times[:, None, :], axis=-1)
        sign: FloatArray = 1.0 - 2.0 * (passed % 2)
        return np.asarray(sign[..., None] * direction[:, None, :])


PARAMETRISATIONS: dict[str, type[Parametrisation]] = {
    "segments": Segments,
    "knots": Knots,
    "switching": Switching,
}


@dataclass(frozen=True)
class Replay:
    """A given open-loop sequence as a disturbance of the environments' kind "callable".

    Attributes:
        pushes: d at every control step in units of the state per second: (steps, n), or with
            further axes between that match the leading axes of the state.
        period: Control period [s].

    Raises:
        ValueError: The sequence has no step, or holds a number that is not finite.
    """

    pushes: FloatArray
    period: float

    def __post_init__(self) -> None:
        if self.pushes.ndim < 2 or len(self.pushes) == 0 or not np.all(np.isfinite(self.pushes)):
            raise ValueError(
                f"pushes of shape {self.pushes.shape} must be finite, with one row per control step"
            )

    @property
    def bound(self) -> float:
        """The largest norm of d."""
        return float(np.linalg.norm(self.pushes, axis=-1).max())

    def __call__(self, situation: Situation) -> FloatArray:
        """Return d at the time of the situation, of the state's shape."""
        # All worlds of a replay run on one clock; past its end the last push stays.
        time: Any = np.max(situation.time)
        step = min(round(float(time) / self.period), len(self.pushes) - 1)
        return np.broadcast_to(self.pushes[step], situation.state.shape)


def _unit(vectors: FloatArray) -> FloatArray:
    fallback = np.zeros(vectors.shape[-1])
    fallback[0] = 1.0
    return onto_unit_sphere(vectors, fallback)
