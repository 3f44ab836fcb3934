"""A target trajectory, and how far it is from obeying the dynamics."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray


@dataclass(frozen=True)
class Trajectory:
    """(x_d, u_d) at the control instants.

    Attributes:
        states: x_d, shape (N + 1, n).
        controls: u_d, held from one instant to the next, shape (N, m).
        period: Control period [s].
        solved: Whether the plan meets dynamics, constraints and terminal state.
        status: Why the planner stopped, in words.
        defect: Largest violation of the true dynamics at any step, in units of the state.
        iterations: Convex programs solved.
        clearance: Least distance from a disc beyond the required one, between the instants too;
            inf where there is no disc.
        excess: Largest of the numbers that the problem keeps at or below zero; -inf without any.
        reference_control: u_ref, from which effort is counted, shape (m,); zero if left out.
    """

    states: FloatArray
    controls: FloatArray
    period: float
    solved: bool
    status: str
    defect: float
    iterations: int
    clearance: float = math.inf
    excess: float = -math.inf
    reference_control: FloatArray | None = None

    @property
    def horizon(self) -> int:
        """Number N of control steps."""
        return len(self.controls)

    @property
    def effort(self) -> float:
        """The integral of ||u_d - u_ref||^2 over the plan."""
        reference = 0.0 if self.reference_control is None else self.reference_control
        return float(np.sum((self.controls - reference) ** 2) * self.period)
