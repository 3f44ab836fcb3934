"""The continuous set on which a condition of the cart-pole is proved."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class ProofBox:
    """The continuous set on which the condition is proved, symmetric about the upright.

    The position enters neither the metric nor the motion and is free. The force u_d may lean: it
    lies within `force` of c b(theta_d), where b is the force that holds the pole still at the angle
    of x_d and c is any number from 0 to `lean`. With a lean of 0 that is |u_d| <= force.

    Attributes:
        angle: Largest |theta| of x and x_d [rad].
        velocity: Largest |dp/dt| of x and x_d [m/s].
        angular_rate: Largest |dtheta/dt| of x and x_d [rad/s].
        force: Largest |u_d| [N], beside the lean.
        angle_error: Largest |theta - theta_d| [rad].
        angular_rate_error: Largest error of the rate [rad/s].
        lean: Largest share of the force that holds the pole still.

    Raises:
        ValueError: A bound is negative or not finite, or the angle is not below pi/2.
    """

    angle: float
    velocity: float
    angular_rate: float
    force: float
    angle_error: float = 0.0
    angular_rate_error: float = 0.0
    lean: float = 0.0

    def __post_init__(self) -> None:
        """Check the bounds."""
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name}={value!r} must be finite and >= 0")
        if self.angle >= math.pi / 2:
            raise ValueError(f"angle={self.angle!r} must be below pi/2")

    @classmethod
    def apart(
        cls, angle: float, velocity: float, angular_rate: float, force: float, lean: float = 0.0
    ) -> ProofBox:
        """Return the box in which x and x_d lie anywhere, each for itself."""
        return cls(angle, velocity, angular_rate, force, 2.0 * angle, 2.0 * angular_rate, lean)

    def scaled(self, factor: float) -> ProofBox:
        """Return the box with every bound but the lean times a factor."""
        names = [name for name in self.__dataclass_fields__ if name != "lean"]
        return replace(self, **{name: factor * getattr(self, name) for name in names})
