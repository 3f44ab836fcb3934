"""From 100 to 150 m to the target, never faster than the distance allows: the task of docking."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.task import Defaults, Feedback, Learning, MetricDesign, Scenario, Task
from lagros_envs.tasks.docking.physics import Chaser

_THRUST = 1.0  # [N]
_STILL = 1e-3  # below, a length has no direction to speak of [m, m/s]
_NEAR, _FAR = 100.0, 150.0  # of a start from the target [m]
_FIRST = 0.8  # largest speed of a start, as a share of the limit


@dataclass(frozen=True)
class DockingSettings(Task):
    """Come from 100 to 150 m to within 0.5 m of the target in 600 s, within the limit of speed.

    Whoever is faster than v_dock + 2 n ||p|| has failed. Mass, thrust, limit, starts and the size
    of the dock are those of the docking problem of Ravaioli et al. (2022), whose control step is
    1 s.

    Attributes:
        system: The chaser.
        control_period: Zero-order hold [s].
        time_limit: Length of an episode and of a plan [s].
        dock_speed: v_dock, the limit of speed at the target [m/s].
        spare_speed: By how much a plan stays below the limit [m/s].
    """

    system: Chaser = field(default_factory=Chaser)
    control_period: float = 5.0
    time_limit: float = 600.0
    dock_speed: float = 0.2
    spare_speed: float = 0.05

    name, title = "docking", "Docking"
    state_names = ("x [m]", "y [m]", "v_x [m/s]", "v_y [m/s]")
    control_names = ("F_x [N]", "F_y [N]")
    rates = (2, 3)
    control_low, control_high = (-_THRUST, -_THRUST), (_THRUST, _THRUST)
    state_scale = (50.0, 50.0, 0.2, 0.2)
    control_spread = (0.1, 0.1)
    goal_radius = 0.5
    position = (0, 1)
    body_radius = 0.5
    # The equations are linear and W constant: the condition is the same at every state, so that the
    # box says nothing but where the samples of the data may lie.
    metric = MetricDesign(
        low=(-1e4, -1e4, -10.0, -10.0),
        high=(1e4, 1e4, 10.0, 10.0),
        error=(1e3, 1e3, 10.0, 10.0),
        control_low=(-_THRUST, -_THRUST),
        control_high=(_THRUST, _THRUST),
        rate=0.02,
        margin=1e-3,
        scaling=(1.0, 1.0, 30.0, 30.0),
    )
    # No kind of disturbance costs an episode: `lagros bench docking --policies tube-mpc`.
    feedback = Feedback((1.0, 1.0, 100.0, 100.0), (20.0, 20.0), rate=0.02)
    learning = Learning(
        plans=1000,
        samples=150_000,
        disturbance_bound=0.006,
        hidden=(64, 64, 64),
        epochs=20,
        learned_epochs=15,
        scheduled=True,
        slope_weight=0.3,
        mpc_samples=0,
    )
    # A constant push of so much moves a chaser that does nothing by 540 m. Ten minutes make a film
    # of ten seconds.
    defaults = Defaults(bounds=(0.003,), bound=0.003, speed=60.0)

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw a start anywhere around the target, at up to 0.8 of the limit in any direction."""
        distance, share = rng.uniform((_NEAR, 0.0), (_FAR, _FIRST)).tolist()
        bearing, course = rng.uniform(0.0, 2.0 * math.pi, 2).tolist()
        speed = share * (self.dock_speed + 2.0 * self.system.mean_motion * distance)
        start = [distance * math.cos(bearing), distance * math.sin(bearing)]
        start += [speed * math.cos(course), speed * math.sin(course)]
        return Scenario(np.array(start), np.zeros(4))

    def sample_many(self, rng: np.random.Generator, count: int) -> Scenario:
        """Draw as `sample` does, all at once."""
        distance, share = rng.uniform((_NEAR, 0.0), (_FAR, _FIRST), (count, 2)).T
        bearing, course = rng.uniform(0.0, 2.0 * math.pi, (2, count))
        speed = share * (self.dock_speed + 2.0 * self.system.mean_motion * distance)
        place = distance * np.cos(bearing), distance * np.sin(bearing)
        starts = np.stack([*place, speed * np.cos(course), speed * np.sin(course)], axis=-1)
        return Scenario(starts, np.zeros((count, 4)), np.zeros((count, 0, 3)))

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return by how much the chaser is faster than the limit [m/s], 1e-3 at most too much."""
        distance, speed = (_length(pair, functions) for pair in (state[:2], state[2:]))
        limit = self.dock_speed + 2.0 * self.system.mean_motion * (distance - _STILL)
        return speed - limit

    def keep(self, state: Sequence[Any], functions: Any) -> Sequence[Any]:
        """Return the same with room for the law, in units of a typical speed."""
        return ((self.excess(state, functions) + self.spare_speed) / self.state_scale[2],)

    def features(self, observation: Sequence[Any], functions: Any) -> Sequence[Any]:
        """Return what the networks see: the state beside a guess of it, the start and the time.

        The guess is the cubic from the start to rest at the target, which a double integrator would
        follow with the least effort: what is left to learn is small beside the way.
        """
        layout = self.layout
        state, start = observation[layout.state], observation[layout.initial_state]
        time = observation[layout.time]
        share, limit = time / self.time_limit, self.time_limit
        left = 1.0 - share
        cubic = (1.0 + 2.0 * share) * left**2, time * left**2
        slope = -6.0 * share * left / limit, (1.0 - 3.0 * share) * left
        guesses = [
            weights[0] * start[axis] + weights[1] * start[2 + axis]
            for weights in (cubic, slope)
            for axis in (0, 1)
        ]
        beside = [one - guess for one, guess in zip(state, guesses, strict=True)]
        return (*beside, *start, time)

    def outline(self, state: FloatArray) -> Sequence[FloatArray]:
        """Return the chaser as a square."""
        corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        return [state[:2] + 0.5 * self.body_radius * corners]


def _length(pair: Sequence[Any], functions: Any) -> Any:
    """Return the length of a vector of the plane, smooth at zero, where it is `_STILL`."""
    return functions.sqrt(pair[0] ** 2 + pair[1] ** 2 + _STILL**2)
