"""The expert that policy (b) runs online and policy (c) imitates: plan, then track with u*."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagros_envs.cartpole_task import CartPoleSettings
from lagros_policies.contraction import HeldControl, Metric, load_metric
from lagros_policies.planning import CartPolePlanner

FloatArray = NDArray[np.float64]


class CartPoleExpert:
    """Planner and tracking law of the cart-pole.

    Args:
        metric: The contraction metric; the shipped one if left out.
        task: The task.
        rate: alpha of the control law [1/s]; the metric's own if left out.
    """

    def __init__(
        self,
        metric: Metric | None = None,
        task: CartPoleSettings | None = None,
        rate: float | None = None,
    ) -> None:
        """Build planner and law."""
        self.task = task or CartPoleSettings()
        self.metric = metric or load_metric()
        self.planner = CartPolePlanner(self.task)
        self._law = HeldControl(
            self.task.system,
            self.metric,
            self.metric.contraction_rate if rate is None else rate,
            self.task.control_period,
        )

    def control(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> FloatArray:
        """Return u*(x, x_d, u_d), shape (..., 1) [N], for states and plans of a batch."""
        return self._law(state, nominal, nominal_control)
