"""A chaser beside a target on a circular orbit: the equations of Clohessy and Wiltshire (1960)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lagros_envs.checks import check_constants
from lagros_envs.dynamics.system import Components


@dataclass(frozen=True, slots=True)
class Chaser:
    """A point mass with thrusters, in the plane of the orbit, seen from the target.

    State [x, y, v_x, v_y] in [m, m, m/s, m/s]: x away from the earth, y along the orbit, in axes
    that turn with the target. Control u = [F_x, F_y] in [N]. The equations are linear: they neglect
    the square of the distance, over that of the radius of the orbit.

    Attributes:
        mass: m [kg].
        mean_motion: n, the angular rate of the orbit [rad/s].

    Raises:
        ValueError: A value is not positive.
    """

    mass: float = 12.0
    mean_motion: float = 0.001027

    mirror = (-1, -1, -1, -1), (-1, -1)

    def __post_init__(self) -> None:
        check_constants(self)

    @property
    def state_dim(self) -> int:
        """Number of states, 4."""
        return 4

    @property
    def control_dim(self) -> int:
        """Number of controls, 2."""
        return 2

    def energy(self, state: Components, functions: Any) -> Any:
        """Return what the motion keeps in the turning axes, by mass: Jacobi's integral [J/kg]."""
        away, _, outward, along = state
        turning = 3.0 * self.mean_motion**2 * away**2
        return 0.5 * (outward**2 + along**2 - turning)

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt = [v_x, v_y, 3 n^2 x + 2 n v_y + F_x / m, -2 n v_x + F_y / m].

        Args:
            state: [x, y, v_x, v_y], numbers of any kind.
            control: [F_x, F_y].
            functions: Not needed.

        Returns:
            The four rates, in the units of the state per second.
        """
        away, _, outward, along = state
        first, second = control
        n = self.mean_motion
        return (
            outward,
            along,
            3.0 * n * n * away + 2.0 * n * along + first / self.mass,
            -2.0 * n * outward + second / self.mass,
        )
