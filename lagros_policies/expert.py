"""The expert that policy (b) runs online and policy (c) imitates: plan, then track with a law.

The law that is shipped is the gain that belongs to the metric along the plan
(`contraction.along_plan`). Others are there by name, to be held against it; see `LAWS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.checks import check_name
from lagros_envs.dynamics import linearise_hold
from lagros_envs.task import Feedback, Task
from lagros_policies.baselines import bryson_weights, regulator_weights
from lagros_policies.contraction import ContractionMetric, HeldControl, load_metric
from lagros_policies.contraction.along_plan import plan_metric, stage_weights
from lagros_policies.contraction.control import contracting_set, nearest_contracting
from lagros_policies.contraction.feedback import riccati_gains
from lagros_policies.planning.planner import planner_of
from lagros_policies.room import found_file, part_of, reproducing, shipped_file

moved_names(__name__)

# What the laws along a plan make of the rate and the weights that a task names.
_ALONG: dict[str, Callable[[Task], Feedback]] = {
    "gain": lambda task: bryson_weights(task),
    "projected": lambda task: bryson_weights(task),
    "half-rate": lambda task: _at_rate(bryson_weights(task), 0.5),
    "double-rate": lambda task: _at_rate(bryson_weights(task), 2.0),
    "no-rate": lambda task: _at_rate(bryson_weights(task), 0.0),
    "lqr": lambda task: regulator_weights(task),
}
# The laws within a contraction metric of the task.
WITHIN_METRIC = ("least-norm", "tuned")
LAWS = (*_ALONG, *WITHIN_METRIC)
SHIPPED_LAW = "gain"


@dataclass(frozen=True)
class TrackedPlans:
    """Target trajectories with all that a law needs along them.

    Attributes:
        states: x_d, shape (p, N + 1, n).
        controls: u_d, shape (p, N, m).
        first_step: Control step at which the plans begin.
        feedback: K of u = u_d + K e where that is the law, shape (p, N, m, n); None elsewhere. A
            projected gain is the gain wherever it contracts.
        matrices: M of the same program, shape (p, N + 1, n, n); None where there is none.
        gains: The preferred feedback along the plans, of the law "tuned"; None elsewhere.
    """

    states: FloatArray
    controls: FloatArray
    first_step: int
    feedback: FloatArray | None = None
    matrices: FloatArray | None = None
    gains: Any = None


class PointwiseLaw(Protocol):
    """A law that sees nothing of a plan but the target of the moment.

    Attributes:
        name: Name in tables.
    """

    name: str

    def __call__(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> FloatArray:
        """Return u, shape (s, m), at x (s, n), x_d (s, n) and u_d (s, m)."""


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


def has_metric(task: Task) -> bool:
    """Return whether a task has a contraction metric, or describes the one that it is to have."""
    made = shipped_file(task, "metric.json").is_file()
    return task.metric is not None or task.room is not None or made


def metric_of(task: Task) -> ContractionMetric:
    """Read the metric that was made for a task.

    Raises:
        FileNotFoundError: None has been made.
        ValueError: The task describes none, or the file is damaged or of another system.
    """
    if not has_metric(task):
        raise ValueError(
            f"{task.name} has no contraction metric: describe one in its class by `metric = "
            f"MetricDesign(...)`, and make it by `{reproducing(task)}`"
        )
    return load_metric(found_file(task, "metric.json"), task.system.state_dim)


class Expert:
    """Planner and tracking law of a task.

    Laws along a plan, of any task:

    - "gain": u_d + K e, with the gain of the metric along the plan; shipped.
    - "projected": the same, moved to the nearest control that contracts in that metric.
    - "half-rate", "double-rate": "gain" of the metric with half and twice the rate.
    - "no-rate": the weights of "gain" in a plain regulator: what a metric does not add.
    - "lqr": a plain regulator along the plan, of no metric, with the weights of `LqrPolicy`.

    Laws within the metric that CV-STEM has designed for the task:

    - "least-norm": the least deviation that contracts over the hold, equation (17).
    - "tuned": the contracting deviation nearest to a preference.

    Args:
        task: The task.
        metric: The contraction metric of the task; its own if left out.
        preference: What "tuned" prefers; the task's if left out.
        law: One of `LAWS`, or a law of the state and the target alone; if left out, "tuned" with a
            preference and the shipped one without.
        weights: Of a law along a plan; if left out, what it makes of those of the task.

    Raises:
        FileNotFoundError: The law needs the task's metric, which has not been made.
        ValueError: The law is not known, or needs a metric and the task has none, or it is one of
            another system.
    """

    def __init__(
        self,
        task: Task,
        metric: ContractionMetric | None = None,
        preference: Preference | None = None,
        law: str | PointwiseLaw | None = None,
        weights: Feedback | None = None,
    ) -> None:
        if law is None:
            law = SHIPPED_LAW if preference is None else "tuned"
        self._pointwise = None if isinstance(law, str) else law
        if isinstance(law, str):
            check_name("law", law, LAWS)
        self.task, self.law_name = task, law if isinstance(law, str) else law.name
        if preference is not None and self.law_name != "tuned":
            raise ValueError(f"law={self.law_name!r} prefers nothing: leave out preference, or law")
        self._metric, self._preference = metric, preference
        self.planner = planner_of(task)
        along = _ALONG.get(self.law_name)
        if weights is not None and along is None:
            raise ValueError(f"law={self.law_name!r} has no weights: leave them out, or law")
        self._weights = weights if along is None or weights is not None else along(task)
        bounds = np.array([task.control_low, task.control_high], np.float64)
        self._bounds = None if np.all(np.isinf(bounds)) else bounds
        if self._weights is None and self._pointwise is None:
            _ = self.law  # a metric that is missing is said here, not in flight

    @property
    def known_metric(self) -> ContractionMetric | None:
        """`metric`, or None where the task has none, or where it is still to be made.

        Raises:
            ValueError: It is damaged, or one of another system.
        """
        if self._metric is None and not has_metric(self.task):
            return None
        try:
            return self.metric
        except FileNotFoundError:
            return None

    @cached_property
    def metric(self) -> ContractionMetric:
        """The metric that CV-STEM has designed for the task.

        Raises:
            FileNotFoundError: It has not been made.
            ValueError: The task describes none, or it is one of another system.
        """
        return metric_of(self.task) if self._metric is None else self._metric

    @cached_property
    def preference(self) -> Preference:
        """What "tuned" prefers where the task's metric leaves a choice."""
        found: Preference = self._preference or part_of(
            self.task, "PREFERENCE", "lagros_policies.expert:Regulator"
        )(self.task)
        return found

    @cached_property
    def law(self) -> HeldControl:
        """u* of Theorem 2 in the task's metric, for the control that is held."""
        rate = self.metric.contraction_rate
        return HeldControl(self.task.system, self.metric, rate, self.task.control_period)

    @property
    def feedback(self) -> Any:
        """The weights of the law."""
        return self.preference.settings if self._weights is None else self._weights

    def track(self, states: FloatArray, controls: FloatArray, first_step: int = 0) -> TrackedPlans:
        """Prepare plans for tracking.

        Args:
            states: x_d, shape (p, N + 1, n).
            controls: u_d, shape (p, N, m).
            first_step: Control step at which the plans begin.
        """
        if self.law_name == "least-norm" or self._pointwise is not None:
            return TrackedPlans(states, controls, first_step)
        period = self.task.control_period
        _, by_state, by_control = linearise_hold(self.task.system, states[:, :-1], controls, period)
        times = period * np.arange(first_step, first_step + states.shape[1])
        if self._weights is None:
            gains = self.preference.gains(by_state, by_control, times)
            return TrackedPlans(states, controls, first_step, gains=gains)
        plain = self.law_name == "lqr"
        state, control = stage_weights(self._weights, None if plain else times, len(times))
        decay = 0.0 if plain else self._weights.rate * period
        found = plan_metric(by_state, by_control, state, control, decay)
        return TrackedPlans(states, controls, first_step, found.gains, found.matrices)

    def control(
        self, plans: TrackedPlans, plan: IntArray, step: IntArray, state: FloatArray
    ) -> FloatArray:
        """Return the law's u at states of episodes that follow plans, within the task's bounds.

        Args:
            plans: The plans.
            plan: Which of them each state belongs to, shape (s,).
            step: Control step of each state, shape (s,).
            state: x, shape (s, n).

        Returns:
            u, shape (s, m).
        """
        return self.applied(self.wanted(plans, plan, step, state))

    def applied(self, control: FloatArray) -> FloatArray:
        """Return what the bounds of the task leave of controls (..., m)."""
        return control if self._bounds is None else np.clip(control, *self._bounds)

    def wanted(
        self, plans: TrackedPlans, plan: IntArray, step: IntArray, state: FloatArray
    ) -> FloatArray:
        """Return the law's u whatever the bounds of the control are; see `control`."""
        index = step - plans.first_step
        nominal, nominal_control = plans.states[plan, index], plans.controls[plan, index]
        if self._pointwise is not None:
            return self._pointwise(state, nominal, nominal_control)
        error, preferred = state - nominal, np.zeros(len(state))
        if plans.feedback is not None:
            deviation = np.einsum("smi,si->sm", plans.feedback[plan, index], error)
            if self.law_name != "projected":
                moved: FloatArray = nominal_control + deviation
                return moved
            return self._projected(plans, plan, index, state, deviation)
        if plans.gains is not None:
            time = step.astype(np.float64) * self.task.control_period
            preferred = self.preference.deviation(plans.gains, plan, index, error, time)
        elif nominal_control.shape[-1] > 1:
            preferred = np.zeros_like(nominal_control)
        if len(state) == 1:
            # One state alone is integrated in plain floats.
            return self.law(state[0], nominal[0], nominal_control[0], preferred[0])[None]
        return self.law(state, nominal, nominal_control, preferred)

    def _projected(
        self,
        plans: TrackedPlans,
        plan: IntArray,
        index: IntArray,
        state: FloatArray,
        deviation: FloatArray,
    ) -> FloatArray:
        """Return u_d plus the nearest v to a deviation that contracts in the plan's metric."""
        task, weights, matrices = self.task, self._weights, plans.matrices
        assert weights is not None
        assert matrices is not None
        place = state, plans.states[plan, index], plans.controls[plan, index]
        here, ahead = matrices[plan, index], matrices[plan, index + 1]
        if len(state) == 1:
            place, here, ahead = (place[0][0], place[1][0], place[2][0]), here[0], ahead[0]
            deviation = deviation[0]
        condition = contracting_set(
            task.system, task.control_period, weights.rate, place, here, lambda *_: ahead
        )
        single = task.system.control_dim == 1
        v = nearest_contracting(*condition, deviation[..., 0] if single else deviation)
        control: FloatArray = place[2] + v
        return control[None] if control.ndim == 1 else control


def _at_rate(weights: Feedback, share: float) -> Feedback:
    return replace(weights, rate=share * weights.rate)
