"""Across a field of discs at the speed of a car that cannot stop: the car's task."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.passages import draw_fields, passages_open
from lagros_envs.task import Defaults, Feedback, Learning, MetricDesign, Scenario, Task
from lagros_envs.tasks.car.physics import Car

_DISC_RADIUS = 0.5  # [m]
_PASSAGE = 0.15  # between two discs a body has twice as much room [m]
_FEWEST = 3  # discs
_LOW, _HIGH = (1.5, -2.5), (7.5, 2.5)  # of their middles [m]


@dataclass(frozen=True)
class CarSettings(Task):
    """Cross 9 m of three to five discs in 6 s, at 1 to 2 m/s.

    Limits of the state and of the turn rate are those of C3M (Sun, Jha & Fan 2021). A success is a
    body without collision that comes within 0.3 m of the goal.

    Attributes:
        system: The car.
        control_period: Zero-order hold [s].
        time_limit: Length of an episode and of a plan [s].
    """

    system: Car = field(default_factory=Car)
    control_period: float = 0.1
    time_limit: float = 6.0

    name, title = "car", "Car"
    state_names = ("x [m]", "y [m]", "theta [rad]", "v [m/s]")
    control_names = ("omega [rad/s]", "a [m/s^2]")
    state_low = (-math.inf, -math.inf, -math.inf, 1.0)
    state_high = (math.inf, math.inf, math.inf, 2.0)
    control_low, control_high, control_scale = (-3.0, -3.0), (3.0, 3.0), (3.0, 3.0)
    goal_radius = 0.3
    position = (0, 1)
    body_radius = 0.2
    most_discs = 5
    margin = 0.35
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
    # benchmarks/studies/plan_law.py --task car holds R and rate against others: a push that lasts
    # turns the car round under a gentler law.
    feedback = Feedback((1.0, 1.0, 0.1, 0.1), (0.02, 0.02), rate=1.0)
    learning = Learning(
        plans=4000,
        samples=240_000,
        disturbance_bound=0.6,
        hidden=(48, 32, 64, 64),
        epochs=40,
        learned_epochs=30,
        batch=512,
        rounds=4,
        round_plans=4000,
        round_samples=80_000,
        round_epochs=8,
        keeps_plan=True,
        mpc_samples=0,
    )
    defaults = Defaults(bounds=(0.4,), bound=0.4)

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw start, goal and discs between them, all passages open."""
        start, goal = (np.array([x, *rng.uniform((-2, -0.5), (2, 0.5)), 1.5]) for x in (0.0, 9.0))
        ends = np.stack([start[:2], goal[:2]])
        while True:
            count = int(rng.integers(_FEWEST, self.most_discs + 1))
            discs = rng.uniform((*_LOW, _DISC_RADIUS), (*_HIGH, _DISC_RADIUS), (count, 3))
            if passages_open(discs[:, :2], ends, self._keep):
                return Scenario(start, goal, discs)

    def sample_many(self, rng: np.random.Generator, count: int) -> Scenario:
        """Draw as `sample` does, all at once."""
        ends = np.empty((count, 2, 4))
        ends[..., 0], ends[..., 3] = (0.0, 9.0), 1.5
        ends[..., 1:3] = rng.uniform((-2, -0.5), (2, 0.5), (count, 2, 2))
        number = (_FEWEST, self.most_discs)
        discs = draw_fields(rng, ends[..., :2], _LOW, _HIGH, number, _DISC_RADIUS, self._keep)
        return Scenario(ends[:, 0], ends[:, 1], discs)

    @property
    def _keep(self) -> float:
        """From the middle of a disc to where the body passes [m]."""
        return _DISC_RADIUS + self.body_radius + _PASSAGE

    def outline(self, state: FloatArray) -> Sequence[FloatArray]:
        """Return the body with its nose, within the circle that collides."""
        place, heading = state[:2], state[2]
        along = np.array([math.cos(heading), math.sin(heading)])
        across = np.array([-along[1], along[0]])
        corners = ((-0.17, -0.1), (0.1, -0.1), (0.2, 0.0), (0.1, 0.1), (-0.17, 0.1))
        return [np.stack([place + x * along + y * across for x, y in corners])]
