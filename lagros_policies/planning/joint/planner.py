"""Target trajectories of least effort for many agents at once, planar double integrators."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise

import numpy as np

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.checks import check_fields, check_not_negative, check_positive
from lagros_policies.planning.grid_path import GridSettings, shortest_paths, smooth_progress, walk
from lagros_policies.planning.joint.plan import JointPlan, divisor, instants, swept_distances
from lagros_policies.planning.joint.problem import JointProblem, JointScpSettings
from lagros_policies.planning.joint.scp import JointSolution, positions_between, solve_joint
from lagros_policies.planning.joint.search import search_in_turn
from lagros_policies.planning.joint.turns import ALL_AT_ONCE, MOST_PASSES, solve_many

# Distances are planned wider by this, so that a swept check finds the margins themselves kept [m].
_SPARE = 5e-3
# Ordering of seeds: the restarts of one problem draw from streams of their own.
_RESTART_SEED = 20210


@dataclass(frozen=True, slots=True)
class JointPlannerSettings:
    """The problem and how hard to look for a plan.

    Attributes:
        horizon: T, duration of a whole plan [s].
        nodes: N, node steps in T.
        control_period: Period of the control grid; divides the node step [s].
        mass: m of one agent [kg].
        margins: Room beyond touching between an agent and an obstacle [m]; each is tried in turn
            until a plan is found, so they fall.
        pair_share: Room beyond touching between two agents, in margins.
        margin_growth: Where a start or goal lies inside a margin, the acceleration at which the
            margin grows from what there is, and shrinks towards the goal [m/s^2].
        margin_profile: Share of the margin that is asked for at the control instants from the start
            on, not falling, in place of that growth; all of it after the last.
        start_margin: Room beyond touching from the first instant of a plan that may begin beside
            the states; the margin grows from there as above [m].
        speed_limit: Largest speed per axis; a node step at this speed must not cross an agent and
            its margins [m/s].
        force_limit: Largest force per axis [N]; None for no limit.
        candidates: Solved plans among which the one of least effort is taken.
        restarts: Guesses from time-shifted shortest paths after the first guess.
        searches: Guesses by search in space and time, one agent after the other by priority; the
            two kinds take turns.
        check_period: Period of the final check, swept between its instants [s].
        scp: How to iterate.
        grid: How to guess.

    Raises:
        ValueError: A value is out of range or the periods do not divide each other.
    """

    horizon: float = 30.0
    nodes: int = 60
    control_period: float = 0.1
    mass: float = 1.0
    margins: tuple[float, ...] = (0.3, 0.15)
    pair_share: float = 1.0
    margin_growth: float = 0.02
    margin_profile: tuple[float, ...] = ()
    start_margin: float = 0.12
    speed_limit: float = 0.7
    force_limit: float | None = None
    candidates: int = 1
    restarts: int = 2
    searches: int = 2
    check_period: float = 0.05
    scp: JointScpSettings = field(default_factory=JointScpSettings)
    grid: GridSettings = field(default_factory=GridSettings)

    def __post_init__(self) -> None:
        check_fields(
            self,
            positive=("horizon", "control_period", "mass", "speed_limit", "check_period"),
            not_negative=("pair_share", "margin_growth", "start_margin"),
            least={"nodes": 2, "candidates": 1, "restarts": 0, "searches": 0},
        )
        if self.force_limit is not None:
            check_positive("force_limit", self.force_limit, "or None for no limit")
        falling = sorted(self.margins, reverse=True)
        if not self.margins or list(self.margins) != falling or not 0.0 <= falling[-1] < math.inf:
            raise ValueError(f"margins={self.margins!r} must be falling numbers >= 0, at least one")
        shares = (0.0, *self.margin_profile, 1.0)
        if not all(one <= other for one, other in pairwise(shares)):
            raise ValueError(
                f"margin_profile={self.margin_profile!r} must be shares from 0 to 1 which do not "
                "fall"
            )
        divisor("control_period", self.control_period, self.node_period)
        divisor("check_period", self.check_period, self.node_period)

    @property
    def node_period(self) -> float:
        """Time from node to node [s]."""
        return self.horizon / self.nodes


@dataclass(frozen=True)
class _Scene:
    """The arrays of one call, checked."""

    starts: FloatArray  # (n, 4)
    goals: FloatArray  # (n, 4)
    obstacles: FloatArray  # (m, 2)
    touching: FloatArray  # (m,) distance of the centres at touch
    pair_touching: float
    arrivals: IntArray = field(default_factory=lambda: np.empty(0, np.intp))  # (n,) nodes
    start_cost: FloatArray | None = None  # (2, 2), see JointProblem


class JointPlanner:
    """Plans (x_d, u_d) of least effort for all agents together."""

    def __init__(self, settings: JointPlannerSettings | None = None) -> None:
        self.settings = settings or JointPlannerSettings()

    def plan(
        self,
        starts: FloatArray,
        goals: FloatArray,
        obstacles: FloatArray,
        obstacle_radius: FloatArray | float,
        agent_radius: float,
        core_radius: float | None = None,
        duration: float | FloatArray | None = None,
        start_cost: FloatArray | None = None,
    ) -> JointPlan:
        """Plan from the given states to rest at the goals.

        Args:
            starts: Positions (n, 2), or positions and velocities (n, 4) [m, m/s].
            goals: Positions, shape (n, 2) [m].
            obstacles: Centres, shape (m, 2) [m]; m may be 0.
            obstacle_radius: One radius, or one per obstacle (m,) [m].
            agent_radius: Radius of every agent against the others [m].
            core_radius: Their radius against obstacles [m], may be 0; the same if left out.
            duration: Time to the goals [s], one for all or one per agent (n,); the horizon if left
                out. It is rounded down to whole node steps, of which two must remain. Who arrives
                before others stays at its goal.
            start_cost: If given, plans begin in a tube around the states rather than there, where
                they keep `start_margin`: the deviation (position, velocity) of each axis costs
                e'Qe/2 with this Q, shape (2, 2).

        Returns:
            The plan. Where no guess led to a solved plan, the one that violates least, with
            `solved` False.

        Raises:
            ValueError: An array is misshapen or not finite, or no time remains.
        """
        begun = time.perf_counter()
        settings = self.settings
        scene = _scene(starts, goals, obstacles, obstacle_radius, agent_radius, core_radius)
        arrivals = self._arrivals(duration, len(scene.starts))
        scene = replace(scene, arrivals=arrivals, start_cost=start_cost)
        nodes = int(np.max(arrivals))
        solved: list[JointPlan] = []
        closest: tuple[float, JointPlan] | None = None
        iterations = attempts = 0
        many = len(scene.starts) > ALL_AT_ONCE
        solve = solve_many if many else solve_joint
        left = MOST_PASSES if many else sys.maxsize
        # A goal that is too far for the speed: one program shows how near it comes.
        few = 1 if self._beyond_reach(scene) else None
        for margin, problem, name, guess in self._attempts(scene, nodes, few):
            if left <= 0 or (solved and margin < solved[0].margin):
                break
            limits = replace(settings.scp, max_iterations=min(settings.scp.max_iterations, left))
            solution = solve(problem, guess, limits)
            iterations, attempts = iterations + solution.iterations, attempts + 1
            left -= solution.iterations
            plan = self._checked(scene, solution, name, nodes, margin)
            if plan.solved:
                solved.append(plan)
                if len(solved) >= settings.candidates:
                    break
            elif closest is None or solution.violation < closest[0]:
                closest = solution.violation, plan
        if solved:
            chosen = min(solved, key=lambda plan: float(np.sum(plan.effort)))
        else:
            assert closest is not None  # the first guess always exists
            chosen = closest[1]
            if few is not None:
                far = f"; a goal is out of reach at speed_limit={settings.speed_limit:g} m/s"
                chosen = replace(chosen, status=chosen.status + far)
        seconds = time.perf_counter() - begun
        return replace(chosen, iterations=iterations, attempts=attempts, seconds=seconds)

    def _arrivals(self, duration: float | FloatArray | None, agents: int) -> IntArray:
        """Return the node at which each agent arrives, shape (n,)."""
        settings = self.settings
        if duration is None:
            return np.full(agents, settings.nodes)
        times = np.broadcast_to(np.asarray(duration, dtype=np.float64), (agents,))
        nodes = np.floor(times / settings.node_period + 1e-9)
        if not np.all(nodes >= 2):
            raise ValueError(
                f"duration={duration!r} s leaves fewer than two node steps of "
                f"{settings.node_period} s"
            )
        return nodes.astype(np.intp)

    def _beyond_reach(self, scene: _Scene) -> bool:
        """Return whether an agent cannot come to its goal in its time at the largest speed."""
        if scene.start_cost is not None:
            return False  # plans may begin elsewhere
        speed = np.maximum(self.settings.speed_limit, np.abs(scene.starts[:, 2:]))
        reach = speed * (self.settings.node_period * scene.arrivals)[:, None]
        way = np.abs(scene.goals[:, :2] - scene.starts[:, :2])
        return bool(np.any(way > reach * (1.0 + 1e-9)))

    def _problem(self, scene: _Scene, nodes: int, margin: float) -> JointProblem:
        settings = self.settings
        substeps = divisor("control_period", settings.control_period, settings.node_period)
        times = instants(settings.control_period, nodes * substeps)
        obstacle_required, pair_required = self._required(scene, times, margin, _SPARE)
        moving = np.abs(scene.starts[:, 2:])
        return JointProblem(
            scene.starts,
            scene.goals,
            scene.obstacles,
            obstacle_required,
            pair_required,
            settings.node_period,
            substeps,
            settings.mass,
            np.maximum(settings.speed_limit, moving),
            scene.arrivals,
            scene.start_cost,
            math.inf if settings.force_limit is None else settings.force_limit,
        )

    def _required(
        self, scene: _Scene, times: FloatArray, margin: float, spare: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the distances to keep, (t, n, m) and (t, P): less near ends that lack room."""
        first, second = np.triu_indices(len(scene.starts), 1)
        gaps, apart = [], []
        for ends in (scene.starts, scene.goals):
            place = ends[:, :2]
            gap = np.linalg.norm(place[:, None] - scene.obstacles, axis=-1)
            gaps.append(gap + spare - _SPARE)
            apart.append(np.linalg.norm(place[first] - place[second], axis=-1) + spare - _SPARE)
        settings = self.settings
        growth = 0.5 * settings.margin_growth
        arrive = settings.node_period * scene.arrivals
        left = growth * np.maximum(arrive - times[:, None], 0.0) ** 2
        left_pair = np.maximum(left[:, first], left[:, second])
        gone = growth * times**2
        full = scene.touching + margin + spare
        obstacle_required, pair_required = gaps[1] + left[:, :, None], apart[1] + left_pair
        full_pair = scene.pair_touching + settings.pair_share * margin + spare
        growing, pair_growing = gaps[0] + gone[:, None, None], apart[0] + gone[:, None]
        if settings.margin_profile:
            known = (*settings.margin_profile, 1.0)
            share = np.interp(times, instants(settings.control_period, len(known) - 1), known)
            room = share * margin + spare
            growing = (scene.touching + room[:, None])[:, None]
            pair_growing = (scene.pair_touching + settings.pair_share * share * margin + spare)[
                :, None
            ]
        if scene.start_cost is not None:
            # A plan that may begin beside the states does not begin in touch.
            least = min(margin, settings.start_margin)
            growing = np.maximum(growing, scene.touching + least + spare)
            least = scene.pair_touching + settings.pair_share * least + spare
            pair_growing = np.maximum(pair_growing, least)
        obstacle_required = np.minimum(growing, obstacle_required)
        pair_required = np.minimum(pair_growing, pair_required)
        return np.minimum(obstacle_required, full), np.minimum(pair_required, full_pair)

    def _attempts(
        self, scene: _Scene, nodes: int, few: int | None
    ) -> Iterator[tuple[float, JointProblem, str, FloatArray]]:
        """Yield margins, problems, and names and guesses for them, the first `few` of each."""
        for margin in self.settings.margins[:few]:
            problem = self._problem(scene, nodes, margin)
            for name, guess in islice(self._guesses(scene, problem, margin), few):
                yield margin, problem, name, guess

    def _guesses(
        self, scene: _Scene, problem: JointProblem, margin: float
    ) -> Iterator[tuple[str, FloatArray]]:
        """Yield guesses of the positions (n, K + 1, 2) on the control grid, best first."""
        settings, grid = self.settings, self.settings.grid
        begin, end = scene.starts[:, :2], scene.goals[:, :2]
        distance = scene.touching + margin
        times = instants(settings.control_period, problem.nodes * problem.substeps)
        due = settings.node_period * scene.arrivals
        paths = shortest_paths(begin, end, scene.obstacles, distance, grid)
        sidestep = grid.sidestep if len(begin) > 1 else 0.0
        way = np.array([np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)) for path in paths])
        pair_distance = scene.pair_touching + settings.pair_share * margin
        for turn in range(max(settings.restarts + 1, settings.searches)):
            if turn <= settings.restarts:
                depart, arrive = np.zeros(len(paths)), due
                if turn > 0:
                    rng = np.random.default_rng([_RESTART_SEED, 0, turn])
                    depart = due * rng.uniform(0.0, 0.4, len(paths))
                    arrive = due * rng.uniform(0.6, 1.0, len(paths))
                name = "shortest paths" + (f", time shift {turn}" if turn > 0 else "")
                walks = [
                    walk(path, smooth_progress(times, early, late), sidestep)
                    for path, early, late in zip(paths, depart, arrive, strict=True)
                ]
                yield name, np.stack(walks)
            if turn < settings.searches:
                # The longest way first, then orders drawn at random.
                order = np.argsort(-way, kind="stable")
                if turn > 0:
                    rng = np.random.default_rng([_RESTART_SEED, 1, turn])
                    order = rng.permutation(len(way))
                guess = search_in_turn(
                    begin, end, scene.obstacles, distance, pair_distance, times, order, grid
                )
                yield f"search in priority order {turn}", guess

    def _checked(
        self, scene: _Scene, solution: JointSolution, name: str, nodes: int, margin: float
    ) -> JointPlan:
        """Turn a solution into a plan, after an independent check on a finer grid."""
        settings = self.settings
        count = divisor("check_period", settings.check_period, settings.node_period)
        places, _ = positions_between(
            solution.states, solution.forces, settings.mass, settings.node_period, count
        )
        gaps, apart = swept_distances(places, scene.obstacles)
        times = instants(settings.check_period, nodes * count)
        obstacle_required, pair_required = self._required(scene, times, margin, 0.0)
        # A sweep between two instants must keep the lesser of their distances.
        obstacle_least = np.minimum(obstacle_required[:-1], obstacle_required[1:])
        pair_least = np.minimum(pair_required[:-1], pair_required[1:])
        kept = bool(np.all(gaps >= obstacle_least - 1e-6) and np.all(apart >= pair_least - 1e-6))
        clearance = min(
            float(np.min(gaps - scene.touching, initial=np.inf)),
            float(np.min(apart - scene.pair_touching, initial=np.inf)),
        )
        status = f"{name}, margin {margin:g} m: {solution.status}"
        if solution.solved and not kept:
            status += "; a margin is broken between instants"
        if clearance < 0.0:
            status += f"; bodies overlap by {-clearance:.3f} m"
        return JointPlan(
            solution.states,
            solution.forces,
            settings.node_period,
            settings.mass,
            solution.solved and kept and clearance >= 0.0,
            status,
            clearance,
            margin,
            solution.iterations,
            1,
            0.0,
        )


