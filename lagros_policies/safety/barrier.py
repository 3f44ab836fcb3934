"""The braking barrier of the safety filter: which accelerations keep clear of what is sensed.

Let g be the gap to a neighbour or an obstacle beyond a margin, along the line of centres n, and
g' its rate. The agent may close the gap no faster than it can still brake,

    g' >= -phi(g),    phi(g) = k g                                near or inside the margin,
                               sqrt(2 a g - (a / k)^2)            beyond g = a / k^2,

so that it brakes with a at most from afar and returns out of the margin at the rate k. The
condition is imposed on the end of the hold h, with phi linearised where the agent would be without
thrust: one half-plane of accelerations,

    n'v (h + h^2 phi' / 2) >= -g' - phi(g + h g').

With g >= 0, g' >= -k g and k h <= 1 the gap along n then stays open throughout the hold: its end
satisfies (2/h + k) g+ >= 2 g/h + g' >= 0, and in between it is above the straight line or above
g (1 - k t). That n turns from hold to hold, and the disturbance, are left to the margin: that
nothing is touched is observed, not proved.

Of two agents each answers for one half of the acceleration, as both use the filter; against an
obstacle the agent answers for all.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import (
    check_disturbance_bound,
    check_fields,
    check_not_negative,
    check_positive,
)

# Closer centres have no direction [m].
_SAME_PLACE = 1e-9
# Margins [m] at no disturbance and per unit of its bound: with them the policy that flies straight
# to its goal collides for less than 0.5 % of agents (`benchmarks/studies/safety_filter.py`).
# A push moves an agent by at most 0.1 d_bar in a hold; the margin covers that and what the return
# at the rate k leaves of earlier pushes. Twice the obstacle's margin must fit between obstacles,
# which stand 0.3 m further apart than touching in the preset `paper`.
_PAIR_MARGIN = (0.03, 0.25)
_OBSTACLE_MARGIN = (0.01, 0.145)
# The same for what counts as blocked [m/s]: velocities are as noisy as the disturbance is large. A
# larger one frees more agents, and meddles more with a policy that slows down on purpose.
_BLOCKED_SPEED = (0.02, 0.3)


@dataclass(frozen=True)
class BarrierSettings:
    """How the safety filter keeps clear; the defaults are those for a bound of 0.4.

    Attributes:
        pair_margin: Room beyond touching that two agents keep [m].
        obstacle_margin: Room beyond touching that agent and obstacle keep [m].
        pair_rate: k between agents [1/s].
        obstacle_rate: k against obstacles [1/s]; larger as their margin is smaller.
        braking: a, deceleration from afar [m/s^2].
        largest_acceleration: The filter commands no more along either axis of the body, unless the
            policy did [m/s^2]: in a wedge that two half-planes leave open, the nearest point can be
            far off.
        sidestep_speed: Speed along the rim of what blocks the way that the filter aims at; 0 leaves
            the agent where it is blocked [m/s].
        sidestep_rate: How fast it gets there [1/s].
        blocked_speed: An agent that nears its goal more slowly than this counts as blocked, if what
            it must not touch lies in the way [m/s].

    Raises:
        ValueError: A value is out of range.
    """

    pair_margin: float = 0.13
    obstacle_margin: float = 0.068
    pair_rate: float = 6.0
    obstacle_rate: float = 9.0
    braking: float = 1.0
    largest_acceleration: float = 4.0
    sidestep_speed: float = 0.4
    sidestep_rate: float = 6.0
    blocked_speed: float = 0.14

    def __post_init__(self) -> None:
        check_fields(self)
        may_be_zero = (
            "pair_margin",
            "obstacle_margin",
            "sidestep_speed",
            "sidestep_rate",
            "blocked_speed",
        )
        for item in fields(self):
            check = check_not_negative if item.name in may_be_zero else check_positive
            check(item.name, getattr(self, item.name))

    @classmethod
    def for_bound(cls, disturbance_bound: float) -> BarrierSettings:
        """Return the settings that were tuned for a disturbance bound.

        Args:
            disturbance_bound: d_bar of the six states together, in units of the state per second.

        Raises:
            ValueError: The bound is negative or not finite.
        """
        check_disturbance_bound("disturbance_bound", disturbance_bound)
        pair, obstacle, blocked = (
            base + slope * disturbance_bound
            for base, slope in (_PAIR_MARGIN, _OBSTACLE_MARGIN, _BLOCKED_SPEED)
        )
        return cls(pair_margin=pair, obstacle_margin=obstacle, blocked_speed=blocked)


class HalfPlanes(NamedTuple):
    """The accelerations that keep clear, n'a >= b, one half-plane for each slot.

    n points from what must not be touched to the agent, and is zero where nothing is sensed. Every
    array has the shape (B, k + m), neighbours first.

    Attributes:
        x: First component of n.
        y: Second component of n.
        bounds: b [m/s^2].
        speed_x: Velocity of the agent relative to what it must not touch [m/s].
        speed_y: Its second component [m/s].
    """

    x: FloatArray
    y: FloatArray
    bounds: FloatArray
    speed_x: FloatArray
    speed_y: FloatArray


@dataclass(frozen=True)
class BrakingBarrier:
    """The barrier around neighbours and obstacles.

    Attributes:
        settings: Margins and rates.
        agent_radius: As of the preset [m].
        core_radius: Radius of the agents against obstacles [m].
        period: h, for which an acceleration is held [s].

    Raises:
        ValueError: A rate is so fast that the gap could close within a hold.
    """

    settings: BarrierSettings
    agent_radius: float
    core_radius: float
    period: float

    def __post_init__(self) -> None:
        for name in ("pair_rate", "obstacle_rate"):
            rate = getattr(self.settings, name)
            if rate * self.period > 1.0:
                raise ValueError(
                    f"{name}={rate!r} 1/s must be at most 1 / control_period = "
                    f"{1.0 / self.period:g} 1/s"
                )

    def allowed_speed(
        self, gap: FloatArray, rate: FloatArray, braking: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return phi [m/s] and its slope [1/s].

        Args:
            gap: g, shape (..., s) [m]; may be negative.
            rate: k, shape (s,) [1/s].
            braking: a, shape (s,) [m/s^2].
        """
        knee = braking / rate
        beyond = np.sqrt(np.maximum(2.0 * braking * gap - knee * knee, knee * knee))
        straight = rate * gap
        near = straight < knee
        return np.where(near, straight, beyond), np.where(near, rate, braking / beyond)

    def half_planes(
        self,
        velocity: FloatArray,
        neighbours: FloatArray,
        neighbour_mask: BoolArray,
        obstacles: FloatArray,
        obstacle_mask: BoolArray,
    ) -> HalfPlanes:
        """Return the half-planes for what each of B agents senses, neighbours first.

        Args:
            velocity: Of the agents, shape (B, 2) [m/s].
            neighbours: Positions and velocities relative to the agent, shape (B, k, 4) [m, m/s].
            neighbour_mask: Which slots hold one, shape (B, k).
            obstacles: Centres relative to the agent and radii, shape (B, m, 3) [m].
            obstacle_mask: Which slots hold one, shape (B, m).
        """
        others = neighbour_mask.shape[1]
        share, rates, braking, room = self._by_slot(others, obstacle_mask.shape[1])
        h = self.period
        # From the other to the agent, so that the rate of a gap that closes is negative.
        x, y = (_joined(neighbours[..., i], obstacles[..., i]) for i in (0, 1))
        speed_x, speed_y = np.empty_like(x), np.empty_like(y)
        for index, speed in enumerate((speed_x, speed_y)):
            speed[:, :others] = -neighbours[..., 2 + index]
            speed[:, others:] = velocity[:, index : index + 1]
        distance = np.sqrt(x * x + y * y)
        present = _joined(neighbour_mask, obstacle_mask)
        scale = present / np.maximum(distance, _SAME_PLACE)
        x *= -scale
        y *= -scale
        rate = x * speed_x + y * speed_y
        coasting = distance - room + h * rate
        coasting[:, others:] -= obstacles[..., 2]
        allowed, slope = self.allowed_speed(coasting, rates, braking)
        bounds = -share * (rate + allowed) / (h + 0.5 * h * h * slope)
        return HalfPlanes(x, y, np.where(present, bounds, -1.0), speed_x, speed_y)

    @lru_cache(maxsize=8)  # noqa: B019  # a barrier is small, and lives as long as its filter
    def _by_slot(
        self, neighbours: int, obstacles: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return share, k, a and the distance of centres at a gap of zero, less the radius."""
        kept, count = self.settings, [neighbours, obstacles]
        share = np.repeat([0.5, 1.0], count)
        rates = np.repeat([kept.pair_rate, kept.obstacle_rate], count)
        room = np.repeat(
            [
                2.0 * self.agent_radius + kept.pair_margin,
                self.core_radius + kept.obstacle_margin,
            ],
            count,
        )
        return share, rates, kept.braking / share, room


def _joined(neighbours: NDArray[Any], obstacles: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([neighbours, obstacles], axis=1)
