"""u* of the spacecraft as the gain that belongs to the metric, and its laws by name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.checks import check_name, check_positive
from lagros_envs.tasks.spacecraft.physics import Spacecraft, check_spacecraft
from lagros_policies.contraction.axis_gain import AxisGain
from lagros_policies.tasks.spacecraft.ellipsoid_axis import design_axis_ellipsoid
from lagros_policies.tasks.spacecraft.world_tube import Planned, WorldTube, world_tube
from lagros_policies.tasks.spacecraft.wrench_control import AxesTracking, Law, WrenchTracking

# For which plans `GainTracking.margin` is: within this of the origin [m], no faster [m/s], and
# accelerated by no more [m/s^2]; short of exact steps by what the solver leaves; any heading.
_FAR, _FAST, PLAN_ACCELERATION, _SHORT, _HEADING = 100.0, 1.0, 1.0, 1e-5, 4.0
# Control steps that it covers: a hundred seconds of 0.1 s.
_STEPS = 1000


@dataclass(frozen=True)
class GainTracking(AxesTracking):
    """u* = u_d + K e, the gain that belongs to the metric, in the plane and of the heading."""

    plane: AxisGain
    turning: AxisGain

    @property
    def laws(self) -> tuple[Law, Law]:
        """The laws of the plane and of the heading."""
        return self.plane.deviation, self.turning.deviation

    def margin(self, disturbance_bound: float) -> float:
        """Return what the position error never exceeds; see `world_tube`.

        That the body turns within a hold, the way between instants and single precision are in it.
        It is for 1,000 control steps around plans of at most 1 m/s^2 and 1 m/s within 100 m of
        the origin.
        """
        return self.around_any_plan(disturbance_bound).largest

    def around_any_plan(self, disturbance_bound: float) -> WorldTube:
        """Return the tube of one agent around the plans that `margin` is for."""
        one = np.ones(1)
        planned = Planned(
            _FAR * one, _FAST * one, PLAN_ACCELERATION * one, np.full((1, 2), _SHORT), _HEADING
        )
        return self.tube(planned, disturbance_bound, _STEPS)

    def tube(self, planned: Planned, disturbance_bound: float, steps: int) -> WorldTube:
        """Return what is proved of the errors around plans; see `world_tube.world_tube`.

        Args:
            planned: What is known of the plans.
            disturbance_bound: d_bar, in units of the state per second.
            steps: Control steps that it is to cover.
        """
        return world_tube(self.body, self.plane, self.turning, planned, disturbance_bound, steps)


# How an error is answered, by name.
LAWS = ("gain", "least-norm", "ellipsoid", "lqr")
# What a regulator takes for large, by Bryson's rule: the goal's radius, a brisk pace, a thruster's
# force; half a turn of the body in some seconds.
_PLANE_WEIGHTS, _TURNING_WEIGHTS = (0.2, 0.5, 1.0), (1.0, 1.0, 0.3)


def tracking_law(
    name: str, body: Spacecraft, period: float, contraction_rate: float, turning_rate: float
) -> AxesTracking:
    """Return a law by its name.

    Args:
        name: "gain": u* = u_d + K e with the gain of the rate. "least-norm": the least deviation
            among those that contract, Theorem 2's. "ellipsoid": the gain of the least invariant
            ellipsoid in the plane, which has no rate to choose. "lqr": a linear quadratic
            regulator's, without a metric or a rate.
        body: The spacecraft.
        period: The hold's [s].
        contraction_rate: alpha in the plane [1/s].
        turning_rate: alpha of the heading [1/s].

    Raises:
        TypeError: The body is no spacecraft.
        ValueError: There is no such law, or a rate is not positive and finite.
    """
    check_spacecraft(body, "tracking_law")
    check_name("law", name, LAWS)
    rates = {"contraction_rate": contraction_rate, "turning_rate": turning_rate}
    for rate, value in rates.items():
        check_positive(rate, value)
    if name == "least-norm":
        return WrenchTracking.for_rates(body, period, contraction_rate, turning_rate)
    if name == "lqr":
        axes = (_PLANE_WEIGHTS, _TURNING_WEIGHTS)
        return GainTracking(body, *(AxisGain.regulator(*one, period) for one in axes))
    plane = AxisGain.of_rate(contraction_rate, period)
    if name == "ellipsoid":
        plane = _of_the_ellipsoid(period)
    return GainTracking(body, plane, AxisGain.of_rate(turning_rate, period))


def _of_the_ellipsoid(period: float) -> AxisGain:
    stiffness, damping = (-design_axis_ellipsoid(period, "state").gain).tolist()
    return AxisGain(stiffness, damping, period)
