"""Adaptive tracking under parametric uncertainty, weighed by the contraction metric (aNCM).

The true system is the model with an unknown force on the same channel as the control,

    dx/dt = f(x) + B(x) (u + Y(x, u) a),    a constant and unknown, Y known (1 x k),

which is what a wrong friction of the cart, a wrong mass of the cart or a slope of the track come to
for the cart-pole. The law of Tsukamoto, Chung and Slotine (aNCM, 2021) is u = u* - Y a_hat with
da_hat/dt = Gamma Y'B'M e - sigma a_hat. Under a control held for h it reads here

    u[k] = u*[k] - Y[k] a_hat[k]
    a_hat[k+1] = (1 - h sigma) a_hat[k] + Gamma Y[k]' G[k]' M(x[k+1]) e[k+1],    G = dF/du,

with F the held model, so that the error that u* would have left, plus G Y (a - a_hat), is what is
seen. For sigma = 0, V = e'Me and P = (a - a_hat)' Gamma^-1 (a - a_hat) then obey

    (1 - kappa) V[k+1] + P[k+1] <= exp(-2 alpha h) V[k] + P[k],    kappa = (Y Gamma Y') G'MG,

as long as Y a is constant over the hold and no disturbance acts: e goes to zero if kappa stays
below 1 - exp(-2 alpha h). `largest_gain` turns that into Gamma. A positive sigma forgets, which
bounds a_hat under disturbance at the price of a bias.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import System, hold_control_slope, vector_field
from lagros_envs.tasks.cartpole.physics import VELOCITY
from lagros_policies.contraction.control import HeldControl
from lagros_policies.contraction.metric import matrices_at, region_angle
from lagros_policies.contraction.places import at_angles
from lagros_policies.tasks.cartpole.systems import check_cartpole

FloatArray = NDArray[np.float64]
# (x (..., n), u (..., 1)) -> Y (..., k) [N per unit of a].
Regressor = Callable[[FloatArray, FloatArray], FloatArray]

_GRID = 41


def friction_regressor(state: FloatArray, control: FloatArray) -> FloatArray:
    """Return Y = -dp/dt, shape (..., 1): a is the true friction less the model's [N s/m].

    Raises:
        ValueError: The states are not of the cart-pole's four.
    """
    if np.shape(state)[-1:] != (4,):
        raise ValueError(f"state of shape {np.shape(state)} must be the cart-pole's, (..., 4)")
    return -state[..., VELOCITY, None]


def slope_regressor(state: FloatArray, control: FloatArray) -> FloatArray:
    """Return Y = 1, shape (..., 1): a is a constant force [N], as of a track that is not level."""
    return np.ones((*state.shape[:-1], 1))


def cart_mass_regressor(model: System) -> Regressor:
    """Return Y = -d2p/dt2 of the model: a is the true mass of the cart less the model's [kg].

    The equation of the cart reads (m_c + m) d2p/dt2 + ... = u, so that more mass is a force against
    the acceleration. Y takes the model's acceleration for the true one, which is right to first
    order in a.

    Raises:
        TypeError: The model is no cart-pole.
    """
    check_cartpole(model, "cart_mass_regressor")

    def regressor(state: FloatArray, control: FloatArray) -> FloatArray:
        return -vector_field(model, state, control)[..., VELOCITY, None]

    return regressor


@dataclass(frozen=True)
class AdaptiveControl:
    """u* with an estimate of an unknown force on its channel.

    Attributes:
        law: u* of the model, over the hold.
        regressor: Y.
        gain: Diagonal of Gamma, one per unknown.
        leakage: sigma [1/s].
        limit: Largest |a_hat|, one per unknown; the estimate is projected onto it.

    Raises:
        ValueError: The lengths differ or a number is out of range.
    """

    law: HeldControl
    regressor: Regressor
    gain: tuple[float, ...]
    leakage: float = 0.0
    limit: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not self.gain or not all(math.isfinite(g) and g >= 0.0 for g in self.gain):
            raise ValueError(f"gain={self.gain!r} must hold a finite number >= 0 for each unknown")
        if not 0.0 <= self.leakage * self.law.period < 1.0:
            raise ValueError(
                f"leakage={self.leakage!r} times the period {self.law.period!r} must be in [0, 1)"
            )
        limits = self.limit
        if limits is not None and (len(limits) != len(self.gain) or not min(limits) > 0.0):
            raise ValueError(f"limit={limits!r} must hold one number > 0 for each unknown")

    def control(
        self,
        state: FloatArray,
        nominal: FloatArray,
        nominal_control: FloatArray,
        estimate: FloatArray,
        preferred: FloatArray | float = 0.0,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the force to apply and the force that the model is meant to feel.

        Args:
            state: x, shape (..., n).
            nominal: x_d, shape (..., n).
            nominal_control: u_d, shape (..., 1).
            estimate: a_hat, shape (..., k).
            preferred: As in `HeldControl`, shape (...).

        Returns:
            u = u* - Y a_hat and u*, both of shape (..., 1) [N].
        """
        wanted = self.law(state, nominal, nominal_control, preferred)
        return self.corrected(state, wanted, estimate), wanted

    def corrected(self, state: FloatArray, wanted: FloatArray, estimate: FloatArray) -> FloatArray:
        """Return u = u* - Y a_hat, shape (..., 1) [N].

        Args:
            state: x, shape (..., n).
            wanted: u*, shape (..., 1).
            estimate: a_hat, shape (..., k).
        """
        known = np.sum(self.regressor(state, wanted) * estimate, axis=-1, keepdims=True)
        return np.asarray(wanted - known)

    def update(
        self,
        estimate: FloatArray,
        state: FloatArray,
        wanted: FloatArray,
        following: FloatArray,
        following_nominal: FloatArray,
    ) -> FloatArray:
        """Return the next estimate, shape (..., k).

        Args:
            estimate: a_hat during the step, shape (..., k).
            state: x at its start, shape (..., n).
            wanted: u* of the step, as `control` returned it, shape (..., 1).
            following: x at its end, shape (..., n).
            following_nominal: x_d at its end, shape (..., n).
        """
        _, push = hold_control_slope(self.law.system, state, wanted, self.law.period)
        matrix = self.law.metric.matrix(following)
        pull = np.einsum("...i,...ij,...j->...", push, matrix, following - following_nominal)
        change = np.asarray(self.gain) * self.regressor(state, wanted) * pull[..., None]
        value: FloatArray = (1.0 - self.leakage * self.law.period) * estimate + change
        if self.limit is None:
            return value
        limits = np.asarray(self.limit)
        return np.clip(value, -limits, limits)


