"""Tasks that stand in no package: a puck that slides in the plane among discs, and a car."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lagros_envs.task import Feedback, MetricDesign, Scenario, Task


@dataclass(frozen=True)
class Puck:
    """[x, y, v_x, v_y] under a force along each axis, with friction."""

    mass: float = 1.0
    friction: float = 0.2
    state_dim: int = 4
    control_dim: int = 2

    def derivative(self, state, control, functions):
        _, _, ahead, aside = state
        return (
            ahead,
            aside,
            (control[0] - self.friction * ahead) / self.mass,
            (control[1] - self.friction * aside) / self.mass,
        )


@dataclass(frozen=True)
class Slide(Task):
    """Four metres in 4 s past a disc or two."""

    system: Puck = field(default_factory=Puck)
    time_limit: float = 4.0

    name, title = "slide", "Slide"
    rates = (2, 3)
    control_low, control_high, control_scale = (-4.0, -4.0), (4.0, 4.0), (2.0, 2.0)
    state_low, state_high = (-math.inf, -math.inf, -3.0, -3.0), (math.inf, math.inf, 3.0, 3.0)
    position, body_radius, margin, most_discs = (0, 1), 0.1, 0.2, 2
    metric = MetricDesign((-9.0,) * 4, (9.0,) * 4, (0.5,) * 4, (-3.0,) * 2, (3.0,) * 2, rate=0.5)
    feedback = Feedback((10.0, 10.0, 1.0, 1.0), (1.0, 1.0))

    def sample(self, rng):
        start = np.array([0.0, rng.uniform(-0.5, 0.5), 0.0, 0.0])
        goal = np.array([4.0, rng.uniform(-0.5, 0.5), 0.0, 0.0])
        discs = np.array([[1.4, rng.uniform(-0.4, 0.4), 0.3], [2.6, rng.uniform(-0.4, 0.4), 0.3]])
        return Scenario(start, goal, discs[: 1 + int(rng.integers(2))])


@dataclass(frozen=True)
class Car:
    """[x, y, heading, speed] under turn rate and acceleration."""

    state_dim: int = 4
    control_dim: int = 2

    def derivative(self, state, control, functions):
        _, _, heading, speed = state
        turn, push = control
        return speed * functions.cos(heading), speed * functions.sin(heading), turn, push


@dataclass(frozen=True)
class Drive(Task):
    """Six metres in 4 s at 1 to 2 m/s."""

    system: Car = field(default_factory=Car)
    time_limit: float = 4.0

    name, title = "drive", "Drive"
    control_low, control_high, control_scale = (-3.0, -3.0), (3.0, 3.0), (3.0, 3.0)
    state_low, state_high = (-math.inf,) * 3 + (0.9,), (math.inf,) * 3 + (2.1,)
    position, body_radius, margin, most_discs = (0, 1), 0.1, 0.1, 1

    def sample(self, rng):
        start = np.array([0.0, rng.uniform(-1.0, 1.0), rng.uniform(-0.3, 0.3), 1.5])
        goal = np.array([6.0, rng.uniform(-1.0, 1.0), rng.uniform(-0.3, 0.3), 1.5])
        return Scenario(start, goal, np.array([[3.0, rng.uniform(-0.5, 0.5), 0.3]]))
