"""The arm of two links of C3M (Sun, Jha & Fan 2021; there TLPRA), in the form of Slotine and Li."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lagros_envs.checks import check_constants
from lagros_envs.dynamics.system import Components


@dataclass(frozen=True, slots=True)
class Arm:
    """Two links without mass, a point mass at the end of each, and a motor in each joint.

    State x = [q_1, q_2, dq_1/dt, dq_2/dt] in [rad, rad/s]: q_1 from the horizontal, q_2 from the
    first link on, so that the arm stands upright at [pi/2, 0]. Control u = the torques of shoulder
    and elbow [N m]. M(q) d2q/dt2 + C(q, dq/dt) + G(q) = u.

    Attributes:
        first_mass: m_1, at the elbow [kg].
        second_mass: m_2, at the tip [kg].
        first_length: a_1, of the link from shoulder to elbow [m].
        second_length: a_2, of the link from elbow to tip [m].
        gravity: g [m/s^2].

    Raises:
        ValueError: A value is not positive.
    """

    first_mass: float = 0.8
    second_mass: float = 2.3
    first_length: float = 1.0
    second_length: float = 1.0
    gravity: float = 9.8

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
        """Return the energy of both masses [J]."""
        shoulder, elbow, first, second = state
        upper = self.first_length * first
        lower = self.second_length * (first + second)
        both = self.first_mass + self.second_mass
        moving = 0.5 * (both * upper * upper + self.second_mass * lower * lower)
        moving = moving + self.second_mass * upper * lower * functions.cos(elbow)
        height = both * self.first_length * functions.sin(shoulder)
        height = height + self.second_mass * self.second_length * functions.sin(shoulder + elbow)
        return moving + self.gravity * height

    def derivative(self, state: Components, control: Components, functions: Any) -> Components:
        """Return dx/dt.

        Args:
            state: [q_1, q_2, dq_1/dt, dq_2/dt], numbers of any kind.
            control: Torques of shoulder and elbow [N m].
            functions: Namespace with `sin` and `cos` for that kind of number.

        Returns:
            The four rates, in the units of the state per second.
        """
        shoulder, elbow, first, second = state
        # Written with the absolute rates w_1 = dq_1/dt and w_2 = dq_1/dt + dq_2/dt, in which the
        # mass matrix is [alpha, eta cos q_2; eta cos q_2, beta].
        alpha = (self.first_mass + self.second_mass) * self.first_length**2
        beta = self.second_mass * self.second_length**2
        eta = self.second_mass * self.first_length * self.second_length
        sine, cosine = functions.sin(elbow), functions.cos(elbow)
        both = first + second
        upper = (alpha * self.gravity / self.first_length) * functions.cos(shoulder)
        lower = (eta * self.gravity / self.first_length) * functions.cos(shoulder + elbow)
        push = control[0] - control[1] + eta * (both * both) * sine - upper
        pull = control[1] - eta * (first * first) * sine - lower
        coupling = eta * cosine
        determinant = alpha * beta - coupling * coupling
        faster = (beta * push - coupling * pull) / determinant
        outer = (alpha * pull - coupling * push) / determinant
        return first, second, faster, outer - faster
