"""A known Lyapunov function in place of a designed metric, for the spacecraft: the law, a policy.

make("lagros_policies.tasks.spacecraft.sliding:SlidingCentralizedPolicy", env)
"""

from __future__ import annotations

from dataclasses import dataclass

from lagros_envs.checks import check_positive
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.remarks.lagrangian import SlidingAxis, steady_position_bound
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy
from lagros_policies.tasks.spacecraft.wrench_control import AxesTracking, Law


@dataclass(frozen=True)
class SlidingTracking(AxesTracking):
    """Sliding variables of the plane and of the heading; see `remarks.lagrangian`."""

    plane: SlidingAxis
    turning: SlidingAxis

    @property
    def laws(self) -> tuple[Law, Law]:
        """The laws of the plane and of the heading."""
        return self.plane.deviation, self.turning.deviation

    def margin(self, disturbance_bound: float) -> float:
        """Return what the position error never exceeds; see `steady_position_bound`."""
        return steady_position_bound(self.plane, disturbance_bound)


class SlidingCentralizedPolicy(CentralizedPolicy):
    """The centralised planner with a known Lyapunov function in place of the metric's u*.

    Args:
        settings: The task.
        preset: The preset, or its name.
        num_agents: Number of agents; None for the preset's own.
        disturbance_bound: d_bar to prepare for, in units of the state per second.
        position_rate: lambda, at which the position error follows the sliding variable [1/s].
        sliding_rate: k, at which the sliding variable contracts [1/s].
        turning_rate: Both rates of the heading [1/s].
        margin: Room beyond touching that plans ask for first [m]; None takes it from the bound, as
            u* at 2 1/s would, whose error is that of this law at 3 1/s.

    Raises:
        ValueError: A value is out of range.
    """

    name = "sliding-centralized"

    def __init__(
        self,
        settings: SpacecraftSettings | None = None,
        preset: str | Preset = "paper",
        num_agents: int | None = None,
        disturbance_bound: float = 0.4,
        position_rate: float = 3.0,
        sliding_rate: float = 3.0,
        turning_rate: float = 0.3,
        margin: float | None = None,
    ) -> None:
        super().__init__(settings, preset, num_agents, disturbance_bound, margin=margin)
        period = self.settings.control_period
        check_positive("turning_rate", turning_rate)
        self.tracking = SlidingTracking(
            self.settings.system,
            SlidingAxis(position_rate, sliding_rate, period),
            SlidingAxis(turning_rate, turning_rate, period),
        )
