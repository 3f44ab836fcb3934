"""A task without a place in a plane, for the tests: a pendulum to be held upright."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs import Scenario, Task


@dataclass(frozen=True)
class Pendulum:
    """[theta, dtheta/dt] under a torque, theta = 0 upright."""

    state_dim: int = 2
    control_dim: int = 1

    def derivative(self, state: Sequence[Any], control: Sequence[Any], functions: Any) -> Any:
        """Return dx/dt."""
        angle, rate = state
        return rate, 9.8 * functions.sin(angle) + control[0]


@dataclass(frozen=True)
class Swing(Task):
    """Come to rest upright."""

    system: Pendulum = field(default_factory=Pendulum)
    time_limit: float = 2.0
    name, title = "swing", "Swing"

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw an angle."""
        return Scenario(np.array([rng.uniform(-1.0, 1.0), 0.0]), np.zeros(2))
