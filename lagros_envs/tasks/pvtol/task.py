"""From hover to hover across a field of discs: the planar quadrotor's task."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.draw import rotor_outline
from lagros_envs.passages import draw_fields, passages_open
from lagros_envs.task import Defaults, Feedback, Learning, MetricDesign, Scenario, Task
from lagros_envs.tasks.pvtol.physics import Pvtol

_TILT = math.pi / 3.0  # of plans, and their largest dphi/dt [rad, rad/s]
_HOVER = Pvtol().hover
_DISC_RADIUS = 0.5  # [m]
_PASSAGE = 0.15  # between two discs a body has twice as much room [m]
_FEWEST = 3  # discs
_LOW, _HIGH = (1.2, -1.5), (4.8, 1.5)  # of their middles [m]


@dataclass(frozen=True)
class PvtolSettings(Task):
    """Fly 6 m to the side in 6 s, past three to five discs, and hover at the goal.

    Limits are those of C3M (Sun, Jha & Fan 2021). A success is a body without collision, upright,
    that comes within 0.3 m of the goal.

    Attributes:
        system: The quadrotor.
        control_period: Zero-order hold [s].
        time_limit: Length of an episode and of a plan [s].
    """

    system: Pvtol = field(default_factory=Pvtol)
    control_period: float = 0.1
    time_limit: float = 6.0

    name, title = "pvtol", "Pvtol"
    state_names = ("p_x [m]", "p_z [m]", "phi [rad]", "v_x [m/s]", "v_z [m/s]", "dphi/dt [rad/s]")
    control_names = ("right thrust [N]", "left thrust [N]")
    rates = (3, 4, 5)
    state_low = (-math.inf, -math.inf, -_TILT, -2.0, -1.0, -_TILT)
    state_high = (math.inf, math.inf, _TILT, 2.0, 1.0, _TILT)
    state_scale = (1.0, 1.0, 0.3, 1.0, 1.0, 0.5)
    control_spread = (0.1, 0.1)
    goal_radius = 0.3
    position = (0, 1)
    body_radius = 0.2
    most_discs = 5
    margin = 0.35
    metric = MetricDesign(
        low=(-5.0, -5.0, -_TILT, -2.0, -1.0, -_TILT),
        high=(10.0, 5.0, _TILT, 2.0, 1.0, _TILT),
        error=(0.5, 0.5, 0.3, 0.5, 0.5, 0.5),
        control_low=(_HOVER - 1.0,) * 2,
        control_high=(_HOVER + 1.0,) * 2,
        basis=("1", "cos(x[2])", "sin(x[2])", "x[3]"),
        scaling=(1.0, 1.0, 3.0, 1.0, 1.0, 1.0),
    )
    # R by benchmarks/studies/plan_law.py --task pvtol: no kind of disturbance costs an episode.
    feedback = Feedback((1.0, 1.0, 0.3, 0.3, 0.3, 0.03), (0.2, 0.2), rate=1.0)
    learning = Learning(
        plans=2400,
        samples=168_000,
        disturbance_bound=0.45,
        hidden=(48, 32, 64, 64),
        epochs=60,
        learned_epochs=30,
        batch=512,
        rounds=6,
        round_plans=2400,
        round_samples=60_000,
        round_epochs=8,
        keeps_plan=True,
        mpc_samples=0,
    )
    defaults = Defaults(bounds=(0.3,), bound=0.3)

    @property
    def control_centre(self) -> tuple[float, ...]:
        """Thrusts that hold a hover [N]."""
        return (self.system.hover,) * 2

    @property
    def control_scale(self) -> tuple[float, ...]:
        """From a hover to the most [N]."""
        return (self.system.hover,) * 2

    @property
    def control_low(self) -> tuple[float, ...]:
        """Rotors pull one way only [N]."""
        return (0.0, 0.0)

    @property
    def control_high(self) -> tuple[float, ...]:
        """Twice what a hover needs [N]."""
        return (2.0 * self.system.hover,) * 2

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw a start at the left, a goal at the right, and discs between with open passages."""
        start, goal = np.zeros(6), np.zeros(6)
        start[1], goal[:2] = rng.uniform(-1.5, 1.5), (6.0, rng.uniform(-1.5, 1.5))
        ends = np.stack([start[:2], goal[:2]])
        while True:
            count = int(rng.integers(_FEWEST, self.most_discs + 1))
            both = zip(_LOW, _HIGH, strict=True)
            centres = np.stack([rng.uniform(*bounds, count) for bounds in both], axis=-1)
            if passages_open(centres, ends, self._keep):
                discs = np.concatenate([centres, np.full((count, 1), _DISC_RADIUS)], axis=-1)
                return Scenario(start, goal, discs)

    def sample_many(self, rng: np.random.Generator, count: int) -> Scenario:
        """Draw as `sample` does, all at once."""
        ends = np.zeros((count, 2, 6))
        ends[:, 1, 0] = 6.0
        ends[..., 1] = rng.uniform(-1.5, 1.5, (count, 2))
        number = (_FEWEST, self.most_discs)
        discs = draw_fields(rng, ends[..., :2], _LOW, _HIGH, number, _DISC_RADIUS, self._keep)
        return Scenario(ends[:, 0], ends[:, 1], discs)

    @property
    def _keep(self) -> float:
        """From the middle of a disc to where the body passes [m]."""
        return _DISC_RADIUS + self.body_radius + _PASSAGE

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return by how much the body tilts beyond a right angle [rad]."""
        return abs(state[2]) - math.pi / 2.0

    def outline(self, state: FloatArray) -> Sequence[FloatArray]:
        """Return the rod and the two rotors, within the circle that collides."""
        return rotor_outline(state[:2], float(state[2]), self.body_radius)
