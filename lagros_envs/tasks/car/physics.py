"""A car that turns and accelerates at once: the kinematic car of C3M (Sun, Jha & Fan 2021)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lagros_envs.dynamics.system import Components


@dataclass(frozen=True, slots=True)
class Car:
    """A point with a heading, which does not slip.

    State x = [x, y, theta, v] in [m, m, rad, m/s]. Control u = [omega, a] in [rad/s, m/s^2].
    """

    mirror = (1, -1, -1, 1), (-1, 1)

    @property
    def state_dim(self) -> int:
        """Number of states, 4."""
        return 4

    @property
    def control_dim(self) -> int:
        """Number of controls, 2."""
        return 2

    def energy(self, state: Components, functions: Any) -> Any:
        """Return the energy of a unit of mass [J/kg]."""
        return 0.5 * state[3] * state[3]

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt = [v cos theta, v sin theta, omega, a].

        Args:
            state: [x, y, theta, v], numbers of any kind.
            control: [omega, a].
            functions: Namespace with `sin` and `cos` for that kind of number.

        Returns:
            The four rates, in the units of the state per second.
        """
        _, _, heading, speed = state
        turn, acceleration = control
        return speed * functions.cos(heading), speed * functions.sin(heading), turn, acceleration
