"""LAG-ROS with a learned correction: u = u_L + clip(c, +-beta), |c| at most beta."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, Float32Array
from lagros_envs.task import Task
from lagros_policies.actor import Actor, ActorPolicy
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.policy import BasePolicy, PolicyState
from lagros_policies.room import task_of


class Correction(ActorPolicy):
    """The correction alone, an actor whose largest control is beta."""

    name = "correction"
    recorded_as = "residual"


class ResidualPolicy(BasePolicy):
    """The control of LAG-ROS plus a correction that reinforcement learning has trained.

    A correction of at most beta enters Theorem 1 as a learning error does: where its bound holds
    for u_L with the learning error eps_l, that of the sum has eps_l + beta in its place, whatever
    was learned. It is looser, and nothing else is known about the correction.

    Args:
        settings: The task; None for the paper's.
        weights: File or arrays of the correction, an `Actor`; None for the task's own.
        base: File of the network of LAG-ROS; None for the task's own.
        allow_other_settings: Fly settings too for which the networks were not trained.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: A file is damaged, another policy's, or of a training for other settings.

    Attributes:
        base: The policy that is corrected.
        correction: The policy that is added.
    """

    name = "residual"
    restricted = True  # `policy.make` tells it whether other settings are allowed

    def __init__(
        self,
        settings: Task | None = None,
        weights: Path | str | Actor | None = None,
        base: Path | str | None = None,
        allow_other_settings: bool = False,
    ) -> None:
        self.settings = task_of(settings)
        self.base = LagrosPolicy(self.settings, base, allow_other_settings)
        self.correction = Correction(self.settings, weights, allow_other_settings)

    @property
    def largest_correction(self) -> float:
        """The bound beta of the correction, of the control that it moves most."""
        return max(self.correction.actor.largest_control)

    def predict(
        self,
        observation: NDArray[Any],
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Return the sum of both actions and the state as it came; see `Policy.predict`."""
        action, _ = self.base.predict(observation)
        correction, _ = self.correction.predict(observation)
        return action + correction, state
