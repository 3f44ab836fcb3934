"""The planar quadrotor (PVTOL) of Singh et al. (2017), with the velocity in the body's axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lagros_envs.checks import check_constants
from lagros_envs.dynamics.system import Components


@dataclass(frozen=True, slots=True)
class Pvtol:
    """A rod with a rotor at each end, in a vertical plane.

    State x = [p_x, p_z, phi, v_x, v_z, dphi/dt] in [m, m, rad, m/s, m/s, rad/s], the velocity along
    the rod and across it. Control u = [right thrust, left thrust] in [N].

    Attributes:
        mass: m [kg].
        inertia: J [kg m^2].
        arm: From the middle to a rotor [m].
        gravity: g [m/s^2].

    Raises:
        ValueError: A value is not positive.
    """

    mass: float = 0.486
    inertia: float = 0.00383
    arm: float = 0.25
    gravity: float = 9.81

    def __post_init__(self) -> None:
        check_constants(self)

    @property
    def state_dim(self) -> int:
        """Number of states, 6."""
        return 6

    @property
    def control_dim(self) -> int:
        """Number of controls, 2."""
        return 2

    @property
    def hover(self) -> float:
        """Thrust of each rotor that holds a hover [N]."""
        return 0.5 * self.mass * self.gravity

    def energy(self, state: Components, functions: Any) -> Any:
        """Return the energy [J]."""
        _, height, _, along, up, rate = state
        moving = self.mass * (along * along + up * up) + self.inertia * rate * rate
        return 0.5 * moving + self.mass * self.gravity * height

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt.

        Args:
            state: [p_x, p_z, phi, v_x, v_z, dphi/dt], numbers of any kind.
            control: [right thrust, left thrust].
            functions: Namespace with `sin` and `cos` for that kind of number.

        Returns:
            The six rates, in the units of the state per second.
        """
        _, _, roll, along, up, rate = state
        right, left = control
        sine, cosine = functions.sin(roll), functions.cos(roll)
        return (
            along * cosine - up * sine,
            along * sine + up * cosine,
            rate,
            up * rate - self.gravity * sine,
            (right + left) / self.mass - along * rate - self.gravity * cosine,
            self.arm * (right - left) / self.inertia,
        )
