"""The continuous set on which a condition of the cart-pole is proved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import check_fields
from lagros_envs.dynamics import System
from lagros_envs.numbers import Interval, exact, functions
from lagros_envs.tasks.cartpole.physics import ANGLE, VELOCITY, CartPole
from lagros_policies.contraction.places import Point
from lagros_policies.proof.sets import ProofSet, Triple, boxed
from lagros_policies.tasks.cartpole.region import Region
from lagros_policies.tasks.cartpole.systems import check_cartpole


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
        check_fields(self, not_negative=[item.name for item in fields(self)])
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

    @property
    def region(self) -> Region:
        """The box as the region of a metric, but for velocity and lean."""
        least = 1e-9
        return Region(
            angle=self.angle,
            angular_rate=self.angular_rate,
            angle_error=max(self.angle_error, least),
            angular_rate_error=max(self.angular_rate_error, least),
            force=max(self.force, least),
        )

    def push(self, system: CartPole) -> float:
        """Bound f = u_d - mu_c dp/dt, through which alone cart and force act, less the lean [N]."""
        return float((exact(self.velocity) * system.cart_friction + self.force).upper)

    def proof_set(self, system: System, point: Point = "state") -> ProofSet:
        """Return the triples of the box for the conditions on the derivative.

        The last two coordinates are the push and the share of the lean. The map
        (x, y, u_d) -> -(x, y, u_d) changes nothing, so that one angle may be taken to be positive.

        Raises:
            TypeError: The system is no cart-pole.
            ValueError: The metric is of x_d.
        """
        body = check_cartpole(system, "a ProofBox")
        if point != "state":
            raise ValueError(f"point={point!r}: a ProofBox is for metrics of x; give a BoxRegion")
        push = self.push(body)
        # u_d leans with x_d, which is one more state where it is not y.
        three = self.lean > 0.0 and self.angle_error > 0.0
        half = np.array([0.0, self.angle, 0.0, self.angular_rate])
        error = np.array([0.0, self.angle_error, 0.0, self.angular_rate_error])
        ends = (-push, 0.0), (push, self.lean)
        plain = boxed(-half, half, error, *ends, "nominal" if three else "state")
        shares = np.array([self.velocity, self.force]) / max(push, 1e-300)

        def triple(coordinates: Sequence[Any], middle: Sequence[FloatArray]) -> Triple:
            found = plain.triple(coordinates, middle)
            drive, lean = found.control
            # Speed and force act together, against each other.
            control = drive * float(shares[1]) + lean * balance(body, found.state[ANGLE])
            place, between = (
                [*part[:VELOCITY], drive * -float(shares[0]), *part[VELOCITY + 1 :]]
                for part in (found.place, found.between)
            )
            return Triple(place, between, place, [control])

        lower = plain.lower.copy()
        lower[ANGLE] = 0.0
        return replace(plain, lower=lower, triple=triple)

    def held_set(self, system: System) -> ProofSet:
        """Return x and u_d of the box for the condition over a hold, by angle, rate and push.

        The speed of the cart enters through the push alone, during the hold too, so that it may be
        taken as zero at the start. Errors are not used.

        Raises:
            TypeError: The system is no cart-pole.
        """
        body = check_cartpole(system, "a ProofBox")
        push = self.push(body)

        def largest(angle: Interval) -> FloatArray:
            return np.asarray((balance(body, angle) * self.lean + push).upper)

        def triple(coordinates: Sequence[Any], middle: Sequence[FloatArray]) -> Triple:
            angle, rate, drive = coordinates
            state = [angle * 0.0, angle, angle * 0.0, rate]
            return Triple(state, state, state, [drive])

        def outside(cells: Interval) -> BoolArray:
            beyond: BoolArray = cells.lower[:, 2] > largest(cells[:, 0])
            return beyond

        return ProofSet(
            np.array([0.0, -self.angular_rate, -push]),
            np.array([self.angle, self.angular_rate, largest(exact(self.angle))]),
            triple,
            [()] * 3,
            outside,
        )


def balance(system: CartPole, angle: Any) -> Any:
    """Return the force that holds the pole still at an angle, intervals or series of them [N]."""
    return functions.tan(angle) * ((exact(system.cart_mass) + system.pole_mass) * system.gravity)
