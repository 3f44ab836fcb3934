"""The planar spacecraft simulator of the paper: a rigid body with thrusters that only push."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lagros_envs.checks import check_constants
from lagros_envs.dynamics.system import Components

X, Y, HEADING, VELOCITY_X, VELOCITY_Y, SPIN = range(6)


@dataclass(frozen=True, slots=True)
class Spacecraft:
    """A rigid body that floats on a plane, driven by eight thrusters in opposing pairs.

    State x = [p_x, p_y, phi, v_x, v_y, omega] in [m, m, rad, m/s, m/s, rad/s]. The body's axes are
    (cos phi, -sin phi) and (sin phi, cos phi): a positive heading turns clockwise.
    Control u >= 0, the forces of the thrusters [N]; B B' is the same at every heading.

    Attributes:
        mass: m [kg].
        inertia: I [kg m^2]; the paper's model turns with torque / (2 I).
        arm: l, lever of the thrusters along the first body axis [m].
        side_arm: b, lever of the thrusters along the second body axis [m].

    Raises:
        ValueError: A value is not positive and finite.
    """

    mass: float = 1.0
    inertia: float = 1.0
    arm: float = 1.0
    side_arm: float = 1.0

    def __post_init__(self) -> None:
        check_constants(self)

    @property
    def state_dim(self) -> int:
        """Number of states, 6."""
        return 6

    @property
    def control_dim(self) -> int:
        """Number of controls, 8."""
        return 8

    @property
    def by_wrench(self) -> SpacecraftByWrench:
        """The same body, driven by a wrench in its own axes."""
        return SpacecraftByWrench(self)

    def energy(self, state: Components, functions: Any) -> Any:
        """Return the energy, with twice the inertia as in the paper's model [J]."""
        _, _, _, velocity_x, velocity_y, spin = state
        moving = 0.5 * self.mass * (velocity_x * velocity_x + velocity_y * velocity_y)
        return moving + self.inertia * spin * spin

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt.

        Args:
            state: [p_x, p_y, phi, v_x, v_y, omega], each a float, an array or a dual.
            control: The eight forces [N].
            functions: Namespace with `sin` and `cos` for that kind of number.

        Returns:
            The six rates, in the units of the state per second.
        """
        return self.motion(state, self.wrench(control), functions)

    def wrench(self, control: Components) -> Components:
        """Return H u, the forces along the body's two axes [N] and the torque [N m]."""
        u1, u2, u3, u4, u5, u6, u7, u8 = control
        along, aside = self.arm, self.side_arm
        torque = along * (u2 - u1 + u6 - u5) + aside * (u4 - u3 + u8 - u7)
        return u5 + u6 - u1 - u2, u7 + u8 - u3 - u4, torque

    def motion(self, state: Components, wrench: Components, functions: Any) -> Components:
        """Return dx/dt under a wrench in the body's axes.

        Args:
            state: As in `derivative`.
            wrench: [force, force, torque] as `wrench` returns it.
            functions: As in `derivative`.
        """
        _, _, heading, velocity_x, velocity_y, spin = state
        first, second, torque = wrench
        sine, cosine = functions.sin(heading), functions.cos(heading)
        return (
            velocity_x,
            velocity_y,
            spin,
            (cosine * first + sine * second) / self.mass,
            (cosine * second - sine * first) / self.mass,
            torque / (2.0 * self.inertia),
        )


@dataclass(frozen=True, slots=True)
class SpacecraftByWrench:
    """A `Spacecraft` as a system with three controls: the wrench that its thrusters make.

    A held control is a held wrench, so that the thrusters are summed once per control step.

    Attributes:
        body: The spacecraft.
    """

    body: Spacecraft

    @property
    def state_dim(self) -> int:
        """Number of states, 6."""
        return self.body.state_dim

    @property
    def control_dim(self) -> int:
        """Number of controls, 3."""
        return 3

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt from the wrench [N, N, N m] in the body's axes."""
        return self.body.motion(state, control, functions)


def check_spacecraft(body: Any, what: str) -> None:
    """Refuse whatever is not the spacecraft, whose thrusters are elsewhere.

    Args:
        body: The spacecraft.
        what: Who uses its structure, as the message names it.

    Raises:
        TypeError: It is no `Spacecraft`, or of a class derived from it.
    """
    if type(body) is not Spacecraft:
        raise TypeError(
            f"body={body!r} must be a Spacecraft: {what} uses the structure of its equations, "
            "which no other class is known to have"
        )
