"""The cart-pole of Barto, Sutton and Anderson (1983) with viscous friction of the cart."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from lagros_envs.checks import (
    LARGEST,
    check_at_least,
    check_at_most,
    check_fields,
    check_not_negative,
    check_positive,
)
from lagros_envs.dynamics.system import Components
from lagros_envs.values import use_plain_numbers

POSITION, ANGLE, VELOCITY, ANGULAR_RATE = range(4)


@dataclass(frozen=True, slots=True)
class CartPole:
    """A pole hinged on a cart, driven by a horizontal force on the cart.

    State x = [p, theta, dp/dt, dtheta/dt] in [m, rad, m/s, rad/s]; theta = 0 is upright.
    Control u = [force] in [N].

    Attributes:
        gravity: g [m/s^2].
        cart_mass: m_c [kg].
        pole_mass: m [kg].
        cart_friction: mu_c, viscous [N s/m].
        pole_friction: mu_p [N m s].
        half_length: l, from the hinge to the middle of the pole [m].

    Raises:
        ValueError: A mass, length or gravity is not positive, or a friction is negative.
    """

    gravity: float = 9.8
    cart_mass: float = 1.0
    pole_mass: float = 0.1
    cart_friction: float = 0.5
    pole_friction: float = 0.002
    half_length: float = 0.5

    mirror = (-1, -1, -1, -1), (-1,)

    def __post_init__(self) -> None:
        check_fields(self)
        use_plain_numbers(self)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("friction"):
                check_not_negative(field.name, value)
            else:
                check_positive(field.name, value)
                # Less, and products of them vanish.
                check_at_least(field.name, value, 1.0 / LARGEST)
            check_at_most(field.name, value, LARGEST)

    @property
    def state_dim(self) -> int:
        """Number of states, 4."""
        return 4

    @property
    def control_dim(self) -> int:
        """Number of controls, 1."""
        return 1

    @property
    def dissipates(self) -> bool:
        """Whether friction takes energy."""
        return self.cart_friction > 0.0 or self.pole_friction > 0.0

    def energy(self, state: Components, functions: Any) -> Any:
        """Return the energy of cart and pole, a uniform rod [J]."""
        _, angle, velocity, angular_rate = state
        cosine, moment = functions.cos(angle), self.pole_mass * self.half_length
        turning = (4.0 / 3.0) * self.half_length * angular_rate * angular_rate
        moving = 0.5 * (self.cart_mass + self.pole_mass) * velocity * velocity
        coupled = cosine * velocity * angular_rate
        return moving + moment * (coupled + 0.5 * turning + self.gravity * cosine)

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt (Barto et al. 1983, viscous friction in place of its sign).

        Args:
            state: [p, theta, dp/dt, dtheta/dt], each a float, an array or a dual.
            control: [force].
            functions: Namespace with `sin` and `cos` for that kind of number.

        Returns:
            The four rates, in the units of the state per second.
        """
        _, angle, velocity, angular_rate = state
        (force,) = control
        sine, cosine = functions.sin(angle), functions.cos(angle)
        total_mass = self.cart_mass + self.pole_mass
        pole_moment = self.pole_mass * self.half_length
        centrifugal = pole_moment * (angular_rate * angular_rate) * sine
        drive = (force + centrifugal - self.cart_friction * velocity) / total_mass
        torque = self.gravity * sine - cosine * drive
        torque = torque - (self.pole_friction / pole_moment) * angular_rate
        inertia = self.half_length * (4.0 / 3.0 - (self.pole_mass / total_mass) * cosine * cosine)
        angular_acceleration = torque / inertia
        acceleration = drive - (pole_moment / total_mass) * angular_acceleration * cosine
        return velocity, angular_rate, acceleration, angular_acceleration
