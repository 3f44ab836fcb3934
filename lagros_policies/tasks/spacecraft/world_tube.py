"""Proved tubes of the gain law around the plans of one world, of the environment's own steps.

In the plane the error of position and velocity obeys, from instant to instant and per axis,

    e' = (F + g K) e + E d + g n + r + s,

with d held over the step as the environment holds it, n what rounding does to the control (the
state is measured and the action applied in single precision), s what the plan's own steps are short
of F and g, and r what the turn of the body does within the hold (`held_turn`). The heading is a
double integrator of its own.

The sum over the past (`axis_response`) bounds every component of an output, hence, as both axes
have one gain, its length in the plane. The bounds of error and acceleration are assumed, and hold
if the sums come out no larger: by induction over time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_disturbance_bound
from lagros_envs.numbers import Interval, exact
from lagros_envs.tasks.spacecraft.physics import HEADING, SPIN, Spacecraft, check_spacecraft
from lagros_envs.tasks.spacecraft.world import SUBSTEPS
from lagros_policies.contraction.axis_gain import AxisGain
from lagros_policies.contraction.axis_response import SUM, AxisPast, size_of, stacked
from lagros_policies.tasks.spacecraft.held_turn import turned as turned_by
from lagros_policies.tasks.spacecraft.setup import PLANE

# Above the rounding of the doubles of law and environment, relative.
_DOUBLE = 1e-13
# Twice what rounding to single precision does, relative.
_SINGLE = 2.0**-23
# How often the assumed bounds are raised until they hold, and by how much beyond what came out.
_ROUNDS, _RAISE = 60, 1.0 + 1e-4
_HOPELESS = 1e6


@dataclass(frozen=True)
class WorldTube:
    """Bounds around the plans of one world that hold for every disturbance of norm <= d_bar.

    Attributes:
        instants: Of ||p - p_d|| at the control instants, shape (n, steps + 1) [m]; inf where the
            tube does not close.
        inside: Likewise at the ends of the environment's substeps within each hold, shape
            (n, steps, SUBSTEPS - 1) [m].
        acceleration: Of the commanded acceleration in the plane, shape (n,) [m/s^2].
        spin: Of the spin [rad/s].
    """

    instants: FloatArray
    inside: FloatArray
    acceleration: FloatArray
    spin: float

    @property
    def largest(self) -> float:
        """Of ||p - p_d|| of any agent, at and between the instants [m]."""
        return max(float(self.instants.max()), float(self.inside.max(initial=0.0)))


def _outputs(gain: AxisGain, times: list[Interval]) -> Interval:
    """Return position, velocity, K e, and the position so long after the instant, (q, 2)."""
    k = gain.gain
    rows = [
        (exact(1.0), exact(0.0)),
        (exact(0.0), exact(1.0)),
        (exact(k[0]), exact(k[1])),
        *((s * s * 0.5 * k[0] + 1.0, s * s * 0.5 * k[1] + s) for s in times),
    ]
    return Interval(
        [[part.lower for part in row] for row in rows],
        [[part.upper for part in row] for row in rows],
    )


@dataclass(frozen=True)
class Planned:
    """What a tube asks of plans: bounds over time, of each of n agents.

    Attributes:
        place: ||p_d||, shape (n,) [m].
        speed: ||v_d||, shape (n,) [m/s].
        acceleration: Of u_d in the plane, shape (n,) [m/s^2].
        shortfall: By how much a step misses F and g in position and velocity, shape (n, 2).
        heading: |phi_d|, of all; it rests [rad].
    """

    place: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    shortfall: FloatArray
    heading: float

    @classmethod
    def of(cls, nominal: FloatArray, accelerations: FloatArray, period: float) -> Planned:
        """Return the bounds of the plans of a world.

        Args:
            nominal: x_d at the control instants, shape (steps + 1, n, 6).
            accelerations: Of x, y and heading under u_d, shape (steps, n, 3).
            period: h [s].

        Raises:
            ValueError: A plan turns a body.
        """
        if np.any(nominal[..., SPIN]) or np.any(accelerations[..., 2]):
            raise ValueError("the plan turns a body: its tube is for headings at rest")
        return cls(
            _largest(nominal[..., :2]),
            _largest(nominal[..., 3:5]),
            _largest(accelerations[..., :2]),
            _shortfall(nominal[..., PLANE], accelerations[..., :2], period),
            float(np.abs(nominal[..., HEADING]).max()),
        )


def world_tube(
    body: Spacecraft,
    plane: AxisGain,
    turning: AxisGain,
    planned: Planned,
    disturbance_bound: float,
    steps: int,
) -> WorldTube:
    """Return what is proved of the errors of all agents of one world, from its start on.

    Args:
        body: The spacecraft.
        plane: The gain of x and y.
        turning: The gain of the heading, of the same period.
        planned: What is known of the plans; the agents start on them, but for rounding.
        disturbance_bound: d_bar, of all six states together, in their units per second.
        steps: Control steps of the episode.

    Raises:
        TypeError: The body is no spacecraft.
        ValueError: The bound is negative, not finite or enormous.
    """
    check_spacecraft(body, "world_tube")
    check_disturbance_bound("disturbance_bound", disturbance_bound)
    bound = disturbance_bound * (1.0 + SUM)
    h = exact(plane.period)
    points = [h * float(index) / float(SUBSTEPS) for index in range(1, SUBSTEPS)]
    straight = AxisPast(plane, _outputs(plane, points), steps)
    turn = AxisPast(turning, _outputs(turning, []), steps)
    turned = turned_by(straight.response.rows[:, :steps], plane.period)
    agents, motion = len(planned.place), np.stack([planned.place, planned.speed], axis=-1)
    # Assumed bounds: position, velocity and acceleration of each agent; heading, spin and its rate.
    sizes = np.stack([np.zeros(agents), np.zeros(agents), planned.acceleration], axis=-1)
    angles = np.zeros(3)
    for _ in range(_ROUNDS):
        around, push = motion + sizes[:, :2], sizes[:, 2]
        sensed = _SINGLE * around
        felt = _SINGLE * np.array([planned.heading + angles[0], angles[1]])
        forces, spins = thrust_rounding(body, push, angles[2])
        noise = sensed @ np.abs(plane.gain) + forces
        noise_turn = float(felt @ np.abs(turning.gain) + np.max(spins))
        beside = float(felt.sum()) + plane.period**2 * noise_turn
        delta = turned.angles(bound, angles, beside)
        come = turned.come(straight.push, push, bound, angles, delta, beside)
        come += straight.control * noise[:, None, None]
        lost = planned.shortfall + _DOUBLE * (1.0 + around)
        come += straight.place * lost[:, :1, None] + straight.speed * lost[:, 1:, None]
        found = straight.bounds(come, sensed, sizes[:, :2])
        come_turn = bound * turn.push + turn.control * noise_turn
        come_turn += _DOUBLE * (1.0 + planned.heading + angles[0]) * (turn.place + turn.speed)
        found_turn = turn.bounds(come_turn, felt, angles[:2]).max(axis=-1)
        found_turn[2] += noise_turn
        largest = found[:, :3].max(axis=-1)
        largest[:, 2] += planned.acceleration + noise
        if np.all(largest <= sizes) and np.all(found_turn <= angles):
            wide = size_of(stacked(tuple(points)))
            partial = bound * wide * np.sqrt(1.0 + 0.25 * wide**2)
            partial = partial + 0.5 * wide**2 * (noise + push * np.max(delta))[:, None] + _DOUBLE
            inside = (found[:, 3:, :steps] + partial[..., None]).transpose(0, 2, 1)
            return WorldTube(found[:, 0], inside * (1.0 + SUM), push, float(angles[1]))
        sizes, angles = np.maximum(sizes, largest * _RAISE), np.maximum(angles, found_turn * _RAISE)
        if not (np.all(sizes < _HOPELESS) and np.all(angles < _HOPELESS)):
            break
    endless = np.full((agents, steps + 1), np.inf)
    inside = np.full((agents, steps, SUBSTEPS - 1), np.inf)
    return WorldTube(endless, inside, np.full(agents, np.inf), np.inf)


def _largest(vectors: FloatArray) -> FloatArray:
    """Return the largest length over time of vectors (k, n, 2), shape (n,)."""
    value: FloatArray = np.hypot(vectors[..., 0], vectors[..., 1]).max(axis=0) * (1.0 + SUM)
    return value


def _shortfall(motion: FloatArray, accelerations: FloatArray, period: float) -> FloatArray:
    """Bound by how much a plan's steps miss F and g in position and velocity, shape (n, 2)."""
    h = exact(period)
    here, there, pull = exact(motion[:-1]), exact(motion[1:]), exact(accelerations)
    place, speed = here[..., :2], here[..., 2:]
    off = (
        place + h * speed + h * h * 0.5 * pull - there[..., :2],
        speed + h * pull - there[..., 2:],
    )
    sizes = [np.hypot(*np.moveaxis(size_of(part), -1, 0)).max(axis=0) for part in off]
    return np.stack(sizes, axis=-1) * (1.0 + SUM)


def thrust_rounding(
    body: Spacecraft, push: FloatArray, turn: float
) -> tuple[FloatArray, FloatArray]:
    """Bound what single precision of the eight forces does to the accelerations, both (n,)."""
    check_spacecraft(body, "thrust_rounding")
    torque = 2.0 * body.inertia * turn
    arms = body.arm + body.side_arm
    # |u| summed over the thrusters: forces along two axes, and a torque by four levers.
    thrust = np.sqrt(2.0) * body.mass * push + torque * arms / (body.arm**2 + body.side_arm**2)
    share = _SINGLE * thrust + 1e-30
    return share / body.mass + _DOUBLE * push, share * arms / (2.0 * body.inertia)
