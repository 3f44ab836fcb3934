"""Reserved ways to a stop, which keep bodies apart although each knows only what it senses.

Every body carries a nominal motion (p_n, v_n), a double integrator that nothing disturbs, and holds
its own error in a set that is proved: ||p - p_n|| <= eps_p and ||s - s_n|| <= eps_s, where
s = p + beta v is the point at which a motion would stop. It *reserves* the segment R from p_n to
s_n. Braking by v_n / (beta + h/2) stops it at s_n, and every segment on the way lies in the one
before. The invariant, at every control instant and for every two bodies i and j, is

    dist(R_i, R_j) >= L = 2 (r + rho),

with the radius r and rho a bound of ||p - p_n|| at all times. Nobody knows the others' nominal
motions. But from what both sense both know sets that contain the two segments: with n from the
middle of the actual segment of j to that of i,

    n'y >= A for y in R_i,  n'y <= B for y in R_j,  gap G = A - B - L.

**Rule.** For each j, all that i reserves and passes until the next instant lies either in the zone
{n'y >= A - G/2} (if G < 0: {n'y >= B + L}), or in R_i + K, where K = {u: n'u >= sin(theta) ||u||}.

**Theorem.** If every body keeps the rule for all others that are near enough to matter, the
invariant holds at the next instant, and in between ||p_i - p_j|| >= 2 r. Braking keeps the rule.

*Proof.* Two zones are L apart, or more, along n, by their definition. So are a zone of i and
R_j - K: n'y <= B there, since n'u >= 0 in K. Let both choose K. The nearest points y_i and y_j of
the segments are at least L apart, and differ from the middles of the actual segments by no more
than t = 2 eps + beta (||v_i|| + ||v_j||) / 2 together, eps = max(eps_p, eps_s). So the direction m
from y_j to y_i is turned from n by no more than theta if sin(theta) >= t / L, and m'u >= 0 for all
u in K. As m'(y - z) >= L for all y in R_i, z in R_j, that stays so in R_i + K and R_j - K. What
lies within a hold is a parabola with its control points p_n, p_n + h v_n / 2 and the next p_n, in
the hull of what the rule is kept for. Braking keeps the segment within itself, and R_i lies in R_i
+ K, and in the zone wherever the zone is chosen. QED.

A disc that does not move is kept off by the tangent at its nearest point to R_i. At an instant the
nominal motion may also be moved towards the actual one, if the rule holds for that: where nothing
is near the two are the same, and the body remembers nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import check_fields

# Bounds distances of centres from below where two are in the same place.
_SAME_PLACE = 1e-9
# So far outside, a point still lies in its zone [m].
_ON_EDGE = 1e-12
# sin(theta) at most; in the invariant set it is less.
_WIDEST = 0.95


@dataclass(frozen=True)
class Reserve:
    """What the rule needs to know; all of it the same for every body.

    Attributes:
        period: h, for which an acceleration is held [s].
        stopping_time: beta [s].
        clearance: rho, bound of ||p - p_n|| at all times [m].
        place_error: eps_p, the same at the control instants [m].
        stop_error: eps_s, bound of ||s - s_n|| at the control instants [m].
        rounding: What measured positions are off [m].

    Raises:
        ValueError: A value is out of range, or the stopping time is below half the period: braking
            would reverse the motion.
    """

    period: float
    stopping_time: float
    clearance: float
    place_error: float
    stop_error: float
    rounding: float = 0.0

    def __post_init__(self) -> None:
        check_fields(
            self,
            positive=("period", "stopping_time"),
            not_negative=("clearance", "place_error", "stop_error", "rounding"),
        )
        if self.stopping_time < 0.5 * self.period:
            raise ValueError(
                f"stopping_time={self.stopping_time!r} s must be at least half the control period, "
                f"{0.5 * self.period:g} s"
            )

    @property
    def braking_rate(self) -> float:
        """Deceleration over speed of the way to the stop, 1 / (beta + h/2) [1/s]."""
        return 1.0 / (self.stopping_time + 0.5 * self.period)

    @property
    def coasting(self) -> float:
        """How far a hold of braking goes, over the speed at its beginning [s]."""
        return self.period * (1.0 - 0.5 * self.period * self.braking_rate)

    @property
    def error(self) -> float:
        """The larger of eps_p and eps_s [m]."""
        return max(self.place_error, self.stop_error)

    def distance(self, radius: float, other_radius: float) -> float:
        """Return L [m], twice the clearance for two that move."""
        return radius + other_radius + 2.0 * (self.clearance + self.rounding)


class Zones(NamedTuple):
    """Where a body may go beside each of s others, for B bodies.

    Positions are relative to the actual position of the body.

    Attributes:
        x: First component of n, zero where nobody is; shape (B, s).
        y: Its second.
        least: n'y of the zone's edge [m].
        sine: sin(theta).
    """

    x: FloatArray
    y: FloatArray
    least: FloatArray
    sine: FloatArray

    def along(self, vectors: FloatArray) -> FloatArray:
        """Return n'u of vectors (B, 2), shape (B, s)."""
        value: FloatArray = self.x * vectors[:, :1] + self.y * vectors[:, 1:]
        return value

    def hold(self, place: FloatArray, stop: FloatArray) -> BoolArray:
        """Return beside whom both of two points (B, 2) lie in the zone, shape (B, s)."""
        nearer = np.minimum(self.along(place), self.along(stop))
        held: BoolArray = (nearer >= self.least - _ON_EDGE) | ((self.x == 0.0) & (self.y == 0.0))
        return held

    @classmethod
    def joined(cls, first: Zones, second: Zones) -> Zones:
        """Put the zones of two kinds of others side by side."""
        return cls(*(np.concatenate(pair, axis=1) for pair in zip(first, second, strict=True)))


