"""A task of your own in one file: a car among discs. Needs `pip install 'lagros[bench]'`.

    lagros bench examples/car.py        # after `lagros reproduce examples/car.py`, with its results

After `register_task(CarTask())` there is `gym.make("lagros/Car-v0")`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lagros_envs.task import Defaults, Feedback, Learning, MetricDesign, Scenario, Task


@dataclass(frozen=True)
class Car:
    """[x, y, theta, v] under turn rate omega [rad/s] and acceleration a [m/s^2]."""

    state_dim: int = 4
    control_dim: int = 2

    def derivative(self, state: Sequence[Any], control: Sequence[Any], functions: Any) -> Any:
        """Return dx/dt."""
        _, _, heading, speed = state
        turn, acceleration = control
        return speed * functions.cos(heading), speed * functions.sin(heading), turn, acceleration


@dataclass(frozen=True)
class CarTask(Task):
    """Cross 9 m of discs in 6 s, at 1 to 2 m/s, and come within 0.3 m of the goal."""

    system: Car = field(default_factory=Car)

    name, title = "car", "Car"
    state_names = ("x [m]", "y [m]", "theta [rad]", "v [m/s]")
    control_names = ("omega [rad/s]", "a [m/s^2]")
    state_low = (-math.inf, -math.inf, -math.inf, 1.0)
    state_high = (math.inf, math.inf, math.inf, 2.0)
    control_low, control_high, control_scale = (-3.0, -3.0), (3.0, 3.0), (3.0, 3.0)
    position, body_radius, margin, most_discs = (0, 1), 0.2, 0.25, 5
    # The controls turn all that the motion depends on: a metric of x_d.
    metric = MetricDesign(
        low=(-5.0, -5.0, -math.pi, 0.5),
        high=(15.0, 5.0, math.pi, 2.5),
        error=(0.5, 0.5, 0.5, 0.5),
        control_low=(-3.0, -1.0),
        control_high=(3.0, 1.0),
        basis=tuple(
            angle if power == "1" else power if angle == "1" else f"{angle}*{power}"
            for angle in ("1", "cos(x[2])", "sin(x[2])", "cos(x[2])^2", "cos(x[2])*sin(x[2])")
            for power in ("1", "x[3]")
        ),
        point="nominal",
    )
    feedback = Feedback((1.0, 1.0, 0.3, 0.3), (0.06, 0.06))
    learning = Learning(
        2000, 120_000, 0.4, (64, 64, 128, 128), 30, 12, 256, 3, 2000, 40_000, 20, mpc_samples=0
    )
    defaults = Defaults(bounds=(0.4,), bound=0.4)
    weights = Path(__file__).parent / "car"

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw start, goal and three to five discs between them, all passages open."""
        start, goal = (np.array([x, *rng.uniform((-2, -0.5), (2, 0.5)), 1.5]) for x in (0.0, 9.0))
        keep = 0.5 + self.body_radius + 0.15
        ends = np.stack([start[:2], goal[:2]])
        while True:
            count = int(rng.integers(3, 6))
            discs = rng.uniform((1.5, -2.5, 0.5), (7.5, 2.5, 0.5), (count, 3))
            apart = np.linalg.norm(discs[:, None, :2] - discs[:, :2], axis=-1) + 9.0 * np.eye(count)
            gaps = np.linalg.norm(discs[:, None, :2] - ends, axis=-1)
            if np.all(apart >= 2.0 * keep) and np.all(gaps >= keep + 0.1):
                return Scenario(start, goal, discs)
