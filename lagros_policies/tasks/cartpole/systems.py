"""Which systems and metrics the cart-pole's own functions are for."""

from __future__ import annotations

from typing import Any

from lagros_envs.checks import shown
from lagros_envs.tasks.cartpole.physics import ANGLE, CartPole
from lagros_policies.contraction.basis import cosines
from lagros_policies.contraction.metric import Metric
from lagros_policies.tasks.cartpole.region import Region


def check_cartpole(system: Any, what: str) -> CartPole:
    """Return a system that is the cart-pole; refuse every other, and those derived from it.

    Args:
        system: The system.
        what: Who uses its structure, as the message names it.

    Raises:
        TypeError: It is another.
    """
    if type(system) is not CartPole:
        raise TypeError(
            f"system={system!r} must be a CartPole: {what} uses the structure of its equations, "
            "which no other class is known to have"
        )
    return system


def check_cartpole_metric(metric: Any, what: str) -> None:
    """Refuse what is no polynomial metric of the cart-pole's states; arguments as above.

    Raises:
        TypeError: It is no `Metric`: of a network, say, nothing is proved.
        ValueError: It is of other than four states, or not of cos(theta) on a `Region`.
    """
    if not isinstance(metric, Metric):
        raise TypeError(f"metric={metric!r} must be a Metric: {what} uses its coefficients")
    if len(metric.scaling) != CartPole().state_dim:
        raise ValueError(
            f"the metric is of {len(metric.scaling)} states: {what} is for those of the cart-pole, "
            "[p, theta, dp/dt, dtheta/dt]"
        )
    angle = metric.point == "state" and metric.phi == cosines(ANGLE, len(metric.coefficients) - 1)
    if not angle or not isinstance(metric.region, Region):
        raise ValueError(
            f"the metric is of {shown(metric.phi.terms)} at the {metric.point}, on a "
            f"{type(metric.region).__name__}: {what} is for 1, cos(x[{ANGLE}]), ... at the state, "
            "on a Region"
        )
