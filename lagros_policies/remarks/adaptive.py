"""Adaptive tracking under parametric uncertainty, weighed by the contraction metric (aNCM).

The true system is the model with an unknown force on the same channel as the control,

    dx/dt = f(x) + B(x) (u + Y(x, u) a),    a constant and unknown, Y known (1 x k),

which is what a wrong friction, a wrong mass or a slope of the ground come to. The law of
Tsukamoto, Chung and Slotine (aNCM, 2021) is u = u* - Y a_hat with da_hat/dt =
Gamma Y'B'M e - sigma a_hat. Under a control held for h it reads here

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

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import hold_control_slope
from lagros_policies.contraction.control import HeldControl
from lagros_policies.contraction.metric import matrices_along, metric_place
from lagros_policies.contraction.places import along
from lagros_policies.contraction.regions import even_coordinate

moved_names(__name__)
# (x (..., n), u (..., 1)) -> Y (..., k), in units of the control per unit of a.
Regressor = Callable[[FloatArray, FloatArray], FloatArray]

_GRID = 41
_DRAWN = 1000


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
            u = u* - Y a_hat and u*, both of shape (..., 1).
        """
        wanted = self.law(state, nominal, nominal_control, preferred)
        return self.corrected(state, wanted, estimate), wanted

    def corrected(self, state: FloatArray, wanted: FloatArray, estimate: FloatArray) -> FloatArray:
        """Return u = u* - Y a_hat, shape (..., 1).

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

    G'MG is looked for on a grid of the even coordinate of the metric's region, for u = 0, or at
    states and controls drawn from it (observed).

    Args:
        law: u* of a system with one control.
        reach: Largest |Y| of each unknown in the region of interest, in units of the control.
        share: Share of the limit, in (0, 1); split evenly between the unknowns.

    Returns:
        One number per unknown, in units of a^2 over those of V.

    Raises:
        ValueError: The system has several controls, or a reach or the share is out of range.
    """
    if not reach or not min(reach) > 0.0 or not 0.0 < share < 1.0:
        raise ValueError(f"{reach=!r} must be > 0 and {share=!r} in (0, 1)")
    if law.system.control_dim != 1:
        raise ValueError(
            f"{law.system!r} has {law.system.control_dim} controls: largest_gain is for one"
        )
    even = even_coordinate(law.metric.region)
    if even is None:
        drawn = law.metric.region.sample(np.random.default_rng(0), _DRAWN)
        states, control = drawn.state, drawn.nominal_control
        matrix = law.metric.matrix(metric_place(law.metric, states, drawn.nominal))
    else:
        values = np.linspace(0.0, even[1], _GRID)
        states, control = along(values, even[0], law.system.state_dim), np.zeros((_GRID, 1))
        matrix = matrices_along(law.metric, values)
    _, push = hold_control_slope(law.system, states, control, law.period)
    stiffness = np.einsum("si,sij,sj->s", push, matrix, push).max()
    kappa = share * -math.expm1(-2.0 * law.rate * law.period)
    return tuple(kappa / (len(reach) * y * y * float(stiffness)) for y in reach)
