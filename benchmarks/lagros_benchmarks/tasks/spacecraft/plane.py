"""The plane of a spacecraft that tracks its plan: the worst disturbance of the certified error.

x and y are double integrators in their error, and the tracking law knows the plan only by that
error. So one sequence is the worst for all agents of all worlds, and it is found by its slopes: the
loop has two states. That the body turns within a hold is left out here, not in the world in which
the sequence is flown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_benchmarks.worst_case.search import SearchSettings, search
from lagros_envs.arrays import FloatArray, IntArray
from lagros_policies.contraction.double_integrator import flow
from lagros_policies.tasks.spacecraft.wrench_control import AxesTracking, Law

_STEP = 1e-6
_STEPS = 60
_STARTS = 8
_SEARCH = SearchSettings("gradient", budget=6000, restarts=_STARTS)


@dataclass(frozen=True)
class PlaneTarget:
    """One axis of the plane under a held law, from no error; the score is its largest error [m].

    The laws turn with the plane, so that pushes along one line are enough: a search over both axes
    found no larger error.

    Attributes:
        law: The law.
        bound: d_bar, of position and velocity together.
        period: Time h for which a control and a push are held [s].
        steps: Control steps.
    """

    law: Law
    bound: float
    period: float
    steps: int = _STEPS

    @property
    def episodes(self) -> int:
        """One."""
        return 1

    @property
    def channels(self) -> int:
        """Of d: along position and velocity."""
        return 2

    @property
    def slope_cost(self) -> int:
        """Two closed-loop steps per state at every instant."""
        return 4

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the largest position errors (b,) [m] under d/d_bar (b, steps, 2)."""
        return np.asarray(np.abs(self._fly(sequences)[:, :, 0]).max(axis=1))

    def slopes(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the slopes of the scores by the sequences, up to a factor."""
        errors = self._fly(sequences)
        worst = np.argmax(np.abs(errors[:, :, 0]), axis=1)
        every = np.arange(len(sequences))
        pull = np.zeros((len(sequences), 2))
        result = np.zeros_like(sequences)
        for step in range(self.steps - 1, -1, -1):
            last = worst == step + 1
            pull[last] = 0.0
            pull[last, 0] = np.sign(errors[every, worst, 0])[last]
            result[:, step] = pull @ self._effect()
            by_state = np.empty((len(sequences), 2, 2))
            for column, shift in enumerate(_STEP * np.eye(2)):
                ends = [
                    self._step(errors[:, step] + sign * shift, sequences[:, step])
                    for sign in (1.0, -1.0)
                ]
                by_state[:, :, column] = (ends[0] - ends[1]) / (2.0 * _STEP)
            pull = np.einsum("bij,bi->bj", by_state, pull)
        return result

    def starts(self) -> FloatArray:
        """Return constant pushes of length one, shape (1, k, steps, 2)."""
        angle = np.pi * np.arange(_STARTS) / _STARTS
        rays = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.repeat(rays[None, :, None], self.steps, axis=2)

    def _effect(self) -> FloatArray:
        """Return what unit pushes of position and velocity do to the error within a hold."""
        h = self.period
        return np.array([[h, 0.5 * h * h], [0.0, h]])

    def _step(self, error: FloatArray, push: FloatArray) -> FloatArray:
        h = self.period
        deviation = self.law(error[:, :1], error[:, 1:])
        drift = error @ flow(h).T + deviation * np.array([0.5 * h * h, h])
        return np.asarray(drift + self.bound * push @ self._effect().T)

    def _fly(self, sequences: FloatArray) -> FloatArray:
        """Return the errors (b, steps + 1, 2)."""
        errors = [np.zeros((len(sequences), 2))]
        for step in range(self.steps):
            errors.append(self._step(errors[-1], sequences[:, step]))
        return np.stack(errors, axis=1)


def plane_target(tracking: AxesTracking, bound: float) -> PlaneTarget:
    """Return the loop of a tracking law, u* or the sliding-variable law, under the bound d_bar."""
    return PlaneTarget(tracking.laws[0], bound, tracking.plane.period)


def worst_plane_pushes(tracking: AxesTracking, bound: float, steps: int) -> FloatArray:
    """Return the d/d_bar of position and velocity that the search finds, shape (steps, 2)."""
    found = search(plane_target(tracking, bound), _SEARCH)[0].sequence
    return np.asarray(found[np.arange(steps) % len(found)])
