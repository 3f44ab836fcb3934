"""How much time a spacecraft takes for what is left of its way."""

from __future__ import annotations

from typing import Any

from lagros_envs.numbers.functions import maximum

CRUISE_SPEED = 0.3  # mean speed on the straight line that nobody has to exceed [m/s]
LEAST_TIME = 2.0  # [s]


def time_to_go(distance: Any, left: Any) -> Any:
    """Return the time that an agent still takes: who is late arrives late, and does not rush.

    The expert plans with it and the networks see it, so that to be late is nothing new to them: an
    agent on its way long after the horizon is one that left later.

    Args:
        distance: To the goal, a number of any kind or an array (B,) [m].
        left: Until the horizon, may be negative, shape (B,) or one for all [s].

    Returns:
        max(left, distance / CRUISE_SPEED, LEAST_TIME), shape (B,) [s].
    """
    return maximum(left, maximum(distance * (1.0 / CRUISE_SPEED), LEAST_TIME))
