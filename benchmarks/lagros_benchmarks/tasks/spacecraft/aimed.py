"""The disturbance that moves an agent farthest from its plan, in closed form.

Under the gain law e' = A e + E d. What drives l'p_e at instant k farthest, for a direction l of the
plane, is at every earlier instant the d along E' A^(k-1-i)' of it, at the bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.disturbances import Situation
from lagros_policies.contraction.axis_gain import AxisGain


@dataclass(frozen=True)
class Aimed:
    """Pushes each agent along one direction until an instant, and along another until the next.

    Attributes:
        gain: The gain of the plane.
        steps: Instants between one aim and the next.
        seed: Of the directions.
    """

    gain: AxisGain
    steps: int = 40
    seed: int = 0

    def __call__(self, situation: Situation) -> FloatArray:
        """Return d of length one, shape (..., 6)."""
        index = round(float(np.max(situation.time)) / self.gain.period)
        turn, left = index // self.steps, self.steps - 1 - index % self.steps
        shape = situation.state.shape[:-1]
        angle = np.random.default_rng([self.seed, turn]).uniform(-np.pi, np.pi, shape)
        h = self.gain.period
        row = np.array([1.0, 0.0]) @ np.linalg.matrix_power(self.gain.step, left)
        place, speed = h * row[0], 0.5 * h * h * row[0] + h * row[1]
        size = np.hypot(place, speed)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        push = np.zeros(situation.state.shape)
        push[..., :2], push[..., 3:5] = direction * place / size, direction * speed / size
        return push
