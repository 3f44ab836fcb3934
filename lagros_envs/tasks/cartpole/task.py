"""The cart-pole task of the paper: settings, scenarios, observation, reward and success.

Pure functions, written for floats and for arrays alike, so that the single environment and its
vectorised twin share every definition.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lagros_envs.checks import (
    LARGEST,
    check_at_most,
    check_fields,
    check_multiple,
    check_not_negative,
    check_positive,
)
from lagros_envs.numbers.functions import where
from lagros_envs.options import nominal_option, option_numbers
from lagros_envs.task import Scenario, Task
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tube import PaperTube
from lagros_envs.values import ByValue, use_plain_numbers

FloatArray = NDArray[np.float64]

STATE_DIM = 4
RATES = (False, False, True, True)
FALL_ANGLE = math.pi / 2  # [rad]
# Farther from its goal than this the integration has diverged under an enormous force.
LARGEST_DISTANCE = 1e12
# No force is larger [N], whatever the action: nothing stands under it, and the effort of an episode
# stays a number, in single precision as well.
LARGEST_FORCE = 1e16
# What `reset(options=...)` may hold.
OPTIONS = ("initial_state", "goal", "nominal")
# Where each named part of the observation lies.
STATE = slice(0, 4)
GOAL = slice(4, 8)
INITIAL_STATE = slice(8, 12)
TIME = 12
OBSERVATION_DIM = 13


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

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        use_plain_numbers(self)
        for item in fields(self):
            if item.type == "float":
                check_not_negative(item.name, getattr(self, item.name))
                most = LARGEST_FORCE if item.name.startswith("force") else LARGEST
                check_at_most(item.name, getattr(self, item.name), most)
        for name in ("control_period", "time_limit", "force_scale"):
            check_positive(name, getattr(self, name))
        if self.force_limit is not None:
            check_positive("force_limit", self.force_limit, "or None for no limit")
            check_at_most("force_limit", self.force_limit, LARGEST_FORCE, "or None for no limit")
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

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw x(0) = [0, theta_0, 0, 0] and x_f = [p_f, 0, 0, 0]."""
        drawn = sample_scenario(rng, self)
        return Scenario(drawn.initial_state, drawn.goal)

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


@dataclass(frozen=True, eq=False)
class CartPoleScenario(ByValue):
    """What an episode asks for, or each of several episodes.

    Attributes:
        initial_state: x(0), shape (..., 4).
        goal: x_f, shape (..., 4).
    """

    initial_state: FloatArray
    goal: FloatArray

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        self._lock()


def sample_scenario(rng: np.random.Generator, settings: CartPoleSettings) -> CartPoleScenario:
    """Draw x(0) = [0, theta_0, 0, 0] and x_f = [p_f, 0, 0, 0]."""
    # What `scenario_of_shares` gives, in a fifth of its time.
    angle, place = draw_shares(rng).tolist()
    initial_state = np.array([0.0, settings.initial_angle * angle, 0.0, 0.0])
    return CartPoleScenario(initial_state, np.array([settings.goal_range * place, 0.0, 0.0, 0.0]))


