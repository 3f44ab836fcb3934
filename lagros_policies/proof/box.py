"""The continuous set on which a condition of the cart-pole is proved."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from lagros_envs.checks import check_fields, check_not_negative


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
        check_fields(self)
        for item in fields(self):
            check_not_negative(item.name, getattr(self, item.name))
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
        names = [item.name for item in fields(self) if item.name != "lean"]
        return replace(self, **{name: factor * getattr(self, name) for name in names})
