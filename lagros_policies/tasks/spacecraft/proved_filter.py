"""The filter with a proof: if all agents wear it, no two bodies meet, whatever d does.

What is kept is in `safety.reserve`, and what the spacecraft must fulfil for that in `reserved`. An
agent remembers four numbers, its nominal motion; where nothing is near that is its actual one, and
the action is the policy's own. Otherwise the nominal motion follows the policy as far as the rule
lets it, the nearest point in a few half-planes that braking always lies in, and the agent answers
its error by the gain.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray, IntArray
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_policies.policy import Policy
from lagros_policies.safety.barrier import BarrierSettings
from lagros_policies.safety.half_planes import nearest
from lagros_policies.safety.reserve import (
    Zones,
    limits_beyond_braking,
    restart,
    zones_beside_bodies,
    zones_beside_discs,
)
from lagros_policies.tasks.spacecraft.filtering import ActionFilter
from lagros_policies.tasks.spacecraft.reserved import ReserveSettings, reserved_for
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.thrusters import allocate, to_body

# A difference below this is rounding [m/s^2].
_SAME = 1e-9


class Nominal(NamedTuple):
    """Nominal motions (p_n, v_n) of B agents, and whether they have just begun.

    Attributes:
        place: Relative to the actual position, shape (B, 2) [m].
        speed: Shape (B, 2) [m/s].
        fresh: Shape (B,).
    """

    place: FloatArray
    speed: FloatArray
    fresh: BoolArray


class ProvedFilter(ActionFilter):
    """A policy whose actions keep the rule of `safety.reserve`, and with it the theorem.

    The theorem is about the set of states in which, for all agents, p and p + beta v are within the
    proved errors of a nominal motion, what they reserve is L apart, or more, and rho and the radius
    from obstacles. At rest that asks for a gap of 2 rho between agents and rho to an obstacle.
    `infeasible` counts the agent-steps outside of it, as far as an agent can tell: there the filter
    does what it does inside, and nothing is proved.

    Args:
        policy: The inner policy, of the spacecraft; its actions are those of the environment.
        settings: The task.
        preset: The preset, or its name: the layout of the observation and the radii.
        num_agents: Number of agents; None for the preset's own.
        disturbance_bound: d_bar to prepare for, in units of the state per second.
        reserve: What the filter may do, and how it stops; the defaults if left out.

    Attributes:
        reserved: The constants, and what is proved of them.

    Raises:
        TypeError: The inner policy is not one.
        ValueError: A value is out of range, or the constants do not hold for the task.
    """

    def __init__(
        self,
        policy: Policy,
        settings: task.SpacecraftSettings | None = None,
        preset: str | Preset = "paper",
        num_agents: int | None = None,
        disturbance_bound: float = 0.4,
        reserve: ReserveSettings | None = None,
    ) -> None:
        super().__init__(policy, settings, preset, num_agents)
        self.name = f"{self.policy.name}+proved"
        self.disturbance_bound = disturbance_bound
        self._steps = BarrierSettings.for_bound(disturbance_bound)
        self.reserved = reserved_for(self.settings, self.preset, disturbance_bound, reserve)
        missed = [one.text for one in self.reserved.statements if not one.holds]
        if missed:
            raise ValueError(
                f"disturbance_bound={disturbance_bound!r}: the filter has no proof for this task, "
                f"as it is not shown that {'; that '.join(missed)}; use a smaller bound"
            )

    def _filtered(
        self, actions: NDArray[Any], sensed: Sensed, memory: FloatArray | None
    ) -> tuple[Float32Array, BoolArray, BoolArray, FloatArray | None]:
        reserve, gain = self.reserved.reserve, self.reserved.gain
        sensed = without_empty_slots(sensed)
        nominal = self._nominal(sensed, memory)
        zones = self._zones(sensed, nominal)
        outside = self._outside(sensed, nominal, zones)
        place, speed, inside = self._moved(sensed, nominal, zones)
        answer = gain.deviation(-place, sensed.velocity - speed)
        braking = -reserve.braking_rate * speed
        wrench, _, wanted = self.wanted(actions, sensed)
        torque = self._torque(wrench[:, 2], sensed.spin)
        beyond = wanted - answer - braking
        normals, bounds = limits_beyond_braking(reserve, zones, inside, place, speed)
        target = beyond + self._aside(beyond, zones, normals, bounds, sensed)
        extra = nearest_beyond(target, normals, bounds)
        extra *= self._most(braking, speed, extra)[:, None]
        changed = np.any(np.abs(extra - beyond) > _SAME, axis=1) | (torque != wrench[:, 2])
        extra = np.where(changed[:, None], extra, beyond)
        filtered = np.array(actions, np.float32)
        rows = np.flatnonzero(changed)
        if rows.size:
            filtered[rows] = self._thrust(
                (answer + braking + extra)[rows],
                torque[rows],
                sensed.heading[rows],
                sensed.spin[rows],
            )
        h, pull = reserve.period, braking + extra
        kept = [place - sensed.goal + h * speed + 0.5 * h * h * pull, speed + h * pull]
        return filtered, changed, outside, np.concatenate(kept, axis=1)

    def _nominal(self, sensed: Sensed, memory: FloatArray | None) -> Nominal:
        """Return the nominal motions, which begin as the actual ones."""
        fresh: BoolArray = sensed.time <= 0.0
        if memory is None:
            fresh = np.ones_like(fresh)
            return Nominal(np.zeros_like(sensed.goal), sensed.velocity.copy(), fresh)
        fresh = fresh | np.isnan(memory[:, 0])
        place = np.where(fresh[:, None], 0.0, memory[:, :2] + sensed.goal)
        return Nominal(place, np.where(fresh[:, None], sensed.velocity, memory[:, 2:]), fresh)

    def _zones(self, sensed: Sensed, nominal: Nominal) -> Zones:
        reserve, preset = self.reserved.reserve, self.preset
        stop = nominal.place + reserve.stopping_time * nominal.speed
        return Zones.joined(
            zones_beside_bodies(
                reserve,
                preset.agent_radius,
                sensed.velocity,
                sensed.neighbours,
                sensed.neighbour_mask,
            ),
            zones_beside_discs(
                reserve, preset.core, nominal.place, stop, sensed.obstacles, sensed.obstacle_mask
            ),
        )

    def _moved(
        self, sensed: Sensed, nominal: Nominal, zones: Zones
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return p_n and v_n, moved towards the actual motion, and who then is in which zone."""
        beta = self.reserved.reserve.stopping_time
        stop = nominal.place + beta * nominal.speed
        moved = restart(zones, nominal.place, stop, beta * sensed.velocity)
        speed = (moved.stop - moved.place) / beta
        # Who would be too fast goes on as it was.
        fast = (np.hypot(*speed.T) > self.reserved.speed)[:, None]
        inside = moved.inside & (~fast | zones.hold(nominal.place, stop))
        return (
            np.where(fast, nominal.place, moved.place),
            np.where(fast, nominal.speed, speed),
            inside,
        )

    def _aside(
        self,
        wanted: FloatArray,
        zones: Zones,
        normals: FloatArray,
        bounds: FloatArray,
        sensed: Sensed,
    ) -> FloatArray:
        """Return what is added for those who are blocked, shape (B, 2) [m/s^2]."""
        push = np.zeros_like(wanted)
        lack = bounds - normals[..., 0] * wanted[:, :1] - normals[..., 1] * wanted[:, 1:]
        rows = np.flatnonzero(np.max(lack, axis=1) > 0.0)
        if not rows.size:
            return push
        slots, others = zones.x.shape[1], sensed.neighbour_mask.shape[1]
        worst = np.argmax(lack[rows], axis=1) % slots
        at = rows, np.minimum(worst, others - 1)
        normal = np.stack([zones.x[rows, worst], zones.y[rows, worst]], axis=-1)
        # What is no neighbour rests.
        moving = (worst < others)[:, None]
        relative = np.where(moving, -sensed.neighbours[at][:, 2:], sensed.velocity[rows])
        push[rows] = self.sidestep(self._steps, rows, normal, relative, sensed)
        return push

    def _outside(self, sensed: Sensed, nominal: Nominal, zones: Zones) -> BoolArray:
        """Return who can tell that the state is not in the set that is kept, shape (B,)."""
        reserve, preset = self.reserved.reserve, self.preset
        beta, room = reserve.stopping_time, reserve.rounding
        off = nominal.place + beta * (nominal.speed - sensed.velocity)
        outside: BoolArray = np.hypot(*nominal.place.T) > reserve.place_error + room
        outside |= np.hypot(*off.T) > reserve.stop_error + room
        outside |= np.hypot(*nominal.speed.T) > self.reserved.speed * (1.0 + 1e-6)
        outside |= np.hypot(*sensed.goal.T) > self.reserved.farthest
        between = sensed.neighbours[..., :2]
        length = reserve.distance(preset.agent_radius, preset.agent_radius)
        apart = np.hypot(between[..., 0], between[..., 1])
        near = sensed.neighbour_mask & (apart < length)
        outside |= nominal.fresh & near.any(axis=1)
        discs, k = sensed.obstacles, sensed.neighbour_mask.shape[1]
        along = zones.x[:, k:] * discs[..., 0] + zones.y[:, k:] * discs[..., 1]
        kept = preset.core + discs[..., 2] + reserve.clearance + reserve.rounding
        close = sensed.obstacle_mask & (zones.least[:, k:] - along < kept - room)
        outside |= close.any(axis=1)
        return outside

    def _torque(self, torque: FloatArray, spin: FloatArray) -> FloatArray:
        """Return the torque nearest to the one wanted that keeps the spin within its bounds."""
        kept, h = self.reserved.settings, self.settings.control_period
        inertia = 2.0 * self.settings.system.inertia
        most = kept.spin - h * self.disturbance_bound
        low = np.clip((-most - spin) / h, -kept.spin_rate, kept.spin_rate)
        high = np.clip((most - spin) / h, -kept.spin_rate, kept.spin_rate)
        value: FloatArray = np.clip(torque, inertia * low, inertia * high)
        return value

    def _most(self, braking: FloatArray, speed: FloatArray, extra: FloatArray) -> FloatArray:
        """Return the share of what is added to braking that acceleration and speed allow, (B,)."""
        h = self.settings.control_period
        most = self.reserved.settings.acceleration, self.reserved.speed
        shares = (
            largest_share(braking, extra, most[0]),
            largest_share(speed + h * braking, h * extra, most[1]),
        )
        return np.minimum(*shares)

    def _thrust(
        self, acceleration: FloatArray, torque: FloatArray, heading: FloatArray, spin: FloatArray
    ) -> FloatArray:
        """Return the actions that make an acceleration and a torque over the hold, (B, 8)."""
        body, h = self.settings.system, self.settings.control_period
        turn = torque / (2.0 * body.inertia)
        middle = heading + 0.5 * h * spin + 0.125 * h * h * turn
        force = to_body(body.mass * acceleration, middle)
        thrust = allocate(body, np.concatenate([force, torque[:, None]], axis=1))
        value: FloatArray = thrust / self.settings.thrust_scale
        return value


