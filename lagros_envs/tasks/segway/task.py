"""From a lean to rest at a goal: the Segway's task."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.task import Defaults, Feedback, Learning, MetricDesign, Scenario, Task
from lagros_envs.tasks.segway.physics import Segway

_LEAN, _RATE = math.pi / 3.0, math.pi  # of plans [rad, rad/s]
_START_LEAN, _START_SPEED, _START_RATE = math.pi / 4.0, 0.5, 1.0  # [rad, m/s, rad/s]
_WAY = 3.0  # farthest goal [m]
_HALF_WIDTH = 0.06  # of the body in a picture [m]


@dataclass(frozen=True)
class SegwaySettings(Task):
    """Catch a lean, roll to a goal at most 3 m away within 6 s, and come to rest there.

    The bounds of plans are those of C3M (Sun, Jha & Fan 2021), whose control has no bounds either.
    A success is a body that comes within 0.5 of the goal state and has not fallen.

    Attributes:
        system: The Segway.
        control_period: Zero-order hold [s].
        time_limit: Length of an episode and of a plan [s].
    """

    system: Segway = field(default_factory=Segway)
    control_period: float = 0.1
    time_limit: float = 6.0

    name, title = "segway", "Segway"
    state_names = ("p [m]", "theta [rad]", "dp/dt [m/s]", "dtheta/dt [rad/s]")
    control_names = ("voltage [V]",)
    rates = (2, 3)
    state_low = (-math.inf, -_LEAN, -math.inf, -_RATE)
    state_high = (math.inf, _LEAN, math.inf, _RATE)
    state_scale = (1.0, 0.5, 1.0, 1.0)
    control_spread = (5.0,)
    goal_radius = 0.5
    short_goal = (0,)
    metric = MetricDesign(
        low=(-5.0, -_LEAN, -2.0, -_RATE),
        high=(5.0, _LEAN, 2.0, _RATE),
        error=(0.5, 0.3, 0.5, 0.5),
        control_low=(-20.0,),
        control_high=(20.0,),
        basis=("1", "cos(x[1])", "cos(x[1])^2"),
        rate=0.3,
    )
    # By benchmarks/studies/plan_law.py --task segway: no kind of disturbance costs an episode.
    feedback = Feedback((10.0, 3.0, 1.0, 1.0), (0.003,), rate=0.6)
    learning = Learning(
        plans=2000,
        samples=250_000,
        disturbance_bound=0.4,
        hidden=(64, 64, 64),
        epochs=60,
        learned_epochs=40,
        scheduled=True,
        slope_weight=0.3,
        mpc_samples=0,
    )
    # A push of p alone moves a body 1.5 m in an episode, three times what counts as a success.
    defaults = Defaults(bounds=(0.25,), bound=0.25)

    @property
    def control_scale(self) -> tuple[float, ...]:
        """Voltage of the action 1, about the most that a plan asks for [V]."""
        return (20.0,)

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw x(0) = [0, theta_0, v_0, omega_0] and x_f = [p_f, 0, 0, 0]."""
        lean, speed, rate, place = rng.uniform(-1.0, 1.0, 4).tolist()
        start = [0.0, _START_LEAN * lean, _START_SPEED * speed, _START_RATE * rate]
        return Scenario(np.array(start), np.array([_WAY * place, 0.0, 0.0, 0.0]))

    def features(self, observation: Sequence[Any], functions: Any) -> Sequence[Any]:
        """Return what the networks see: the state from the goal, then the episode and the time."""
        layout = self.layout
        state, goal = observation[layout.state], observation[layout.goal]
        start = observation[layout.initial_state]
        way = goal[0] - start[0]
        return (state[0] - goal[0], *state[1:], way, *start[1:], observation[layout.time])

    def place(self, state: FloatArray) -> FloatArray:
        """Return where the axle is, on the ground of the picture [m]."""
        return np.array([state[0], 0.0])

    def outline(self, state: FloatArray) -> Sequence[FloatArray]:
        """Return the wheel and the body, from the axle up along its lean."""
        axle, lean, radius = self.place(state), float(state[1]), self.system.wheel_radius
        turns = np.linspace(0.0, 2.0 * math.pi, 24, endpoint=False)
        wheel = axle + radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        up = np.array([math.sin(lean), math.cos(lean)])
        aside = _HALF_WIDTH * np.array([up[1], -up[0]])
        top = axle + self.system.leaning_inertia * up
        return [wheel, np.stack([axle - aside, axle + aside, top + aside, top - aside])]

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return by how much the body leans beyond a right angle [rad]."""
        return abs(state[1]) - math.pi / 2.0