def zones_beside_bodies(
    reserve: Reserve,
    radius: float,
    velocity: FloatArray,
    neighbours: FloatArray,
    mask: BoolArray,
) -> Zones:
    """Return the zones beside others that keep the same rule, from what both sense.

    Args:
        reserve: What is known of all.
        radius: r [m].
        velocity: Of each body, shape (B, 2) [m/s].
        neighbours: Positions and velocities relative to it, shape (B, k, 4) [m, m/s].
        mask: Which slots hold one, shape (B, k).
    """
    beta = reserve.stopping_time
    place_x, place_y, extra_x, extra_y = (neighbours[..., index] for index in range(4))
    own_x, own_y = velocity[:, :1], velocity[:, 1:]
    x, y = -(place_x + 0.5 * beta * extra_x), -(place_y + 0.5 * beta * extra_y)
    apart = np.maximum(np.sqrt(x * x + y * y), _SAME_PLACE)
    scale = mask / apart
    x *= scale
    y *= scale
    own = beta * (x * own_x + y * own_y)
    place = x * place_x + y * place_y
    stop = place + own + beta * (x * extra_x + y * extra_y)
    mine = np.minimum(-reserve.place_error, own - reserve.stop_error)
    theirs = np.maximum(place + reserve.place_error, stop + reserve.stop_error)
    length = reserve.distance(radius, radius)
    gap = mine - theirs - length
    other_x, other_y = own_x + extra_x, own_y + extra_y
    speeds = np.hypot(own_x, own_y) + np.sqrt(other_x * other_x + other_y * other_y)
    turned = 2.0 * (reserve.error + reserve.rounding) + 0.5 * beta * speeds
    sine = np.minimum(turned / np.maximum(length, apart - turned), _WIDEST)
    return Zones(x, y, mine - np.where(gap >= 0.0, 0.5, 1.0) * gap, sine)


def zones_beside_discs(
    reserve: Reserve,
    radius: float,
    place: FloatArray,
    stop: FloatArray,
    discs: FloatArray,
    mask: BoolArray,
) -> Zones:
    """Return the zones beside discs that do not move.

    Args:
        reserve: What is known.
        radius: Of the bodies against discs [m].
        place: p_n, relative to the actual position, shape (B, 2) [m].
        stop: s_n, likewise.
        discs: Centres, likewise, and radii, shape (B, m, 3) [m].
        mask: Which slots hold one, shape (B, m).
    """
    centre_x, centre_y = discs[..., 0], discs[..., 1]
    way_x, way_y = (stop[:, axis, None] - place[:, axis, None] for axis in (0, 1))
    from_x, from_y = centre_x - place[:, :1], centre_y - place[:, 1:]
    square = np.maximum(way_x * way_x + way_y * way_y, _SAME_PLACE**2)
    share = np.clip((from_x * way_x + from_y * way_y) / square, 0.0, 1.0)
    x, y = share * way_x - from_x, share * way_y - from_y
    apart = np.sqrt(x * x + y * y)
    scale = mask / np.maximum(apart, _SAME_PLACE)
    x *= scale
    y *= scale
    kept = radius + discs[..., 2] + reserve.clearance + reserve.rounding
    # Who is nearer than that comes no nearer.
    least = x * centre_x + y * centre_y + np.minimum(kept, apart)
    return Zones(x, y, least, np.zeros_like(x))


class Restart(NamedTuple):
    """Nominal motions that were moved towards the actual ones.

    Attributes:
        place: p_n, relative to the actual position, shape (B, 2) [m].
        stop: s_n, likewise.
        inside: Beside whom all that is reserved lies in the zone, shape (B, s).
    """

    place: FloatArray
    stop: FloatArray
    inside: BoolArray