def without_empty_slots(sensed: Sensed) -> Sensed:
    """Return what is sensed without the slots that are empty for everybody, but the first."""

    def used(mask: BoolArray) -> IntArray:
        return np.flatnonzero(mask.any(axis=0) | (np.arange(mask.shape[1]) == 0))

    others, discs = used(sensed.neighbour_mask), used(sensed.obstacle_mask)
    return Sensed(
        sensed.own,
        sensed.neighbours[:, others],
        sensed.neighbour_mask[:, others],
        sensed.obstacles[:, discs],
        sensed.obstacle_mask[:, discs],
    )


def nearest_beyond(wanted: FloatArray, normals: FloatArray, bounds: FloatArray) -> FloatArray:
    """Return the points nearest to those wanted in half-planes n'u >= b that zero lies in, (B, 2).

    Args:
        wanted: Shape (B, 2).
        normals: n, of length one or zero, shape (B, q, 2).
        bounds: b <= 0, shape (B, q).
    """
    along = normals[..., 0] * wanted[:, :1] + normals[..., 1] * wanted[:, 1:]
    points = wanted.copy()
    rows = np.flatnonzero(np.any(along < bounds, axis=1))
    if not rows.size:
        return points
    wanted, normals, bounds, along = wanted[rows], normals[rows], bounds[rows], along[rows]
    # Zero lies in them, so that the answer lies on the disc between zero and the point wanted: what
    # does not cut that disc matters to nobody.
    length = np.hypot(*wanted.T)[:, None]
    slack = 0.5 * (along - length) - bounds
    matters = (slack < 0.0) & np.any(normals != 0.0, axis=-1)
    most = int(matters.sum(axis=1).max())
    order = np.argsort(np.where(matters, slack, np.inf), axis=1)[:, :most]
    some = np.take_along_axis(matters, order, axis=1)
    normals = np.where(some[..., None], np.take_along_axis(normals, order[..., None], axis=1), 0.0)
    bounds = np.take_along_axis(bounds, order, axis=1)
    points[rows] = nearest(wanted, normals, bounds).points
    return points


def largest_share(start: FloatArray, way: FloatArray, radius: float) -> FloatArray:
    """Return the largest t <= 1 for which start + t way stays in a disc about zero, shape (B,).

    Args:
        start: Shape (B, 2); who begins outside stays as far out as that.
        way: Shape (B, 2).
        radius: Of the disc.
    """
    square, mixed = np.sum(way * way, axis=-1), np.sum(start * way, axis=-1)
    room = np.maximum(radius * radius - np.sum(start * start, axis=-1), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Of the two forms of the root, the one without cancellation.
        root = np.sqrt(mixed * mixed + square * room)
        share = np.where(mixed > 0.0, room / (mixed + root), (root - mixed) / square)
    value: FloatArray = np.where(square > 0.0, np.minimum(share, 1.0), 1.0)
    return value
