"""How the cart-pole is learned: the settings that were found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from lagros_benchmarks.training.course import SingleCourse
from lagros_benchmarks.training.settings import Ppo, Sac, SingleTraining, Td3, Training
from lagros_envs.task import Numbers, Task


@dataclass(frozen=True)
class CartPoleTraining(SingleTraining):
    """A run on the cart-pole; attributes as in `SingleTraining`.

    Attributes:
        effort_weight: At the task's 0.01 an agent balances at twice the effort.
    """

    # The farthest goal [m], a start [rad], and the rates of a cart that hurries there [m/s, rad/s].
    feature_scales: ClassVar[Numbers] = (5.0, 1.0, 5.0, 3.0)
    effort_weight: float = 0.1
    task: str = "cartpole"


class CartPoleCourse(SingleCourse):
    """See `SingleCourse`."""

    def trainings(self, task: Task) -> Mapping[str, Training]:
        """Return the settings of every algorithm, by its name."""
        buffered: dict[str, Any] = {"segments": 24, "segment_steps": 125, "worlds": 128}
        return {
            "ppo": CartPoleTraining(Ppo()),
            "sac": CartPoleTraining(Sac(), effort_weight=0.01, **buffered),
            "td3": CartPoleTraining(Td3(), effort_weight=0.01, **buffered),
        }


COURSE = CartPoleCourse()
