"""Metric, networks, proof: a ball rolls on a beam. Needs `pip install 'lagros[bench]'`.

Networks need the extra `train`, too.

    lagros check examples/ball_beam.py
    lagros certify examples/ball_beam.py --policy tube-mpc
    lagros reproduce examples/ball_beam.py      # networks (a) and (c)
    lagros certify examples/ball_beam.py --policy lagros --bound 0.005
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.task import Defaults, Feedback, Learning, MetricDesign, Scenario, Task


@dataclass(frozen=True)
class BallBeam:
    """[s, theta, ds/dt, dtheta/dt]: a solid ball at s on a beam that a torque turns."""

    mass: float = 0.2  # of the ball [kg]
    inertia: float = 0.1  # of the beam [kg m^2]
    gravity: float = 9.81
    state_dim: int = 4
    control_dim: int = 1
    mirror = (-1, -1, -1, -1), (-1,)

    def energy(self, state: Sequence[Any], functions: Any) -> Any:
        """Return the energy [J]; the ball rolls, which adds two fifths to its mass."""
        place, angle, speed, rate = state
        turning = (self.inertia + self.mass * place**2) * rate**2
        height = place * functions.sin(angle)
        return 0.5 * (1.4 * self.mass * speed**2 + turning) + self.mass * self.gravity * height

    def derivative(self, state: Sequence[Any], control: Sequence[Any], functions: Any) -> Any:
        """Return dx/dt (Hauser, Sastry & Kokotovic 1992)."""
        place, angle, speed, rate = state
        rolling = (place * rate**2 - self.gravity * functions.sin(angle)) / 1.4
        pull = self.mass * place * (2.0 * speed * rate + self.gravity * functions.cos(angle))
        return speed, rate, rolling, (control[0] - pull) / (self.inertia + self.mass * place**2)


@dataclass(frozen=True)
class BallBeamTask(Task):
    """Bring the ball from one place to another in 4 s, to rest within 0.1 of the goal."""

    system: BallBeam = field(default_factory=BallBeam)
    time_limit: float = 4.0

    name, title = "ball_beam", "BallBeam"
    state_names = ("s [m]", "theta [rad]", "ds/dt [m/s]", "dtheta/dt [rad/s]")
    control_names = ("torque [N m]",)
    control_low, control_high, control_scale = (-6.0,), (6.0,), (3.0,)
    state_scale, control_spread, rates, goal_radius = (0.3, 0.1, 0.3, 0.3), (0.5,), (2, 3), 0.1
    # Where plans are, from and to, how far beside them a body may be, and u_d, from and to.
    metric = MetricDesign(
        (-0.6, -0.4, -1.0, -1.3), (0.6, 0.4, 1.0, 1.3), (0.1, 0.1, 0.2, 0.3), (-2.0,), (2.0,)
    )
    feedback = Feedback((4.0, 1.0, 1.0, 0.1), (0.1,), rate=0.5)
    learning = Learning(
        600, 90_000, 0.03, (64, 64, 64), 80, 20, scheduled=True, slope_weight=0.3, mpc_samples=0
    )
    defaults = Defaults(("tube-mpc", "lqr"), bounds=(0.03,), bound=0.03)

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw where the ball is, and where it is to rest."""
        ends = np.zeros((2, 4))
        ends[:, 0] = rng.uniform(-0.5, 0.5, 2)
        return Scenario(ends[0], ends[1])

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return by how much the ball is beyond the ends of the beam [m]."""
        return abs(state[0]) - 1.0

    def features(self, seen: Sequence[Any], functions: Any) -> Sequence[Any]:
        """Return what networks see: the state about the goal, goal, start, time."""
        return [seen[0] - seen[4], *seen[1:4], seen[4], seen[8], seen[self.layout.time]]
