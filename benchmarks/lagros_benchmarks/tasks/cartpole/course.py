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
        effort_weight: That of the task, for every algorithm. With ten times as much PPO spends
            less, and SAC and TD3 do not learn to balance.
    """

    # The farthest goal [m], a start [rad], and the rates of a cart that hurries there [m/s, rad/s].
    feature_scales: ClassVar[Numbers] = (5.0, 1.0, 5.0, 3.0)
    effort_weight: float = 0.01
    task: str = "cartpole"


class CartPoleCourse(SingleCourse):
    """See `SingleCourse`."""

    def trainings(self, task: Task) -> Mapping[str, Training]:
        """Return the settings of every algorithm, by its name."""
        buffered: dict[str, Any] = {"segments": 24, "segment_steps": 125, "worlds": 128}
        return {
            "ppo": CartPoleTraining(Ppo()),
            "sac": CartPoleTraining(Sac(), **buffered),
            "td3": CartPoleTraining(Td3(), **buffered),
        }


COURSE = CartPoleCourse()