def draw_shares(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> FloatArray:
    """Draw theta_0 and p_f, each as a share of its range in [-1, 1], shape (*shape, 2)."""
    return rng.uniform(-1.0, 1.0, size=(*shape, 2))


def scenario_of_shares(shares: FloatArray, settings: CartPoleSettings) -> CartPoleScenario:
    """Return the scenarios of what `draw_shares` has drawn, shape (..., 2)."""
    shape = (*shares.shape[:-1], STATE_DIM)
    initial_state, goal = np.zeros(shape), np.zeros(shape)
    initial_state[..., 1] = settings.initial_angle * shares[..., 0]
    goal[..., 0] = settings.goal_range * shares[..., 1]
    return CartPoleScenario(initial_state, goal)


def start_and_goal(
    options: dict[str, Any],
    shape: tuple[int, ...],
    looked_at: NDArray[np.bool_] | None = None,
) -> dict[str, FloatArray]:
    """Return `initial_state` and `goal`, each of this shape (..., 4), where the options hold them.

    Args:
        options: As given to reset.
        shape: Leading axes, then 4; a goal may also be p_f alone.
        looked_at: Which of a leading axis are read; all of them if left out.

    Raises:
        ValueError: A value has the wrong shape, is not finite or too large, or starts fallen.
    """
    given: dict[str, FloatArray] = {}
    if "initial_state" in options:
        value = options["initial_state"]
        given["initial_state"] = start = option_numbers(
            "initial_state", value, shape, looked_at=looked_at
        )
        angles = np.abs((start if looked_at is None else start[looked_at])[..., 1])
        if np.any(angles > FALL_ANGLE):
            raise ValueError(
                f"options['initial_state'] has an angle of {np.max(angles):.3f} rad; "
                "beyond pi/2 the pole has already fallen"
            )
    if "goal" in options:
        goal = option_numbers("goal", options["goal"], shape, shape[:-1], looked_at=looked_at)
        if goal.shape != shape:
            position = goal
            goal = np.zeros(shape)
            goal[..., 0] = position
        given["goal"] = goal
    return given


def nominal_from_options(
    options: dict[str, Any],
    settings: CartPoleSettings,
    batch: tuple[int, ...] = (),
    looked_at: NDArray[np.bool_] | None = None,
) -> FloatArray | None:
    """Return x_d at every control instant, shape (*batch, steps + 1, 4), if the options hold it.

    Args:
        options: As given to reset.
        settings: The task.
        batch: Leading axes.
        looked_at: Which of a leading axis have to be finite; all of them if left out.

    Raises:
        ValueError: The trajectory has the wrong shape or is not finite.
    """
    shape = (*batch, settings.steps + 1, STATE_DIM)
    return nominal_option(options, shape, "the nominal state", looked_at)


def named_space(settings: CartPoleSettings) -> spaces.Dict:
    """Return the observation's named parts, in the order in which they are flattened.

    The parts are `state` x, `goal` x_f and `initial_state` x(0), each (4,) in [m, rad, m/s, rad/s],
    and `time` t, (1,) in [s].
    """

    def box(low: list[float], high: list[float]) -> spaces.Box:
        return spaces.Box(np.array(low, np.float32), np.array(high, np.float32))

    unbounded = ([-math.inf] * STATE_DIM, [math.inf] * STATE_DIM)
    return spaces.Dict(
        OrderedDict(
            state=box(*unbounded),
            goal=box(*unbounded),
            initial_state=box(*unbounded),
            # As the last step computes it, which may differ in the last digit.
            time=box([0.0], [settings.steps * settings.control_period]),
        )
    )


def applied_force(settings: CartPoleSettings, action: Any, clip: Any) -> Any:
    """Return the force of an action [N] (floats or arrays): scaled, then clipped to the limit."""
    limit = LARGEST_FORCE if settings.force_limit is None else settings.force_limit
    return clip(settings.force_scale * action, -limit, limit)


def goal_distance(state: Any, goal: Any, sqrt: Any) -> Any:
    """Return ||x - x_f|| from the components of both (floats or arrays)."""
    (p, angle, velocity, rate), (p_f, angle_f, velocity_f, rate_f) = state, goal
    p, angle, velocity, rate = p - p_f, angle - angle_f, velocity - velocity_f, rate - rate_f
    return sqrt(p * p + angle * angle + velocity * velocity + rate * rate)


class Given(NamedTuple):
    """What the rules of a step are given, floats or arrays; the last three are theirs to renew.

    Attributes:
        goal: x_f, its four parts.
        time: t at the end of the step [s].
        radius: r(t).
        effort: The integral of ||u||^2 before the step [N^2 s].
        effort_to_success: The same, frozen at the first success.
        success_time: Instant of the first success [s]; inf before.
    """

    goal: Sequence[Any]
    time: Any
    radius: Any
    effort: Any
    effort_to_success: Any
    success_time: Any


class Outcome(NamedTuple):
    """What the rules make of a step, floats or arrays.

    Attributes:
        effort: As in `Given`, after the step.
        effort_to_success: As in `Given`, after the step.
        success_time: As in `Given`, after the step.
        distance: ||x - x_f||.
        reward: See `reward`.
        fallen: Whether the pole has fallen.
        inside: Whether x is inside the tube, and the pole upright.
    """

    effort: Any
    effort_to_success: Any
    success_time: Any
    distance: Any
    reward: Any
    fallen: Any
    inside: Any


@dataclass(frozen=True)
class StepRules:
    """The rules at the end of a control step: who has fallen, who has arrived, at what cost.

    Attributes:
        settings: The task.
    """

    GIVEN = 9  # numbers in `Given`

    settings: CartPoleSettings

    def __call__(
        self, state: Sequence[Any], control: Sequence[Any], given: Sequence[Any], functions: Any
    ) -> Outcome:
        """Judge a step by x at its end, u and the numbers of `Given`."""
        before = Given(given[:4], *given[4:])
        (force,) = control
        distance = goal_distance(state, before.goal, functions.sqrt)
        spent = force * force * self.settings.control_period
        fallen = abs(state[1]) > FALL_ANGLE
        inside = (distance <= before.radius) & (abs(state[1]) <= FALL_ANGLE)
        # Before the first success its instant is infinitely late.
        still_open = before.success_time > before.time
        first_success = inside & still_open
        effort = before.effort + spent
        return Outcome(
            effort,
            where(still_open, effort, before.effort_to_success),
            where(first_success, before.time, before.success_time),
            distance,
            reward(self.settings, spent, distance, first_success, fallen),
            fallen,
            inside,
        )

    def lost(
        self, state: Sequence[Any], control: Sequence[Any], given: Sequence[Any], functions: Any
    ) -> Outcome:
        """Judge a step that could not be integrated: a fall, and x stays as it was before."""
        # Nothing is inside a tube of no radius.
        judged = self(state, control, [*given[:5], -1.0, *given[6:]], functions)
        (force,) = control
        spent = force * force * self.settings.control_period
        price = reward(self.settings, spent, judged.distance, False, True)
        return judged._replace(reward=price, fallen=True)


def reward(
    settings: CartPoleSettings, effort: Any, distance: Any, first_success: Any, fallen: Any
) -> Any:
    """Return the reward of one control step (floats or arrays).

    Args:
        settings: The task.
        effort: ||u||^2 dt of the step [N^2 s].
        distance: ||x - x_f|| after the step.
        first_success: Whether the step brought the first success.
        fallen: Whether the pole has fallen.

    Returns:
        -w_e ||u||^2 dt - w_d ||x - x_f|| dt + b_u dt [not fallen] + b_s [first success]. The
        distance counts as at most b_u / w_d, so that a step upright never costs more than falling.
    """
    period = settings.control_period
    reach = settings.upright_bonus - settings.distance_weight * distance
    stay = period * (0.5 * (reach + abs(reach)))
    return (
        -settings.effort_weight * effort
        + where(fallen, 0.0, stay)
        + where(first_success, settings.success_bonus, 0.0)
    )
