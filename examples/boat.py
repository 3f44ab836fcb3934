"""Discs: a boat crosses a field of buoys in a current. Needs `pip install 'lagros[bench]'`.

Bounds of the state keep it from turning round; `outline` draws it.

    lagros check examples/boat.py
    lagros bench examples/boat.py
    lagros watch examples/boat.py --policy tube-mpc --video boat.gif
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.task import Defaults, Feedback, Scenario, Task


@dataclass(frozen=True)
class Boat:
    """[x, y, psi, v, r]: it goes where it points, at v through the water, which moves itself."""

    current: tuple[float, float] = (0.0, 0.2)  # [m/s]
    drag: float = 0.3  # [1/s]
    turning_drag: float = 1.0  # [1/s]
    state_dim: int = 5
    control_dim: int = 2
    dissipates = True

    def energy(self, state: Sequence[Any], functions: Any) -> Any:
        """Return the energy in the frame of the water, for a unit of mass and inertia."""
        return 0.5 * (state[3] ** 2 + state[4] ** 2)

    def derivative(self, state: Sequence[Any], control: Sequence[Any], functions: Any) -> Any:
        """Return dx/dt."""
        _, _, heading, speed, turn = state
        thrust, rudder = control
        return (
            speed * functions.cos(heading) + self.current[0],
            speed * functions.sin(heading) + self.current[1],
            turn,
            thrust - self.drag * speed,
            rudder - self.turning_drag * turn,
        )


@dataclass(frozen=True)
class BoatTask(Task):
    """Pass the buoys and come within 0.4 m of the goal, 8 m away, in 8 s."""

    system: Boat = field(default_factory=Boat)
    time_limit: float = 8.0

    name, title = "boat", "Boat"
    state_names = ("x [m]", "y [m]", "psi [rad]", "v [m/s]", "r [rad/s]")
    control_names = ("thrust [m/s^2]", "rudder [rad/s^2]")
    control_low, control_high, control_scale = (-2.0, -3.0), (2.0, 3.0), (2.0, 3.0)
    state_low = (-math.inf, -math.inf, -math.inf, 0.3, -2.0)
    state_high = (math.inf, math.inf, math.inf, 2.0, 2.0)
    rates, goal_radius = (3, 4), 0.4
    position, body_radius, margin, most_discs = (0, 1), 0.2, 0.3, 4
    feedback = Feedback((4.0, 4.0, 1.0, 0.3, 0.1), (0.3, 0.1))
    defaults = Defaults(("tube-mpc", "lqr"), bounds=(0.2,), bound=0.2)

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw start, goal and four buoys, one in each band of the way."""
        start, goal = (np.array([x, rng.uniform(-1.0, 1.0), 0.0, 1.0, 0.0]) for x in (0.0, 8.0))
        across = np.array([1.8, 3.3, 4.8, 6.3]) + rng.uniform(-0.2, 0.2, 4)
        return Scenario(start, goal, np.column_stack([across, rng.uniform(-1, 1, 4), [0.3] * 4]))

    def outline(self, state: FloatArray) -> Sequence[FloatArray]:
        """Return the hull."""
        along = np.array([math.cos(state[2]), math.sin(state[2])])
        across = np.array([-along[1], along[0]])
        hull = ((0.2, 0.0), (0.05, 0.08), (-0.18, 0.08), (-0.18, -0.08), (0.05, -0.08))
        return [np.stack([state[:2] + x * along + y * across for x, y in hull])]
