"""The least that a system needs: a pendulum, brought upright. Needs `pip install 'lagros[bench]'`.

What is left out has a usual value: no energy, no metric, no discs, no picture in a plane.

    lagros check examples/pendulum.py
    lagros bench examples/pendulum.py
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.task import Defaults, Feedback, Scenario, Task


@dataclass(frozen=True)
class Pendulum:
    """A point on a rod of a metre, under a torque per inertia; theta = 0 is upright."""

    state_dim: int = 2
    control_dim: int = 1

    def derivative(self, state: Sequence[Any], control: Sequence[Any], functions: Any) -> Any:
        """Return dx/dt."""
        angle, rate = state
        return rate, 9.8 * functions.sin(angle) + control[0]


@dataclass(frozen=True)
class PendulumTask(Task):
    """Come to rest upright within 4 s, from wherever it leans."""

    system: Pendulum = field(default_factory=Pendulum)
    time_limit: float = 4.0

    name, title = "pendulum", "Pendulum"
    state_names, control_names = ("theta [rad]", "omega [rad/s]"), ("torque [rad/s^2]",)
    control_low, control_high, control_scale = (-12.0,), (12.0,), (12.0,)
    state_scale, control_spread = (3.0, 3.0), (5.0,)
    feedback = Feedback((10.0, 1.0), (0.1,))
    defaults = Defaults(("tube-mpc", "lqr"), bounds=(0.2,), bound=0.2)

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw an angle, as far down as two thirds of the way."""
        return Scenario(np.array([rng.uniform(-2.0, 2.0), 0.0]), np.zeros(2))