def restart(zones: Zones, place: FloatArray, stop: FloatArray, aim: FloatArray) -> Restart:
    """Move nominal motions towards the actual ones as far as the rule lets them.

    All the way where that is kept; else along the edge of the zone that is in the way, and then
    towards it. What is left of the error is its parts along two axes, each smaller: the set of
    errors is convex and the same after a reflection, so that it holds that, too.

    Args:
        zones: Beside all others.
        place: p_n, relative to the actual position, which is what it moves to, shape (B, 2) [m].
        stop: s_n, likewise.
        aim: Where the actual motion would stop, likewise.
    """
    inside = zones.hold(place, stop)
    lands = zones.hold(np.zeros_like(place), aim)
    shares = np.where(lands, 1.0, _shares(zones, inside, (place, stop), (0.0 * place, aim)))
    if not shares.shape[1]:
        return Restart(np.zeros_like(place), aim, inside)
    share = shares.min(axis=1)
    # Beside who is moved from outside into the zone at once there is no halfway.
    whole = share >= 1.0
    moved = np.where(whole[:, None], 0.0, place), np.where(whole[:, None], aim, stop)
    rows = np.flatnonzero(~whole)
    if rows.size:
        some, within = Zones(*(part[rows] for part in zones)), inside[rows]
        here, there = (place[rows], stop[rows]), (0.0 * place[rows], aim[rows])
        index = np.arange(rows.size)
        worst = np.argmin(shares[rows], axis=1)
        edge = np.stack([-some.y[index, worst], some.x[index, worst]], axis=-1)
        beside = tuple(
            one + edge * np.sum(edge * (other - one), axis=1, keepdims=True)
            for one, other in zip(here, there, strict=True)
        )
        for target in (beside, there):
            share = _shares(some, within, here, target).min(axis=1)[:, None]
            here = tuple(
                one + share * (other - one) for one, other in zip(here, target, strict=True)
            )
        moved[0][rows], moved[1][rows] = here
    return Restart(*moved, inside | (lands & whole[:, None]))


def _shares(
    zones: Zones,
    inside: BoolArray,
    here: tuple[FloatArray, ...],
    there: tuple[FloatArray, ...],
) -> FloatArray:
    """Return the largest shares of a move of p_n and s_n that keep the rule, shape (B, s)."""
    shares: FloatArray = np.ones(inside.shape)
    away = np.ones(inside.shape, bool)
    for one, other in zip(here, there, strict=True):
        begun, way = zones.along(one), zones.along(other - one)
        with np.errstate(divide="ignore", invalid="ignore"):
            until = np.where(way < 0.0, (zones.least - _ON_EDGE - begun) / way, 1.0)
        shares = np.minimum(shares, until)
        away &= way >= zones.sine * np.hypot(*(other - one).T)[:, None]
    value: FloatArray = np.where(inside, np.maximum(shares, 0.0), away)
    return value


def limits_beyond_braking(
    reserve: Reserve, zones: Zones, inside: BoolArray, place: FloatArray, speed: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the half-planes n'u >= b of what may be added to braking; u = 0 meets them all.

    Args:
        reserve: What is known.
        zones: Beside all others.
        inside: Beside whom the zone is chosen, shape (B, s); beside the rest it is K.
        place: p_n, relative to the actual position, shape (B, 2) [m].
        speed: v_n, shape (B, 2) [m/s].

    Returns:
        n, zero where there is none, shape (B, 2 s, 2), and b, shape (B, 2 s) [m/s^2].
    """
    h, beta = reserve.period, reserve.stopping_time
    here, pace = zones.along(place), zones.along(speed)
    there = (zones.least - here - reserve.coasting * pace) / (0.5 * h * h)
    at_stop = (zones.least - here - beta * pace) / (0.5 * h * h + beta * h)
    bounds = np.where(inside, np.minimum(np.maximum(there, at_stop), 0.0), 0.0)
    sine = np.where(inside, 0.0, zones.sine)
    cosine = np.sqrt(1.0 - sine * sine)
    second = np.where(inside, 0.0, 1.0)
    normals = np.stack(
        [
            np.concatenate(
                [
                    cosine * zones.x - sine * zones.y,
                    second * (cosine * zones.x + sine * zones.y),
                ],
                axis=1,
            ),
            np.concatenate(
                [
                    cosine * zones.y + sine * zones.x,
                    second * (cosine * zones.y - sine * zones.x),
                ],
                axis=1,
            ),
        ],
        axis=-1,
    )
    return normals, np.concatenate([bounds, np.zeros_like(bounds)], axis=1)
