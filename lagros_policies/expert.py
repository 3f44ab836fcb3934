"""The expert that policy (b) runs online and policy (c) imitates: plan, then track with u*.

Theorem 2 takes, among the controls that make e'Me contract, the one nearest to u_d. Any other point
of that set keeps the bound of Theorem 1, so u* may prefer a better one: here the nearest to what a
regulator along the plan would do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.dynamics import linearise_hold
from lagros_envs.task import Feedback, Task
from lagros_policies.baselines import regulator_weights
from lagros_policies.contraction import ContractionMetric, HeldControl, load_metric
from lagros_policies.contraction.feedback import riccati_gains
from lagros_policies.planning.planner import planner_of
from lagros_policies.room import found_file, part_of, reproducing, shipped_file

moved_names(__name__)


@dataclass(frozen=True)
class TrackedPlans:
    """Target trajectories with all that u* needs along them.

    Attributes:
        states: x_d, shape (p, N + 1, n).
        controls: u_d, shape (p, N, m).
        first_step: Control step at which the plans begin.
        gains: The preferred feedback along the plans.
        feedback: K of shape (p, N, m, n) where the flown law is u_d + K (x - x_d); None where it
            is no linear gain.
    """

    states: FloatArray
    controls: FloatArray
    first_step: int
    gains: Any
    feedback: FloatArray | None = None


class Preference(Protocol):
    """What u* prefers where contraction leaves a choice; built of a task.

    Attributes:
        settings: Its weights, a frozen dataclass.
    """

    settings: Any

    def gains(self, by_state: FloatArray, by_control: FloatArray, times: FloatArray) -> Any:
        """Return what is needed along plans.

        Args:
            by_state: dF/dx of the held dynamics along the plans, shape (p, N, n, n).
            by_control: dF/du, shape (p, N, n, m).
            times: Control instants of the plans, shape (N + 1,) [s].
        """

    def deviation(
        self, gains: Any, plan: IntArray, index: IntArray, error: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Return the preferred v = u - u_d, shape (s, m); (s,) of a single control.

        Args:
            gains: What `gains` returned.
            plan: Which plan each error belongs to, shape (s,).
            index: Its step along the plan, shape (s,).
            error: e = x - x_d, shape (s, n).
            time: t, shape (s,) [s].
        """


class Regulator:
    """A linear-quadratic regulator along the plan, with the weights of the task.

    Args:
        task: The task.
        settings: Other weights.
    """

    def __init__(self, task: Task, settings: Feedback | None = None) -> None:
        self.settings = settings or regulator_weights(task)

    def gains(self, by_state: FloatArray, by_control: FloatArray, times: FloatArray) -> FloatArray:
        """Return K, shape (p, N, m, n)."""
        steps = by_control.shape[-3]
        state = np.tile(self.settings.state_weights, (steps + 1, 1))
        control = np.tile(self.settings.control_weights, (steps, 1))
        return riccati_gains(by_state, by_control, state, control)

    def deviation(
        self,
        gains: FloatArray,
        plan: IntArray,
        index: IntArray,
        error: FloatArray,
        time: FloatArray,
    ) -> FloatArray:
        """Return -K e; see `Preference.deviation`."""
        wanted: FloatArray = -np.einsum("smi,si->sm", gains[plan, index], error)
        return wanted[:, 0] if wanted.shape[-1] == 1 else wanted


def metric_of(task: Task) -> ContractionMetric:
    """Read the metric that was made for a task.

    Raises:
        FileNotFoundError: None has been made.
        ValueError: The task describes none, or the file is damaged or of another system.
    """
    made = shipped_file(task, "metric.json").is_file()
    if task.metric is None and task.room is None and not made:
        raise ValueError(
            f"{task.name} has no contraction metric: describe one in its class by `metric = "
            f"MetricDesign(...)`, and make it by `{reproducing(task)}`"
        )
    return load_metric(found_file(task, "metric.json"), task.system.state_dim)


class Expert:
    """Planner and tracking law of a task.

    Args:
        task: The task.
        metric: The contraction metric; the task's own if left out.
        preference: What u* prefers where contraction leaves a choice; the task's if left out.

    Raises:
        FileNotFoundError: The task's metric has not been made.
        ValueError: The task has no metric, or it is one of another system.
    """

    def __init__(
        self,
        task: Task,
        metric: ContractionMetric | None = None,
        preference: Preference | None = None,
    ) -> None:
        self.task = task
        self.metric: ContractionMetric = metric_of(task) if metric is None else metric
        self.preference: Preference = preference or part_of(
            task, "PREFERENCE", "lagros_policies.expert:Regulator"
        )(task)
        self.planner = planner_of(task)
        self.law = HeldControl(
            task.system, self.metric, self.metric.contraction_rate, task.control_period
        )
        bounds = np.array([task.control_low, task.control_high], np.float64)
        self._bounds = None if np.all(np.isinf(bounds)) else bounds

    @property
    def feedback(self) -> Any:
        """The weights of what u* prefers."""
        return self.preference.settings

    def track(self, states: FloatArray, controls: FloatArray, first_step: int = 0) -> TrackedPlans:
        """Prepare plans for tracking.

        Args:
            states: x_d, shape (p, N + 1, n).
            controls: u_d, shape (p, N, m).
            first_step: Control step at which the plans begin.
        """
        period = self.task.control_period
        _, by_state, by_control = linearise_hold(self.task.system, states[:, :-1], controls, period)
        times = period * np.arange(first_step, first_step + states.shape[1])
        gains = self.preference.gains(by_state, by_control, times)
        return TrackedPlans(states, controls, first_step, gains)

    def control(
        self, plans: TrackedPlans, plan: IntArray, step: IntArray, state: FloatArray
    ) -> FloatArray:
        """Return u* at states of episodes that follow prepared plans, within the task's bounds.

        Args:
            plans: The plans.
            plan: Which of them each state belongs to, shape (s,).
            step: Control step of each state, shape (s,).
            state: x, shape (s, n).

        Returns:
            u*, shape (s, m).
        """
        return self.applied(self.wanted(plans, plan, step, state))

    def applied(self, control: FloatArray) -> FloatArray:
        """Return what the bounds of the task leave of controls (..., m)."""
        return control if self._bounds is None else np.clip(control, *self._bounds)

    def wanted(
        self, plans: TrackedPlans, plan: IntArray, step: IntArray, state: FloatArray
    ) -> FloatArray:
        """Return u* whatever the bounds of the control are; see `control`."""
        index = step - plans.first_step
        nominal, nominal_control = plans.states[plan, index], plans.controls[plan, index]
        preferred = self.preference.deviation(
            plans.gains,
            plan,
            index,
            state - nominal,
            step.astype(np.float64) * self.task.control_period,
        )
        if len(state) == 1:
            # One state alone is integrated in plain floats.
            return self.law(state[0], nominal[0], nominal_control[0], preferred[0])[None]
        return self.law(state, nominal, nominal_control, preferred)
