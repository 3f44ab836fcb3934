"""A Segway in the plane: a body on one axle, driven by a motor between body and wheels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lagros_envs.checks import check_constants
from lagros_envs.dynamics.system import Components


@dataclass(frozen=True, slots=True)
class Segway:
    """A body that leans over the axle of two wheels which roll without slip.

    State x = [p, theta, dp/dt, dtheta/dt] in [m, rad, m/s, rad/s], p along the ground and theta = 0
    upright. Control u = [voltage of the motor] in [V]. With the kinetic energy
    a v^2/2 + b cos(theta) v omega + c omega^2/2 and the potential one b g cos(theta), only a/b and
    c/b matter; the motor pushes the ground by f and turns the body by -R f, and loses push with the
    speed at which the wheels turn in the body. The values give the eleven coefficients of the
    Segway of C3M (Sun, Jha & Fan 2021) to all the digits printed there; docs/systems/segway.md says
    which of its terms disagree with mechanics.

    Attributes:
        gravity: g [m/s^2].
        moving_mass: a/b, all that moves along the ground, per first moment of the body [1/m].
        leaning_inertia: c/b, inertia of the body about the axle, per the same [m].
        wheel_radius: R [m].
        motor: Push f/b of one volt [1/(V s^2)].
        drag: Push f/b that the motor loses per speed v - R omega of the wheels [1/(m s)].

    Raises:
        ValueError: A value is not positive, or a c <= b^2: no body has such masses.
    """

    gravity: float = 9.81
    moving_mass: float = 21.235
    leaning_inertia: float = 1.1633
    wheel_radius: float = 0.195
    motor: float = 9.33
    drag: float = 58.8

    dissipates = True
    mirror = (-1, -1, -1, -1), (-1,)

    def __post_init__(self) -> None:
        check_constants(self)
        product = self.moving_mass * self.leaning_inertia
        if product <= 1.0:
            raise ValueError(
                f"moving_mass={self.moving_mass:g} times leaning_inertia="
                f"{self.leaning_inertia:g} must be above 1: the energy would be negative"
            )

    @property
    def state_dim(self) -> int:
        """Number of states, 4."""
        return 4

    @property
    def control_dim(self) -> int:
        """Number of controls, 1."""
        return 1

    def energy(self, state: Components, functions: Any) -> Any:
        """Return the energy, divided by b [m/s^2]."""
        _, lean, speed, rate = state
        cosine = functions.cos(lean)
        moving = self.moving_mass * speed**2 + self.leaning_inertia * rate**2
        return 0.5 * moving + cosine * (speed * rate + self.gravity)

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt, Lagrange's equations solved for the two accelerations.

        Args:
            state: [p, theta, dp/dt, dtheta/dt], numbers of any kind.
            control: [voltage].
            functions: Namespace with `sin` and `cos` for that kind of number.

        Returns:
            The four rates, in the units of the state per second.
        """
        _, lean, speed, rate = state
        (voltage,) = control
        sine, cosine = functions.sin(lean), functions.cos(lean)
        push = self.motor * voltage - self.drag * (speed - self.wheel_radius * rate)
        # Of the ground and of the body, both divided by b.
        along = push + rate**2 * sine
        torque = self.gravity * sine - self.wheel_radius * push
        determinant = self.moving_mass * self.leaning_inertia - cosine**2
        return (
            speed,
            rate,
            (self.leaning_inertia * along - cosine * torque) / determinant,
            (self.moving_mass * torque - cosine * along) / determinant,
        )
