"""The safety filter: a wrapper that changes any policy's action least so that nothing is touched.

The inner action makes a force in the plane and a torque. The torque is kept, and the force changed
least, min ||a - a_0||^2, so that the acceleration a lies in one half-plane for each neighbour and
obstacle that is sensed (`safety.barrier`); `safety.nearest` answers exactly. An agent that is
blocked is turned to pass what blocks it. Where nothing is to be changed the action is the policy's
own, bit for bit. Nothing is silent: what the filter does is counted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_instance
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_policies.policy import Policy
from lagros_policies.safety.barrier import BarrierSettings, BrakingBarrier
from lagros_policies.safety.half_planes import nearest
from lagros_policies.tasks.spacecraft.filtering import ActionFilter
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.thrusters import allocate, to_body

# A violation below this is rounding [m/s^2].
_ROUNDING = 1e-6
# Where not all can be kept, this share of the violation falls to obstacles: a neighbour that comes
# too close gives way, an obstacle does not.
_OBSTACLE_SOFTNESS = 0.3


class SafetyFilter(ActionFilter):
    """A policy whose actions keep clear of what is sensed.

    Every agent is taken to use it: of two agents, each does half.

    Args:
        policy: The inner policy, of the spacecraft; its actions are those of the environment.
        settings: The task. With a thrust limit the filter commands no thruster beyond it, and a
            torque that leaves no room for the force gives way; the margin to obstacles is then that
            between agents, as far as starts and goals leave room for it, unless one is given.
        preset: The preset, or its name: the layout of the observation and the radii.
        num_agents: Number of agents; None for the preset's own.
        disturbance_bound: d_bar to prepare for, in units of the state per second.
        barrier: Margins and rates; None takes those tuned for the bound.

    Raises:
        TypeError: The inner policy is not one.
        ValueError: A value is out of range, or a rate is too fast for the control period.
    """

    def __init__(
        self,
        policy: Policy,
        settings: task.SpacecraftSettings | None = None,
        preset: str | Preset = "paper",
        num_agents: int | None = None,
        disturbance_bound: float = 0.4,
        barrier: BarrierSettings | None = None,
    ) -> None:
        super().__init__(policy, settings, preset, num_agents)
        chosen = BarrierSettings.for_bound(disturbance_bound) if barrier is None else barrier
        check_instance("barrier", chosen, BarrierSettings)
        limit = self.settings.thrust_limit
        if limit is not None:
            # Two thrusters push along an axis; half of that is kept for the rest.
            most = limit / self.settings.system.mass
            chosen = replace(chosen, braking=min(chosen.braking, most))
            if barrier is None:
                # It takes longer to come back from a push; starts and goals must stay outside.
                room = min(chosen.pair_margin, 0.5 * self.preset.aside)
                chosen = replace(chosen, obstacle_margin=max(chosen.obstacle_margin, room))
        self.barrier = BrakingBarrier(
            chosen,
            self.preset.agent_radius,
            self.preset.core,
            self.settings.control_period,
        )

    def _filtered(
        self, actions: NDArray[Any], sensed: Sensed, memory: FloatArray | None
    ) -> tuple[Float32Array, BoolArray, BoolArray, FloatArray | None]:
        return *self.filter(actions, sensed), None

    def filter(
        self, actions: NDArray[Any], sensed: Sensed
    ) -> tuple[Float32Array, BoolArray, BoolArray]:
        """Change actions least.

        Args:
            actions: One per agent, shape (B, 8), in units of `settings.thrust_scale`.
            sensed: What the agents sense.

        Returns:
            The actions in single precision, which of them were changed, and for which not all could
            be kept clear of, (B,) each.
        """
        filtered = np.array(actions, np.float32)
        infeasible = np.zeros(len(actions), bool)
        body = self.settings.system
        wrench, middle, wanted = self.wanted(actions, sensed)
        planes = self.barrier.half_planes(sensed.velocity, *sensed[1:])
        lack = planes.bounds - planes.x * wanted[:, :1] - planes.y * wanted[:, 1:]
        changed: BoolArray = np.max(lack, axis=1) > 0.0
        rows = np.flatnonzero(changed)
        if rows.size == 0:
            return filtered, changed, infeasible
        wrench, middle, wanted = wrench[rows], middle[rows], wanted[rows]
        target = wanted
        if self.barrier.settings.sidestep_speed > 0.0:
            at = rows, np.argmax(lack[rows], axis=1)
            normal = np.stack([planes.x[at], planes.y[at]], axis=-1)
            passing = np.stack([planes.speed_x[at], planes.speed_y[at]], axis=-1)
            target = wanted + self.sidestep(self.barrier.settings, rows, normal, passing, sensed)
        torque, most = self._authority(wrench)
        axes = _body_axes(middle)
        slots = sensed.neighbour_mask.shape[1], sensed.obstacle_mask.shape[1]
        normals = np.stack([planes.x[rows], planes.y[rows]], axis=-1)
        answer = nearest(
            target,
            np.concatenate([normals, axes, -axes], axis=1),
            np.concatenate([planes.bounds[rows], -most, -most], axis=1),
            np.repeat([1.0, _OBSTACLE_SOFTNESS, 0.0], [*slots, 4]),
        )
        force = to_body(body.mass * answer.points, middle)
        thrust = allocate(body, np.concatenate([force, torque[:, None]], axis=1))
        if self.settings.thrust_limit is not None:
            thrust = np.minimum(thrust, self.settings.thrust_limit)
        filtered[rows] = thrust / self.settings.thrust_scale
        infeasible[rows] = answer.violation > _ROUNDING
        return filtered, changed, infeasible

    def _authority(self, wrench: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the torque to keep (B,) and the largest acceleration along each axis (B, 2)."""
        body, limit = self.settings.system, self.settings.thrust_limit
        force, torque = np.abs(wrench[:, :2]), wrench[:, 2]
        most = np.maximum(body.mass * self.barrier.settings.largest_acceleration, force)
        if limit is not None:
            # `allocate` makes the torque with this share of it on the thrusters of each axis; at
            # least half of every thruster is left to the force.
            per_torque = np.array([body.arm, body.side_arm]) / (
                2.0 * (body.arm**2 + body.side_arm**2)
            )
            largest = 0.5 * limit / per_torque.max()
            torque = np.clip(torque, -largest, largest)
            most = np.minimum(most, 2.0 * (limit - np.abs(torque)[:, None] * per_torque))
        return torque, most / body.mass


def _body_axes(heading: FloatArray) -> FloatArray:
    """Return the two axes of bodies at headings (B,) in the world, shape (B, 2, 2)."""
    sine, cosine = np.sin(heading), np.cos(heading)
    return np.stack([cosine, -sine, sine, cosine], axis=-1).reshape(-1, 2, 2)