def _scene(
    starts: FloatArray,
    goals: FloatArray,
    obstacles: FloatArray,
    obstacle_radius: FloatArray | float,
    agent_radius: float,
    core_radius: float | None,
) -> _Scene:
    begin = np.asarray(starts, dtype=np.float64)
    end = np.asarray(goals, dtype=np.float64)
    centres = np.asarray(obstacles, dtype=np.float64).reshape(-1, 2)
    if begin.ndim != 2 or begin.shape[1] not in (2, 4) or len(begin) == 0:
        raise ValueError(f"starts of shape {begin.shape} must be (n, 2) or (n, 4) with n >= 1")
    if end.shape != (len(begin), 2):
        raise ValueError(f"goals of shape {end.shape} must be ({len(begin)}, 2)")
    radius = np.broadcast_to(np.asarray(obstacle_radius, dtype=np.float64), (len(centres),))
    for name, array in (("starts", begin), ("goals", end), ("obstacles", centres)):
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name} must be finite")
    core = agent_radius if core_radius is None else core_radius
    check_positive("agent_radius", agent_radius)
    check_not_negative("core_radius", core, "or None for agent_radius")
    if not np.all(radius > 0.0):
        raise ValueError(f"obstacle_radius={radius.tolist()} must be > 0")
    if begin.shape[1] == 2:
        begin = np.hstack([begin, np.zeros_like(begin)])
    return _Scene(
        begin,
        np.hstack([end, np.zeros_like(end)]),
        centres,
        radius + core,
        2.0 * agent_radius,
    )
