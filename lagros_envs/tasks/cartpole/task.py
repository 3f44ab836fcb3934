"""The cart-pole task of the paper: what differs from any task of one body, and its numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import (
    LARGEST,
    check_at_most,
    check_fields,
    check_multiple,
    check_not_negative,
    check_positive,
)
from lagros_envs.draw import Renderer
from lagros_envs.task import LARGEST_CONTROL, Feedback, Layout, Learning, Scenario, Task
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tube import PaperTube
from lagros_envs.values import use_plain_numbers

STATE_DIM = 4
FALL_ANGLE = math.pi / 2  # [rad]
# How it is drawn.
CART_SIZE = (0.52, 0.26)  # width, height [m]
HINGE_HEIGHT = 1.15 * CART_SIZE[1]  # of the pole's lower end, above the rail [m]
_POLE_WIDTH = 0.08  # [m]
# Where each named part of the observation lies.
LAYOUT = Layout(STATE_DIM, 0)
STATE, GOAL, INITIAL_STATE, TIME = LAYOUT.state, LAYOUT.goal, LAYOUT.initial_state, LAYOUT.time
OBSERVATION_DIM = LAYOUT.size


@dataclass(frozen=True)
class CartPoleSettings(Task):
    """Everything that defines the task, with the values of the paper as defaults.

    Attributes:
        system: The cart-pole.
        control_period: Zero-order hold, the largest admissible control interval [s].
        time_limit: Episode length, T and its limit alike [s].
        initial_angle: theta_0 is uniform in plus or minus this [rad].
        goal_range: p_f is uniform in plus or minus this [m].
        force_limit: Saturation of the force [N]; None leaves it unlimited.
        force_scale: Force of the action 1.0 [N]. Actions beyond +-1 are applied as they are unless
            `force_limit` is set; the bounds tell a learner what range to explore.
        tube: The published tube; its radius is the success threshold.
        effort_weight: Reward per N^2 s of effort, negative sign applied.
        distance_weight: Reward per (unit of distance to the goal) s, negative sign applied.
        upright_bonus: Reward per second that the pole has not fallen, so that falling early
            never pays.
        success_bonus: Reward at the first success.

    Raises:
        ValueError: A value is out of range or the limit is not a whole number of periods.
    """

    system: CartPole = field(default_factory=CartPole)
    control_period: float = 0.1
    time_limit: float = 9.0
    initial_angle: float = math.pi / 3
    goal_range: float = 5.0
    force_limit: float | None = None
    force_scale: float = 40.0
    tube: PaperTube = field(default_factory=PaperTube)
    effort_weight: float = 0.01
    distance_weight: float = 1.0
    upright_bonus: float = 10.0
    success_bonus: float = 10.0

    name, title, room = "cartpole", "CartPole", "cartpole"
    state_names = ("p [m]", "theta [rad]", "dp/dt [m/s]", "dtheta/dt [rad/s]")
    control_names = ("force [N]",)
    rates = (2, 3)
    # Chosen by the trade-off of benchmarks/studies/plan_law.py.
    feedback = Feedback(
        state_weights=(1.0, 1.25, 0.6, 1.1),
        control_weights=(0.01,),
        rate=0.3,
        early_state=(-2.9, -1.1, 1.2, -2.9),
        early_control=(5.0,),
        settling=1.6,
    )
    learning = Learning(samples=250_000, epochs=40, scheduled=True, slope_weight=0.3)
    short_goal = (0,)

    def __post_init__(self) -> None:
        check_fields(self)
        use_plain_numbers(self)
        for item in fields(self):
            if item.type == "float":
                check_not_negative(item.name, getattr(self, item.name))
                most = LARGEST_CONTROL if item.name.startswith("force") else LARGEST
                check_at_most(item.name, getattr(self, item.name), most)
        for name in ("control_period", "time_limit", "force_scale"):
            check_positive(name, getattr(self, name))
        if self.force_limit is not None:
            check_positive("force_limit", self.force_limit, "or None for no limit")
            check_at_most("force_limit", self.force_limit, LARGEST_CONTROL, "or None for no limit")
        if self.initial_angle >= FALL_ANGLE:
            raise ValueError(f"initial_angle={self.initial_angle!r} must be below pi/2")
        check_multiple("time_limit", self.time_limit, "control_period", self.control_period)

    @property
    def control_scale(self) -> tuple[float, ...]:
        """Force of the action 1.0 [N]."""
        return (self.force_scale,)

    @property
    def control_low(self) -> tuple[float, ...]:
        """Least force [N]."""
        return (-math.inf if self.force_limit is None else -self.force_limit,)

    @property
    def control_high(self) -> tuple[float, ...]:
        """Largest force [N]."""
        return (math.inf if self.force_limit is None else self.force_limit,)

    @property
    def alive_bonus(self) -> float:  # type: ignore[override]
        """Reward per second that the pole has not fallen."""
        return self.upright_bonus

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw x(0) = [0, theta_0, 0, 0] and x_f = [p_f, 0, 0, 0]."""
        # What `_scenarios` gives, in a fifth of its time.
        angle, place = rng.uniform(-1.0, 1.0, 2).tolist()
        initial_state = np.array([0.0, self.initial_angle * angle, 0.0, 0.0])
        return Scenario(initial_state, np.array([self.goal_range * place, 0.0, 0.0, 0.0]))

    def sample_many(self, rng: np.random.Generator, count: int) -> Scenario:
        """Draw the scenarios of several episodes at once."""
        return self._scenarios(rng.uniform(-1.0, 1.0, (count, 2)))

    def sample_each(self, generators: Iterable[np.random.Generator]) -> Scenario:
        """Draw one scenario from each generator."""
        shares = [rng.uniform(-1.0, 1.0, 2) for rng in generators]
        return self._scenarios(np.array(shares).reshape(-1, 2))

    def success_radius(self, time: Any) -> Any:
        """Return the radius of the published tube at a time [s]."""
        return self.tube.radius(time)

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return by how much the pole leans beyond the angle at which it has fallen [rad]."""
        return abs(state[1]) - FALL_ANGLE

    def tube_radius(self, time: Any) -> Any:
        """Return the same radius, which the paper publishes for x_d, too."""
        return self.tube.radius(time)

    def fallen(self, state: Sequence[Any], functions: Any) -> Any:
        """Return whether the pole has fallen."""
        return abs(state[1]) > FALL_ANGLE

    def fallen_start(self, states: FloatArray) -> str:
        """Say how far the pole has fallen."""
        largest = np.max(np.abs(states[:, 1]))
        return f"has an angle of {largest:.3f} rad; beyond pi/2 the pole has already fallen"

    def renderer(self, render_mode: str, fps: int) -> Renderer:
        """Return what draws cart and pole."""
        from lagros_envs.tasks.cartpole.draw import CartPoleRenderer

        return CartPoleRenderer(self, render_mode, fps)

    def place(self, state: FloatArray) -> FloatArray:
        """Return where the middle of the cart is."""
        return np.array([state[0], 0.5 * CART_SIZE[1]])

    def outline(self, state: FloatArray) -> Sequence[FloatArray]:
        """Return cart and pole; a positive angle leans to the right."""
        half, high = 0.5 * CART_SIZE[0], CART_SIZE[1]
        cart = np.array([[-half, 0.0], [half, 0.0], [half, high], [-half, high]])
        along = np.array([math.sin(state[1]), math.cos(state[1])])
        side = 0.5 * _POLE_WIDTH * np.array([along[1], -along[0]])
        hinge, tip = np.array([0.0, HINGE_HEIGHT]), 2.0 * self.system.half_length * along
        pole = hinge + np.array([side, -side, tip - side, tip + side])
        return [np.array([state[0], 0.0]) + part for part in (cart, pole)]

    def _scenarios(self, shares: FloatArray) -> Scenario:
        """Return scenarios from theta_0 and p_f as shares of their ranges, shape (count, 2)."""
        initial_state, goal = np.zeros((2, len(shares), STATE_DIM))
        initial_state[:, 1] = self.initial_angle * shares[:, 0]
        goal[:, 0] = self.goal_range * shares[:, 1]
        return Scenario(initial_state, goal, np.zeros((len(shares), 0, 3)))
