"""The cart-pole's expert under its own name; `lagros_policies.expert` does the work."""

from __future__ import annotations

from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import ContractionMetric
from lagros_policies.expert import Expert, TrackedPlans
from lagros_policies.tasks.cartpole.feedback import FeedbackSettings, GatedRegulator

__all__ = ["CartPoleExpert", "TrackedPlans"]


class CartPoleExpert(Expert):
    """Planner and tracking law of the cart-pole.

    Args:
        metric: The contraction metric; the shipped one if left out.
        task: The task.
        feedback: What the law "tuned" prefers where contraction leaves a choice.
        law: As of `Expert`.
    """

    task: CartPoleSettings

    def __init__(
        self,
        metric: ContractionMetric | None = None,
        task: CartPoleSettings | None = None,
        feedback: FeedbackSettings | None = None,
        law: str | None = None,
    ) -> None:
        task = task or CartPoleSettings()
        preference = None if feedback is None else GatedRegulator(task, feedback)
        super().__init__(task, metric, preference, law)
