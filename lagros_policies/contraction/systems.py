"""Which systems the functions of this package are for: everything else is refused by name.

Most take any control-affine `System`. Where a metric depends on an angle, its rate is taken from
the state: that is right for a system whose state 1 moves at the rate of state 3, whatever the
control (`check_angle`). What uses the equations of the cart-pole or of the spacecraft further than
that (proofs, corners of boxes, thrusters) is for these two alone, not for a class derived from one,
whose equation may be another.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import CartPole, System
from lagros_envs.dynamics.cartpole import ANGLE, ANGULAR_RATE
from lagros_envs.dynamics.spacecraft import Spacecraft
from lagros_policies.contraction.metric import Metric

FloatArray = NDArray[np.float64]


def check_cartpole(system: Any, what: str) -> CartPole:
    """Return a system that is the cart-pole, and refuse every other.

    Args:
        system: The system.
        what: Who uses its structure, as the message names it.

    Raises:
        TypeError: It is no `CartPole`, or of a class derived from it.
    """
    _check_class("system", system, CartPole, what)
    cartpole: CartPole = system
    return cartpole


def check_cartpole_metric(metric: Any, what: str) -> None:
    """Refuse what is no polynomial metric of the cart-pole's states; arguments as above.

    Raises:
        TypeError: It is no `Metric`: of a network, say, nothing is proved.
        ValueError: It is of other than four states.
    """
    if not isinstance(metric, Metric):
        raise TypeError(f"metric={metric!r} must be a Metric: {what} uses its coefficients")
    if len(metric.scaling) != CartPole().state_dim:
        raise ValueError(
            f"the metric is of {len(metric.scaling)} states: {what} is for those of the cart-pole, "
            "[p, theta, dp/dt, dtheta/dt]"
        )


def check_spacecraft(body: Any, what: str) -> None:
    """Refuse whatever is not the spacecraft; arguments as of `check_cartpole`.

    Raises:
        TypeError: It is no `Spacecraft`, or of a class derived from it.
    """
    _check_class("body", body, Spacecraft, what)


def check_sizes(system: System, **arrays: tuple[FloatArray, tuple[int, ...]]) -> None:
    """Check the last axes of arrays against what a system has.

    Args:
        system: The system, which the message names.
        arrays: By name, an array and what the ends of its shape must be.

    Raises:
        ValueError: An array has other ends.
    """
    for name, (array, ends) in arrays.items():
        if np.shape(array)[-len(ends) :] != ends:
            wanted = ", ".join(("...", *map(str, ends)))
            raise ValueError(
                f"{name} of shape {np.shape(array)} must be ({wanted}) for {system!r} with "
                f"{system.state_dim} states and {system.control_dim} controls"
            )


def check_angle(system: System, state: FloatArray, motion: FloatArray, gain: FloatArray) -> None:
    """Check, at given states, that state 1 of a system moves at the rate of state 3.

    Args:
        system: The system.
        state: x, shape (..., n).
        motion: dx/dt, shape (..., n).
        gain: B(x), shape (..., n, m).

    Raises:
        ValueError: It moves otherwise, or is moved by the control.
    """
    if np.shape(state)[-1] > ANGULAR_RATE:
        apart = np.abs(motion[..., ANGLE] - state[..., ANGULAR_RATE])
        # What is not a number is no evidence of another motion.
        if not (np.any(gain[..., ANGLE, :]) or np.any(apart > 0.0)):
            return
    raise ValueError(
        f"a metric of cos(x[{ANGLE}]) is for systems with dx[{ANGLE}]/dt = x[{ANGULAR_RATE}], as "
        f"the cart-pole's [p, theta, dp/dt, dtheta/dt]; {system!r} is none: use a constant metric "
        "(degree 0) or a metric of your own, whose dual_rate knows the system"
    )


def _check_class(name: str, value: Any, wanted: type, what: str) -> None:
    if type(value) is not wanted:
        raise TypeError(
            f"{name}={value!r} must be a {wanted.__name__}: {what} uses the structure of its "
            "equations, which no other class is known to have"
        )
