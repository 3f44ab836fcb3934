"""The quadratic programs behind the plan of one agent: steps, distances, passes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import piqp

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import check_fields, check_positive
from lagros_policies.planning.grid_path import walk
from lagros_policies.planning.local.guess import pass_aside, progress, way_around
from lagros_policies.planning.local.motion import (
    Discs,
    LocalPlan,
    required_distances,
    responses,
)
from lagros_policies.planning.vectors import lengths, unit_vectors

_UNBOUNDED = 1e30
# Instants where distances are imposed: at most this far apart, near and far ahead [s], and no more
# than this in one step, however long a plan is.
_NEAR_INSTANTS, _FAR_INSTANTS, _MOST_INSTANTS = 0.25, 0.5, 24
# A plan with a force limit is so long that this share of it would do without obstacles, found in
# steps of this factor.
_DIRECT_SHARE, _LONGER = 0.7, 1.1
# An agent that lets others go first waits for this share of the foresight.
_PAUSE = 0.7


@dataclass(frozen=True, slots=True)
class LocalPlannerSettings:
    """The size of the programs and how hard to look.

    Attributes:
        mass: m [kg].
        near_period: Length of the first steps [s].
        near_steps: How many of them; others are heeded as long as these last.
        far_steps: Steps over the rest of the time.
        least_duration: No plan is shorter [s].
        speed_limit: Largest speed per axis at the nodes [m/s].
        force_limit: Largest force per axis [N]; None for no limit. It makes plans longer.
        margin_growth: Where the start lies inside a margin, the acceleration at which the margin
            grows from what there is [m/s^2].
        passes: Quadratic programs per guess at most.
        tolerance: Shortfall of a distance that counts as none [m].
        effort_tolerance: Stop when the cost falls by less than this share in one pass.
        penalty: w_1 [N^2 s / m].
        quadratic_penalty: w_2 [N^2 s / m^2].
        reach: A distance is imposed where the last pass is nearer than it plus this [m].
        most_distances: How many distances one program may impose; bounds the time that it takes.
        deadband: Two that meet pass on the right unless the miss distance is further left [m].
        change: A new way is taken when it costs less than this share of the plan in force.
        qp_tolerance: Residual of the quadratic programs.

    Raises:
        ValueError: A value is out of range.
    """

    mass: float = 1.0
    near_period: float = 0.5
    near_steps: int = 12
    far_steps: int = 8
    least_duration: float = 8.0
    speed_limit: float = 0.7
    force_limit: float | None = None
    margin_growth: float = 0.05
    passes: int = 4
    tolerance: float = 0.01
    effort_tolerance: float = 0.02
    penalty: float = 1.0
    quadratic_penalty: float = 4.0
    reach: float = 0.4
    most_distances: int = 80
    deadband: float = 0.2
    change: float = 0.8
    qp_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        check_fields(
            self,
            positive=("mass", "near_period", "speed_limit", "penalty", "qp_tolerance"),
            not_negative=[item.name for item in fields(self) if item.name != "force_limit"],
            # The second pass is the first that may know of the speed limit.
            least={"near_steps": 1, "far_steps": 1, "passes": 2, "most_distances": 1},
        )
        if self.force_limit is not None:
            check_positive("force_limit", self.force_limit, "or None for no limit")
        if self.least_duration <= self.foresight:
            raise ValueError(
                f"least_duration={self.least_duration!r} must exceed the {self.near_steps} steps "
                f"of {self.near_period} s for which others are heeded"
            )

    @property
    def foresight(self) -> float:
        """How far ahead others that move are heeded [s]."""
        return self.near_period * self.near_steps


class LocalProblem:
    """The arrays of one call of the planner, and its quadratic programs.

    Args:
        settings: How.
        start: [p, v], shape (4,) [m, m/s].
        goal: Position, shape (2,) [m].
        discs: What to keep away from.
        left: Time until the agent should have arrived [s]; may be negative, for it is late.
    """

    def __init__(
        self,
        settings: LocalPlannerSettings,
        start: FloatArray,
        goal: FloatArray,
        discs: Discs,
        left: float,
    ) -> None:
        """Lay out steps, instants and distances."""
        self.settings, self.start, self.goal, self.discs = settings, start, goal, discs
        far = float(np.max(np.abs(goal - start[:2])))
        # From rest to rest the largest speed is 3/2 of the mean; the rest is leave for detours.
        duration = max(left, settings.least_duration, 2.0 * far / settings.speed_limit)
        if settings.force_limit is not None:
            most = _DIRECT_SHARE * settings.force_limit / settings.mass
            duration = _duration_within(goal - start[:2], start[2:], duration, most)
        near = settings.near_period * np.arange(settings.near_steps)
        self.edges = np.concatenate(
            [near, np.linspace(settings.foresight, duration, settings.far_steps + 1)]
        )
        self.lengths = np.diff(self.edges)
        self.times, self.node = _instants(self.edges, settings)
        self.place, _ = responses(self.edges, self.times, settings.mass)
        ends, self.speed = responses(self.edges, self.edges[1:], settings.mass)
        self.arrival = np.stack([ends[-1], self.speed[-1]])
        self.speed = self.speed[:-1]
        self.free = start[:2] + self.times[:, None] * start[2:]
        self.discs_at = discs.at(self.times)
        self.heeded = discs.heeded(self.times, settings.foresight)
        self.required = required_distances(
            discs, self.times, start[:2], goal, left, settings.margin_growth
        )
        self.limit = np.maximum(settings.speed_limit, np.abs(start[2:]))

    def ways(self) -> Iterator[FloatArray]:
        """Yield guesses (K, 2): around what rests, passing others right, left, or after them."""
        discs, still = self.discs, ~self.discs.moving
        begin, speed = self.start[:2], self.start[2:]
        distance = np.max(self.required, axis=0, initial=0.0)[still]
        path = way_around(begin, self.goal, discs.centres[still], distance)
        legs = np.diff(path, axis=0)
        size = np.linalg.norm(legs, axis=1)
        along = float(speed @ legs[0]) / max(float(size[0]), 1e-9)
        length = float(np.sum(size))
        guess = walk(path, progress(self.times, length, along))
        right = self.aside(guess)
        yield right
        if not np.array_equal(right, guess):
            yield self.aside(guess, left=True)
            # Let the others go first: stand for most of the foresight.
            pause = _PAUSE * self.settings.foresight
            later = np.maximum(self.times - pause, 0.0)
            yield walk(path, progress(later, length, 0.0))

    def aside(self, guess: FloatArray, left: bool = False) -> FloatArray:
        """Return a guess that passes those who move on one side."""
        meets = self.heeded & self.discs.moving
        deadband = self.settings.deadband
        return pass_aside(guess, self.discs_at, self.required, meets, deadband, left)

    def solve(self, guess: FloatArray, warm: bool = False) -> LocalPlan:
        """Iterate from a guess (K, 2).

        A warm guess is a plan that was iterated before: one program that keeps all distances is
        enough, and the next plan goes on from there.
        """
        settings = self.settings
        places, count = guess, 0
        limited = False
        forces, short, cost = np.zeros((len(self.lengths), 2)), math.inf, math.inf
        for _ in range(settings.passes):
            found = self._program(places, limited)
            count += 1
            if found is None:
                break
            speeds = self.start[2:] + self.speed @ found
            if not limited and np.any(np.abs(speeds) > self.limit + 1e-6):
                # Most plans are slower than the limit, and the programs half the size without it.
                limited = True
                continue
            places = self.free + self.place @ found
            lacks, price = self._judge(found, places)
            gain = cost - price
            if gain > 0.0:
                forces, short, cost = found, lacks, price
            if not gain > settings.effort_tolerance * price:
                break
            if warm and short <= settings.tolerance:
                break
        solved = math.isfinite(cost)
        start, mass = self.start, settings.mass
        return LocalPlan(self.edges, start, forces, mass, short, cost, solved, count)

    def _judge(self, forces: FloatArray, places: FloatArray) -> tuple[float, float]:
        """Return the largest shortfall and the cost of a motion."""
        settings = self.settings
        apart = lengths(places[:, None] - self.discs_at)
        short = np.where(self.heeded, np.maximum(self.required - apart, 0.0), 0.0)
        price = settings.penalty * short + 0.5 * settings.quadratic_penalty * short**2
        effort = 0.5 * float(self.lengths @ np.sum(forces**2, axis=1))
        return float(np.max(short, initial=0.0)), effort + float(np.sum(price))

    def _program(self, places: FloatArray, limited: bool) -> FloatArray | None:
        """Solve the quadratic program around positions (K, 2); None if the solver failed."""
        settings, steps = self.settings, len(self.lengths)
        delta = places[:, None] - self.discs_at
        apart = lengths(delta)
        reach = np.where(self.node, settings.reach, 0.5 * settings.reach)
        room = np.where(self.heeded, apart - self.required - reach[:, None], np.inf)
        instant, disc = np.nonzero(room < 0.0)
        if len(instant) > settings.most_distances:
            # The tightest; what this leaves out another pass may bring in.
            tightest = np.argsort(room[instant, disc], kind="stable")[: settings.most_distances]
            instant, disc = instant[tightest], disc[tightest]
        normal = unit_vectors(delta[instant, disc], apart[instant, disc])
        rows = len(instant)
        size = 2 * steps + rows
        away = self.free[instant] - self.discs_at[instant, disc]
        low = self.required[instant, disc] - np.sum(normal * away, axis=-1)
        high = np.full(rows, _UNBOUNDED)
        inequality = np.zeros((rows, size))
        inequality[:, :steps] = normal[:, :1] * self.place[instant]
        inequality[:, steps : 2 * steps] = normal[:, 1:] * self.place[instant]
        inequality[np.arange(rows), 2 * steps + np.arange(rows)] = 1.0
        if limited:
            bound = np.zeros((2 * len(self.speed), size))
            bound[: len(self.speed), :steps] = self.speed
            bound[len(self.speed) :, steps : 2 * steps] = self.speed
            limit, now = (np.repeat(part, len(self.speed)) for part in (self.limit, self.start[2:]))
            inequality = np.vstack([inequality, bound])
            low, high = np.concatenate([low, -limit - now]), np.concatenate([high, limit - now])
        diagonal = np.full(size, settings.quadratic_penalty)
        diagonal[: 2 * steps] = np.tile(self.lengths, 2)
        linear = np.zeros(size)
        linear[2 * steps :] = settings.penalty
        least = np.full(size, -_UNBOUNDED)
        least[2 * steps :] = 0.0
        most = np.full(size, _UNBOUNDED)
        if settings.force_limit is not None:
            least[: 2 * steps], most[: 2 * steps] = -settings.force_limit, settings.force_limit
        costs, inequalities = (np.diag(diagonal), linear), (inequality, low, high)
        values = _solve(
            settings.qp_tolerance, *costs, *self._arrival(size), *inequalities, least, most
        )
        return None if values is None else values[: 2 * steps].reshape(2, steps).T

    def _arrival(self, size: int) -> tuple[FloatArray, FloatArray]:
        """Return the equalities that end the plan at rest at the goal."""
        steps = len(self.lengths)
        equality = np.zeros((4, size))
        equality[:2, :steps] = equality[2:, steps : 2 * steps] = self.arrival
        free = self.start[:2] + self.edges[-1] * self.start[2:]
        target = np.stack([self.goal - free, -self.start[2:]], axis=1).ravel()
        return equality, target


def _duration_within(
    way: FloatArray, speed: FloatArray, least: float, acceleration: float
) -> float:
    """Return a duration, at least the one given, in which a motion to rest needs little force.

    Without obstacles the motion of least effort accelerates with 6 d / T^2 - 4 v / T at first and
    with 2 v / T - 6 d / T^2 at last.

    Args:
        way: d per axis, shape (2,) [m].
        speed: v at the start, shape (2,) [m/s].
        least: No duration is shorter [s].
        acceleration: The most per axis [m/s^2].
    """
    duration = least
    while True:
        even, fading = 6.0 * way / duration**2, 2.0 * speed / duration
        if max(np.max(np.abs(even - 2.0 * fading)), np.max(np.abs(fading - even))) <= acceleration:
            return duration
        duration *= _LONGER


def _instants(edges: FloatArray, settings: LocalPlannerSettings) -> tuple[FloatArray, BoolArray]:
    """Return where distances are looked at, (K,) [s], and which of them are nodes."""
    parts = []
    # Steps are alike before the foresight, and after it.
    for some, spacing in (
        (edges[: settings.near_steps + 1], _NEAR_INSTANTS),
        (edges[settings.near_steps :], _FAR_INSTANTS),
    ):
        count = min(max(math.ceil((some[1] - some[0]) / spacing - 1e-9), 1), _MOST_INSTANTS)
        share = np.arange(count) / count
        parts.append((some[:-1, None] + share * (some[1] - some[0])).ravel())
        parts.append(np.tile(share == 0.0, len(some) - 1))
    times = np.concatenate([parts[0], parts[2], edges[-1:]])
    return times, np.concatenate([parts[1], parts[3], [True]])


def _solve(tolerance: float, *program: FloatArray) -> FloatArray | None:
    """Return the optimum of a dense program, as PIQP's `setup` takes it, or None if it fails."""
    solver = piqp.DenseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = tolerance
    solver.settings.check_duality_gap = False
    solver.setup(*program)
    status = solver.solve()
    values = np.array(solver.result.x)
    return values if status == piqp.PIQP_SOLVED and np.all(np.isfinite(values)) else None
