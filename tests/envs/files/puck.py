"""A task of somebody's own in a file, for the tests: a double integrator among discs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs import Scenario, Task


@dataclass(frozen=True)
class DoubleIntegrator:
    """[x, y, vx, vy] under the acceleration u, for a mass."""

    mass: float = 1.0
    state_dim = 4
    control_dim = 2

    def derivative(self, state: Sequence[Any], control: Sequence[Any], functions: Any) -> Any:
        """Return dx/dt."""
        _, _, across, up = state
        first, second = control
        return across, up, first / self.mass, second / self.mass


@dataclass(frozen=True)
class Puck(Task):
    """Slide to a goal, past two discs, within a rink."""

    system: DoubleIntegrator = field(default_factory=DoubleIntegrator)
    time_limit: float = 3.0
    rink: float = 5.0

    name, title = "puck", "Puck"
    state_names = ("x [m]", "y [m]", "vx [m/s]", "vy [m/s]")
    control_names = ("ax [m/s^2]", "ay [m/s^2]")
    control_centre = (0.1, -0.2)
    control_scale = (2.0, 3.0)
    control_low, control_high = (-3.0, -3.0), (3.0, 3.0)
    rates, position, body_radius, most_discs = (2, 3), (0, 1), 0.1, 3

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw both ends clear of two discs."""
        while True:
            discs = np.column_stack([rng.uniform(-1.0, 1.0, (2, 2)), (0.2, 0.3)])
            ends = np.zeros((2, 4))
            ends[:, :2] = rng.uniform(-2.0, 2.0, (2, 2))
            gaps = np.linalg.norm(ends[:, None, :2] - discs[:, :2], axis=-1)
            if np.all(gaps > discs[:, 2] + 0.2):
                return Scenario(*ends, discs)

    def fallen(self, state: Sequence[Any], functions: Any) -> Any:
        """Return whether the puck has left the rink."""
        return (abs(state[0]) > self.rink) | (abs(state[1]) > self.rink)
