"""What a control does to a set of errors: affine in the error, and a radius around that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.proof.error_set import ErrorSet

# Half a unit in the last place of single precision, and what double precision adds.
SINGLE = 2.0**-24 * (1.0 + 2.0**-10)


@dataclass(frozen=True)
class Steering:
    """u in u_d + v + K (e - c) + [-r, r] for every error e of a set with centre c.

    Attributes:
        gain: K, shape (p, m, n).
        offset: v, shape (p, m).
        radius: r, shape (p, m); inf where nothing is known.
    """

    gain: FloatArray
    offset: FloatArray
    radius: FloatArray


class Controller(Protocol):
    """A law whose control is enclosed over sets of errors, step by step."""

    def steering(
        self, step: int, errors: ErrorSet, state: FloatArray, control: FloatArray
    ) -> Steering:
        """Enclose the control that reaches the environment.

        Args:
            step: Index k of the control step along the plans.
            errors: Where e_k lies, of p plans.
            state: x_d at the step, shape (p, n).
            control: u_d at the step, shape (p, m).
        """


class LinearGain:
    """u = u_d + K_k e, of a state and with an action that single precision rounds.

    Args:
        gains: K, shape (p, N, m, n).
        centre: Control of the action zero, shape (m,); the action's rounding grows from there.
    """

    def __init__(self, gains: FloatArray, centre: FloatArray | float = 0.0) -> None:
        self.gains, self.centre = np.asarray(gains, np.float64), centre

    def steering(
        self, step: int, errors: ErrorSet, state: FloatArray, control: FloatArray
    ) -> Steering:
        """Enclose the control; see `Controller.steering`."""
        gain = self.gains[:, step]
        offset = np.einsum("pij,pj->pi", gain, errors.centre)
        size = np.abs(gain)
        seen = np.abs(state + errors.centre) + errors.radius
        reach = np.abs(control + offset - self.centre) + errors.support(gain)
        observed = np.einsum("pij,pj->pi", size, seen)
        # The centre is in doubles: its product with K is not exact either.
        slack = 2.0**-48 * np.einsum("pij,pj->pi", size, np.abs(errors.centre))
        return Steering(gain, offset, SINGLE * (observed + reach + np.abs(self.centre)) + slack)
