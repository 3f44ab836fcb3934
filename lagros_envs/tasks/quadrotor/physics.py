"""The quadrotor of Singh et al. (2019) and C3M (Sun, Jha & Fan 2021), driven by rates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from lagros_envs.checks import check_constants
from lagros_envs.dynamics.system import Components


@dataclass(frozen=True, slots=True)
class Quadrotor:
    """A body in space that pushes along its own axis and turns at the rates that it is told.

    State x = [p_x, p_y, p_z, v_x, v_y, v_z, tau, phi, theta] in [m, m/s, -, rad], the z axis
    pointing up, tau the thrust in units of the weight. Control u = d/dt [tau, phi, theta] in
    [1/s, rad/s]: near a hover each of them is a jerk, in units of g. C3M has the thrust over the
    mass, g tau, in place of tau, and all axes reversed (its z axis points down).

    Attributes:
        gravity: g [m/s^2].

    Raises:
        ValueError: A value is not positive.
    """

    gravity: float = 9.81

    mirror: ClassVar[tuple[tuple[int, ...], ...]] = (-1, 1, 1, -1, 1, 1, 1, 1, -1), (1, 1, -1)

    def __post_init__(self) -> None:
        check_constants(self)

    @property
    def state_dim(self) -> int:
        """Number of states, 9."""
        return 9

    @property
    def control_dim(self) -> int:
        """Number of controls, 3."""
        return 3

    def energy(self, state: Components, functions: Any) -> Any:
        """Return the energy of a unit of mass in gravity and in a thrust that stays [J/kg]."""
        place, velocity, (thrust, roll, pitch) = state[:3], state[3:6], state[6:9]
        moving = sum(speed * speed for speed in velocity)
        axis = self._axis(roll, pitch, functions)
        along = sum(one * other for one, other in zip(axis, place, strict=True))
        return 0.5 * moving + self.gravity * (place[2] - thrust * along)

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt.

        Args:
            state: [p_x, p_y, p_z, v_x, v_y, v_z, tau, phi, theta], numbers of any kind.
            control: The rates of tau, phi and theta.
            functions: Namespace with `sin` and `cos` for that kind of number.

        Returns:
            The nine rates, in the units of the state per second: dv/dt = g (tau b - e_z), with
            the axis b = [sin theta, -cos theta sin phi, cos theta cos phi] of the rotors.
        """
        velocity, (thrust, roll, pitch) = state[3:6], state[6:9]
        push = self.gravity * thrust
        x, y, z = self._axis(roll, pitch, functions)
        return (*velocity, push * x, push * y, push * z - self.gravity, *control[:3])

    @staticmethod
    def _axis(roll: Any, pitch: Any, functions: Any) -> Components:
        """Return the axis of the rotors, a unit vector."""
        level = functions.cos(pitch)
        return functions.sin(pitch), -level * functions.sin(roll), level * functions.cos(roll)


@dataclass(frozen=True, slots=True)
class HeadingQuadrotor(Quadrotor):
    """The same with the heading psi [rad], a turn around the axis of the rotors, and its rate.

    State x = [p, v, tau, phi, theta, psi], control u = d/dt [tau, phi, theta, psi].
    """

    mirror = (*Quadrotor.mirror[0], -1), (*Quadrotor.mirror[1], -1)

    @property
    def state_dim(self) -> int:
        """Number of states, 10."""
        return 10

    @property
    def control_dim(self) -> int:
        """Number of controls, 4."""
        return 4

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt, shape (10,); see `Quadrotor.derivative`."""
        return (*Quadrotor.derivative(self, state, control, functions), control[3])
