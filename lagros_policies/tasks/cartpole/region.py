"""The region of the cart-pole's metrics."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import check_positive
from lagros_envs.tasks.cartpole.physics import ANGLE
from lagros_policies.contraction.regions import BoxRegion, Samples

_STATES = 4  # [p, theta, dp/dt, dtheta/dt]


@dataclass(frozen=True)
class Region:
    """The states and errors for which a cart-pole metric was designed and checked.

    The check draws triples (x, x_d, u_d) around plans and keeps those that lie within these bounds.
    On a plan the force goes with the angle, so that this covers a part of the bounds only: taken as
    a box of independent numbers they hold states at which the shipped metric fails. `prove` says
    what holds on a whole box. Neither the metric nor its condition depends on the position, and
    that of x_d's speed is bounded by the plans alone.

    Attributes:
        angle: Largest |theta| of x and of x_d [rad].
        angular_rate: Largest |dtheta/dt| of x and of x_d [rad/s].
        angle_error: Largest |theta - theta_d| [rad].
        angular_rate_error: Largest error of the rate [rad/s].
        force: Largest |u_d| [N].

    Raises:
        ValueError: A bound is not positive, or the angle reaches pi/2.
    """

    angle: float = 1.15
    angular_rate: float = 4.0
    angle_error: float = 0.35
    angular_rate_error: float = 2.0
    force: float = 40.0

    # Units in which the condition number of its metrics is measured.
    scaling: ClassVar[tuple[float, ...]] = (1.0, 12.0, 1.0, 1.5)

    def __post_init__(self) -> None:
        for item in fields(self):
            check_positive(item.name, getattr(self, item.name))
        if self.angle >= math.pi / 2:
            raise ValueError(
                f"angle={self.angle!r} must be below pi/2, where the force loses its authority"
            )

    @property
    def even(self) -> tuple[int, float]:
        """In which coordinate it is symmetric, and how far that reaches: the angle."""
        return ANGLE, self.angle

    @property
    def box(self) -> BoxRegion:
        """The same triples, position and speed free."""
        inf = math.inf
        return BoxRegion(
            low=(-inf, -self.angle, -inf, -self.angular_rate),
            high=(inf, self.angle, inf, self.angular_rate),
            error=(inf, self.angle_error, inf, self.angular_rate_error),
            control_low=(-self.force,),
            control_high=(self.force,),
        )

    def sample(self, rng: np.random.Generator, count: int) -> Samples:
        """Draw triples within the bounds, positions and speeds within 1 m and 1 m/s.

        They are independent of each other: plans are not asked, see above.
        """
        return self.box.sample(rng, count)

    def contains(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> BoolArray:
        """Return which triples (x, x_d, u_d) of a batch (..., 4), (..., 4), (..., 1) lie inside.

        Raises:
            ValueError: They are not of the cart-pole's four states and one control.
        """
        shapes = [np.shape(part)[-1:] for part in (state, nominal, nominal_control)]
        if shapes != [(_STATES,), (_STATES,), (1,)]:
            raise ValueError(
                f"states and control end in {shapes}: a Region bounds the cart-pole's four states "
                "[p, theta, dp/dt, dtheta/dt] and one force; for other systems there are BoxRegion "
                "and PlanRegion"
            )
        return self.box.contains(state, nominal, nominal_control)
