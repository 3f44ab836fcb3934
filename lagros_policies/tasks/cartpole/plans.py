"""Where target trajectories of the cart-pole lie, for the tubes around them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import check_fields
from lagros_envs.dynamics import System, control_matrix, jacobian
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.systems import check_cartpole

# Angles of x at which the condition is imposed; it is even in the state, so half of them do. For a
# held control, likewise, and those of y around each.
_ANGLES = 6
_HELD_ANGLES = 9


@dataclass(frozen=True)
class PlanBox:
    """Where the target trajectory lies; the position is free.

    Attributes:
        angle: Largest |theta_d| [rad].
        velocity: Largest |dp_d/dt| [m/s].
        angular_rate: Largest |dtheta_d/dt| [rad/s].
        force: Largest |u_d| [N].

    Raises:
        ValueError: A bound is negative or not finite.
    """

    angle: float = 0.1
    velocity: float = 1.0
    angular_rate: float = 0.2
    force: float = 1.0

    def __post_init__(self) -> None:
        check_fields(self, not_negative=[item.name for item in fields(self)])

    @property
    def bounded(self) -> list[int]:
        """Which coordinates are bounded: all but the position."""
        return [ANGLE, VELOCITY, ANGULAR_RATE]

    def with_errors(self, error: FloatArray) -> ProofBox:
        """Return the box of x and x_d for errors of at most `error`, shape (4,).

        Raises:
            ValueError: The errors are not four finite numbers >= 0, or the angle reaches pi/2.
        """
        values = np.asarray(error, dtype=np.float64)
        if values.shape != (4,) or not np.all(np.isfinite(values) & (values >= 0.0)):
            raise ValueError(f"error={values.tolist()!r} must be four finite numbers >= 0")
        return ProofBox(
            angle=self.angle + float(error[ANGLE]),
            velocity=self.velocity + float(error[VELOCITY]),
            angular_rate=self.angular_rate + float(error[ANGULAR_RATE]),
            force=self.force,
            angle_error=float(error[ANGLE]),
            angular_rate_error=float(error[ANGULAR_RATE]),
        )

    def samples(self, system: System, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return J(y, u_d), shape (s, 4, 4), and B(x), (s, 4, 1), at corners of the box.

        Raises:
            TypeError: The system is no cart-pole.
        """
        check_cartpole(system, "a PlanBox")
        box = self.with_errors(error)
        angles = np.linspace(0.0, box.angle, _ANGLES)
        gaps = np.array([-1.0, 0.0, 1.0]) * box.angle_error
        signs = np.array([-1.0, 1.0])
        # Friction makes a velocity act like a force: the two are extreme together.
        angle, gap, rate, drive = (
            part.ravel() for part in np.meshgrid(angles, gaps, signs, signs, indexing="ij")
        )
        x = np.zeros((len(angle), 4))
        x[:, ANGLE] = angle
        y = np.zeros_like(x)
        y[:, ANGLE] = np.clip(angle + gap, -box.angle, box.angle)
        y[:, ANGULAR_RATE] = rate * box.angular_rate
        y[:, VELOCITY] = -drive * box.velocity
        slope, _ = jacobian(system, y, drive[:, None] * box.force)
        return slope, control_matrix(system, x)

    def held_samples(
        self, system: System, error: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the same for a held control, and which to begin with: the outermost, (s,).

        J is affine in (w, w^2): its samples are at the corners of the tangents to the parabola.

        Raises:
            TypeError: The system is no cart-pole.
        """
        check_cartpole(system, "a PlanBox")
        box = self.with_errors(error)
        reach = min(box.angle_error, 2.0 * box.angle)
        gaps = np.linspace(-reach, reach, _HELD_ANGLES)
        # Where y reaches the edge of the box is one of them.
        angles = np.append(np.linspace(0.0, box.angle, _HELD_ANGLES), abs(box.angle - reach))
        place, offset, drive = (
            part.ravel()
            for part in np.meshgrid(
                range(len(angles)), range(len(gaps)), [-1.0, 1.0], indexing="ij"
            )
        )
        outer = np.isin(place, [0, _HELD_ANGLES - 1]) & np.isin(offset, [0, _HELD_ANGLES - 1])
        angle, gap = angles[place.astype(np.intp)], gaps[offset.astype(np.intp)]
        x, y = np.zeros((2, len(angle), 4))
        x[:, ANGLE], y[:, ANGLE] = angle, np.clip(angle + gap, -box.angle, box.angle)
        # Friction makes a velocity act like a force: the two are extreme together.
        y[:, VELOCITY] = -drive * box.velocity
        slopes = []
        for rate in (-box.angular_rate, 0.0, box.angular_rate):
            y[:, ANGULAR_RATE] = rate
            slopes.append(jacobian(system, y, drive[:, None] * box.force)[0])
        behind, still, ahead = slopes
        tip = 0.25 * (ahead - behind)
        slope = np.concatenate([behind, ahead, still - tip, still + tip])
        return slope, np.tile(control_matrix(system, x), (4, 1, 1)), np.tile(outer, 4)
