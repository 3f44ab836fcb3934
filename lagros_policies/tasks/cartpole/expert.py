"""The expert that policy (b) runs online and policy (c) imitates: plan, then track with u*."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import linearise_hold
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import ContractionMetric, HeldControl, load_metric
from lagros_policies.contraction.feedback import (
    FeedbackSettings,
    GainTable,
    gain_table,
    preferred_deviation,
)
from lagros_policies.tasks.cartpole.planner import CartPolePlanner

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class TrackedPlans:
    """Target trajectories with all that u* needs along them.

    Attributes:
        states: x_d, shape (p, N + 1, n).
        controls: u_d, shape (p, N, 1).
        first_step: Control step at which the plans begin.
        gains: The preferred feedback along the plans.
    """

    states: FloatArray
    controls: FloatArray
    first_step: int
    gains: GainTable


class CartPoleExpert:
    """Planner and tracking law of the cart-pole.

    Args:
        metric: The contraction metric; the shipped one if left out.
        task: The task.
        feedback: What u* prefers where contraction leaves a choice.
    """

    def __init__(
        self,
        metric: ContractionMetric | None = None,
        task: CartPoleSettings | None = None,
        feedback: FeedbackSettings | None = None,
    ) -> None:
        """Build planner and law."""
        self.task = task or CartPoleSettings()
        self.metric = metric or load_metric()
        self.feedback = feedback or FeedbackSettings(tube=self.task.tube)
        self.planner = CartPolePlanner(self.task)
        self.law = HeldControl(
            self.task.system,
            self.metric,
            self.metric.contraction_rate,
            self.task.control_period,
        )

    def track(self, states: FloatArray, controls: FloatArray, first_step: int = 0) -> TrackedPlans:
        """Prepare plans for tracking.

        Args:
            states: x_d, shape (p, N + 1, 4).
            controls: u_d, shape (p, N, 1).
            first_step: Control step at which the plans begin.

        Returns:
            The plans with their gains.
        """
        period = self.task.control_period
        _, by_state, by_control = linearise_hold(self.task.system, states[:, :-1], controls, period)
        times = period * np.arange(first_step, first_step + states.shape[1])
        gains = gain_table(self.feedback, by_state, by_control[..., 0], times)
        return TrackedPlans(states, controls, first_step, gains)

    def control(
        self, plans: TrackedPlans, plan: IntArray, step: IntArray, state: FloatArray
    ) -> FloatArray:
        """Return u* at states of episodes that follow prepared plans.

        Args:
            plans: The plans.
            plan: Which of them each state belongs to, shape (s,).
            step: Control step of each state, shape (s,).
            state: x, shape (s, 4).

        Returns:
            u*, shape (s, 1) [N].
        """
        period = self.task.control_period
        index = step - plans.first_step
        nominal, nominal_control = plans.states[plan, index], plans.controls[plan, index]
        time = step.astype(np.float64) * period
        preferred = preferred_deviation(
            self.feedback, plans.gains, plan, index, state - nominal, time, period
        )
        if len(state) == 1:
            # One state alone is integrated in plain floats.
            return self.law(state[0], nominal[0], nominal_control[0], preferred[0])[None]
        return self.law(state, nominal, nominal_control, preferred)
