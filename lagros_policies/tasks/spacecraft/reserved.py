"""What the rule of `safety.reserve` asks of the spacecraft, proved for a task and a bound d_bar.

The error e = (p - p_n, v - v_n) of a nominal motion that is tracked by a = a_n + K e obeys, as in
`world_tube`, e' = (F + g K) e + E d + g n + r: d is held over the step as the environment holds it,
n is what single precision does, r what the turn of the body does within the hold. The filter bounds
what r needs: the nominal acceleration, the spin and its rate. Moving the nominal motion towards the
actual one makes e smaller, but for rounding, so that the sums over the past stay bounds. They end
at some lag: what came in before has left an error within the bounds of all times, which are assumed
and come out no larger. So an episode may have any number of steps.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from lagros_envs.checks import check_disturbance_bound, check_fields
from lagros_envs.numbers import Interval, exact
from lagros_envs.tasks.spacecraft.physics import check_spacecraft
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.world import SUBSTEPS
from lagros_policies.contraction.axis_gain import AxisGain
from lagros_policies.contraction.axis_response import SUM, AxisPast, size_of, stacked
from lagros_policies.contraction.statement import Statement, at_most
from lagros_policies.safety.reserve import Reserve
from lagros_policies.tasks.spacecraft.held_turn import turned as turned_by
from lagros_policies.tasks.spacecraft.world_tube import thrust_rounding

# Lags of the sums over the past.
_LAGS = 200
# Relative: twice what single precision rounds, as a difference has two; more than double precision.
_SINGLE, _DOUBLE = 2.0**-23, 1e-13
# What rounding does to headings beyond what their size makes of it [rad].
_TURNED = 1e-6
# What double precision and the solution of the projection may add up to [m].
_SOLVED = 1e-5
_ROUNDS, _RAISE, _HOPELESS = 60, 1.0 + 1e-4, 1e3
# Double poles of F + g K that are tried.
_POLES = tuple(0.05 * step for step in range(2, 17))
# sin(theta) stays below this.
_NARROW = 0.9
# Of a thrust limit, what the torque may take, and of the rest the nominal motion.
_TURNING, _STRAIGHT = 0.2, 0.4
# What is tried beside that where thrust is limited: less for the nominal motion, longer stops [s].
_LESS, _LONGER = (0.4, 0.3, 0.2, 0.1, 0.05), (0.5, 0.3, 0.15)


@dataclass(frozen=True)
class ReserveSettings:
    """What the filter may do, and how it stops.

    Attributes:
        stopping_time: beta; a body at speed v reserves beta v ahead [s].
        acceleration: Of the nominal motion, at most [m/s^2].
        spin: |omega| at most [rad/s].
        spin_rate: Commanded angular acceleration at most [rad/s^2].
        pole: Of F + g K, double; None for the one with the least room about a body.

    Raises:
        ValueError: A value is out of range.
    """

    stopping_time: float = 0.15
    acceleration: float = 6.0
    spin: float = 1.0
    spin_rate: float = 5.0
    pole: float | None = None

    def __post_init__(self) -> None:
        check_fields(self, positive=("stopping_time", "acceleration", "spin", "spin_rate"))
        if self.pole is not None and not 0.0 < self.pole < 1.0:
            raise ValueError(f"pole={self.pole!r} must lie between 0 and 1, or be None")


@dataclass(frozen=True)
class Reserved:
    """The constants of the filter for a task, radii and a bound d_bar, and if they hold.

    Attributes:
        gain: K.
        reserve: The room that is kept.
        settings: What the filter may do, thrust limit included.
        command: Bound of the commanded acceleration [m/s^2].
        speed: Of the nominal motion, at most [m/s].
        speed_error: Bound of ||v - v_n|| at the control instants [m/s].
        farthest: From its goal, and from the origin, no agent comes farther within the time limit,
            if its goal is no farther from its start than any that the preset draws [m].
        covers_starts: Whether every start that the preset draws lies in the set that is kept.
        statements: What must hold, each proved or not.
    """

    gain: AxisGain
    reserve: Reserve
    settings: ReserveSettings
    command: float
    speed: float
    speed_error: float
    farthest: float
    covers_starts: bool
    statements: tuple[Statement, ...] = field(repr=False)

    @property
    def holds(self) -> bool:
        """Whether all statements do."""
        return all(statement.holds for statement in self.statements)


@dataclass(frozen=True)
class _Errors:
    """Bounds of the error at the instants, of what is commanded, and of what is in between.

    There it is ||p - p_n||, ||v|| and the distance from the goal.
    """

    place: float
    speed: float
    stop: float
    command: float
    inside: float
    pace: float
    farthest: float


def _outputs(gain: AxisGain, middle: Interval, stopping_time: float) -> Interval:
    """Return position, velocity, K e, stop, and the position in the middle of a hold, (q, 2)."""
    k, one = gain.gain, exact(1.0)
    half = middle * middle * 0.5
    rows = [
        (one, exact(0.0)),
        (exact(0.0), one),
        (exact(k[0]), exact(k[1])),
        (one, exact(stopping_time)),
        (half * k[0] + 1.0, half * k[1] + middle),
    ]
    return Interval(
        [[part.lower for part in row] for row in rows],
        [[part.upper for part in row] for row in rows],
    )


def _errors(
    task: SpacecraftSettings,
    gain: AxisGain,
    settings: ReserveSettings,
    bound: float,
    speed: float,
    way: float,
) -> _Errors | None:
    """Bound the error of a nominal motion; None where no bounds are found.

    Args:
        task: The task.
        gain: K.
        settings: What the filter may do.
        bound: d_bar.
        speed: Of the nominal motion, at most [m/s].
        way: From the start to the goal, and from the origin to both, at most [m].
    """
    if SUBSTEPS != 2:
        raise ValueError("the position is bounded for two substeps in a hold")
    bound = bound * (1.0 + SUM)
    middle = exact(gain.period) * 0.5
    past = AxisPast(gain, _outputs(gain, middle, settings.stopping_time), _LAGS)
    turned = turned_by(past.response.rows[:, :_LAGS], gain.period)
    angles = np.array([0.0, settings.spin, settings.spin_rate])
    off = _TURNED + _SINGLE * (np.pi + settings.spin * task.time_limit)
    delta = turned.angles(bound, angles, off)
    sizes = np.array([[0.0, 0.0, settings.acceleration]])
    for _ in range(_ROUNDS):
        # In a hold, too: but for the turn of the body a velocity lies between those at its ends.
        pace = speed + float(sizes[0, 1]) + gain.period * float(sizes[0, 2] * np.max(delta))
        far = way + task.time_limit * (pace + bound)
        sensed = _SINGLE * np.array([[far, pace]]) + _DOUBLE * far
        push = sizes[:, 2]
        noise = sensed @ np.abs(gain.gain) + thrust_rounding(task.system, push, angles[2])[0]
        come = turned.come(past.push, push, bound, angles, delta, off)
        come += past.control * noise[:, None, None]
        # What is measured of an error that is set to zero.
        come += np.einsum("qjx,nx->nqj", np.abs(past.response.rows[:, 1:]), sensed)
        errors = sizes[:, :2]
        later = past.bounds(come, errors, errors)[..., -1]
        found = np.maximum(past.bounds(come, sensed, errors).max(axis=-1), later)
        largest = found[:, :3] + np.concatenate([sensed, noise[:, None]], axis=1)
        largest[:, 2] += settings.acceleration
        if np.all(largest <= sizes):
            wide = float(size_of(stacked((middle,)))[0])
            partial = bound * wide * np.hypot(1.0, 0.5 * wide)
            partial += 0.5 * wide**2 * (float(noise[0]) + float(push[0]) * float(np.max(delta)))
            # A path that is accelerated so leaves the chords of the substeps by this; the
            # environment looks for collisions no farther from them.
            bulge = (float(push[0]) + bound) * wide**2 / 8.0
            place, speed_error, command = (float(value) for value in sizes[0])
            within = max(place, float(found[0, 4]) + partial)
            return _Errors(
                place,
                speed_error,
                (float(found[0, 3]) + float(sensed[0, 0] + sensed[0, 1])) * (1.0 + SUM),
                command,
                (within + bulge + _SOLVED) * (1.0 + SUM),
                pace,
                far * (1.0 + SUM),
            )
        sizes = np.maximum(sizes, largest * _RAISE)
        if not np.all(sizes < _HOPELESS):
            break
    return None


def double_pole(pole: float, period: float) -> AxisGain:
    """Return the gain K under which F + g K has a double pole.

    Args:
        pole: Between 0 and 1.
        period: h [s].
    """
    return AxisGain(
        (1.0 - pole) ** 2 / period**2, (3.0 + pole) * (1.0 - pole) / (2.0 * period), period
    )


@lru_cache(maxsize=32)
def reserved_for(
    task: SpacecraftSettings,
    preset: Preset,
    disturbance_bound: float,
    settings: ReserveSettings | None = None,
) -> Reserved:
    """Return the constants of the filter and whether they hold; some tenths of a second.

    Args:
        task: The task.
        preset: The radii, and the margin of the starts.
        disturbance_bound: d_bar, in units of the state per second.
        settings: What the filter may do; the defaults if left out, or, where thrust is limited,
            what lets a body be fastest among what holds and covers the starts.

    Returns:
        The constants with the least room about a body among those that hold; if none do, what is
        missed.

    Raises:
        TypeError: The body is no spacecraft.
        ValueError: The bound is negative or not finite, or the error has no bound at all.
    """
    check_spacecraft(task.system, "reserved_for")
    check_disturbance_bound("disturbance_bound", disturbance_bound)

    def merit(one: Reserved) -> tuple[bool, bool, float]:
        return not one.holds, not one.covers_starts, one.reserve.clearance + one.reserve.error

    best: Reserved | None = None
    for chosen in _tries(task, disturbance_bound, settings):
        poles = _POLES if chosen.pole is None else (chosen.pole,)
        tried = [_reserved(task, preset, disturbance_bound, chosen, pole) for pole in poles]
        found = [one for one in tried if one is not None]
        best = min([*found, *([] if best is None else [best])], key=merit, default=None)
        if best is not None and best.holds and best.covers_starts:
            break
    if best is None:
        raise ValueError(
            f"disturbance_bound={disturbance_bound!r} is more than the filter can stand: no bound "
            "of its error was found; use a smaller one"
        )
    return best


def largest_bound(
    task: SpacecraftSettings, preset: Preset, settings: ReserveSettings | None = None
) -> float:
    """Return the largest d_bar, to two digits after the point, for which all starts are covered."""
    low, high = 0, 300
    while high - low > 1:
        middle = (low + high) // 2
        try:
            one = reserved_for(task, preset, middle / 100.0, settings)
            good = one.holds and one.covers_starts
        except ValueError:
            good = False
        low, high = (middle, high) if good else (low, middle)
    return low / 100.0


def _torque_share(task: SpacecraftSettings) -> float:
    """Return the thrust that a torque takes of the thruster that it takes most of [1/m]."""
    arm, side = task.system.arm, task.system.side_arm
    return max(arm, side) / (2.0 * (arm**2 + side**2))


def _tries(
    task: SpacecraftSettings, bound: float, settings: ReserveSettings | None
) -> list[ReserveSettings]:
    """Return what the filter may do, the fastest first."""
    if settings is not None or task.thrust_limit is None:
        return [_within_thrust(task, settings or ReserveSettings(), bound)]
    tries = [
        _within_thrust(task, ReserveSettings(stopping_time), bound, straight)
        for straight in _LESS
        for stopping_time in _LONGER
    ]
    h = task.control_period
    return sorted(tries, key=lambda one: -one.acceleration * (one.stopping_time + 0.5 * h))


def _within_thrust(
    task: SpacecraftSettings, settings: ReserveSettings, bound: float, straight: float = _STRAIGHT
) -> ReserveSettings:
    """Return the settings with no more turning and acceleration than a thrust limit leaves.

    A torque that answers d is left in any case.
    """
    if task.thrust_limit is None:
        return settings
    turning = _TURNING * task.thrust_limit / (_torque_share(task) * 2.0 * task.system.inertia)
    straight *= 2.0 * (1.0 - _TURNING) * task.thrust_limit / task.system.mass
    return replace(
        settings,
        spin_rate=min(settings.spin_rate, max(turning, bound)),
        acceleration=min(settings.acceleration, straight),
    )


def _reserved(
    task: SpacecraftSettings,
    preset: Preset,
    bound: float,
    settings: ReserveSettings,
    pole: float,
) -> Reserved | None:
    """Return the constants with one pole; None where its error has no bound."""
    h, beta = task.control_period, settings.stopping_time
    begun = time.monotonic()
    gain = double_pole(pole, h)
    # Braking takes v / (beta + h/2).
    speed = settings.acceleration * (beta + 0.5 * h)
    way = max(math.sqrt(2.0) * preset.arena, preset.longest_way)
    errors = _errors(task, gain, settings, bound, speed, way)
    if errors is None:
        return None
    rounding = _SINGLE * errors.farthest + _SOLVED
    reserve = Reserve(h, beta, errors.inside, errors.place, errors.stop, rounding)
    length = reserve.distance(preset.agent_radius, preset.agent_radius)
    # Of a body and of all that it reserves or passes until the next instant.
    reach = errors.place + (h + beta) * speed + reserve.rounding
    seconds = time.monotonic() - begun
    seen = max(length + 2.0 * reach, preset.core + reserve.clearance + reach)
    turned = 2.0 * (reserve.error + reserve.rounding) + beta * (speed + errors.speed)
    within = (
        (
            f"the filter moves no one by more than {at_most(errors.inside)} m from its nominal "
            f"motion, at the instants {at_most(errors.place)} m, whatever d of norm <= {bound:g} "
            f"does, and commands at most {at_most(errors.command)} m/s^2",
            True,
        ),
        (
            "the thrusters have that beside the torque, at every heading",
            task.thrust_limit is None or errors.command <= _most_acceleration(task, settings),
        ),
        (
            f"the speed of {at_most(errors.pace)} m/s is not limited",
            task.speed_limit is None or errors.pace <= task.speed_limit,
        ),
        (
            f"the spin stays below {settings.spin:g} rad/s",
            bound <= settings.spin_rate and 2.0 * bound * h <= settings.spin,
        ),
        (
            f"who is not sensed is too far to matter: {at_most(seen)} m of "
            f"{task.sensing_radius:g} m",
            seen <= task.sensing_radius,
        ),
        (
            f"the direction to another is known well enough: sin(theta) <= "
            f"{at_most(turned / length)} of {_NARROW:g}",
            turned <= _NARROW * length,
        ),
    )
    return Reserved(
        gain,
        reserve,
        settings,
        errors.command,
        speed,
        errors.speed,
        errors.farthest,
        bool(preset.margin >= reserve.clearance + reserve.rounding),
        tuple(Statement(text, "proved", bool(holds), seconds) for text, holds in within),
    )


def _most_acceleration(task: SpacecraftSettings, settings: ReserveSettings) -> float:
    """Return the acceleration that thrusters make along any direction beside the torque."""
    assert task.thrust_limit is not None
    torque = 2.0 * task.system.inertia * settings.spin_rate
    return 2.0 * (task.thrust_limit - _torque_share(task) * torque) / task.system.mass