def largest_gain(
    law: HeldControl, reach: tuple[float, ...], share: float = 0.9
) -> tuple[float, ...]:
    """Return the diagonal of Gamma for which kappa is a share of 1 - exp(-2 alpha h).

    Args:
        law: u* of the cart-pole.
        reach: Largest |Y| of each unknown in the region of interest [N per unit].
        share: Share of the limit, in (0, 1); split evenly between the unknowns.

    Returns:
        One number per unknown, in units of a^2 over those of V.

    Raises:
        TypeError: The law is not that of a cart-pole.
        ValueError: A reach or the share is out of range.
    """
    if not reach or not min(reach) > 0.0 or not 0.0 < share < 1.0:
        raise ValueError(f"{reach=!r} must be > 0 and {share=!r} in (0, 1)")
    check_cartpole(law.system, "largest_gain")
    angles = np.linspace(0.0, region_angle(law.metric), _GRID)
    states = at_angles(angles, law.system.state_dim)
    _, push = hold_control_slope(law.system, states, np.zeros((_GRID, 1)), law.period)
    stiffness = np.einsum("si,sij,sj->s", push, matrices_at(law.metric, angles), push).max()
    kappa = share * -math.expm1(-2.0 * law.rate * law.period)
    return tuple(kappa / (len(reach) * y * y * float(stiffness)) for y in reach)
