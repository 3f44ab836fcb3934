"""Joint sequential convex programming for many planar double integrators among discs.

    min  1/2 sum_i int ||F_i||^2 dt
    s.t. dp_i/dt = v_i, dv_i/dt = F_i / m, F_i held over a node step, given ends, |v_i| <= v_max,
         ||p_i(t) - o_j|| >= R_ij(t) and ||p_i(t) - p_j(t)|| >= R_ij(t)

The dynamics are linear, so that only the distances are linearised: along the unit vector e from
the obstacle (or the other agent) to the agent in the last plan, ||p - o|| >= e'(p - o). Each
half-plane lies inside the true set. A plan that keeps the half-planes therefore keeps the
distances at the instants where they were imposed, the effort falls from pass to pass, and no trust
region is needed. The half-planes are imposed at the nodes and, where agents come near, at the
control instants between them; those far from the last plan are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from lagros_policies.planning.qp import UNBOUNDED, QuadraticProgram, solve_qp

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class JointScpSettings:
    """How long and how precisely to iterate.

    Attributes:
        max_iterations: Quadratic programs at most.
        effort_tolerance: Stop when the effort falls by less than this share in one pass.
        distance_tolerance: Largest violation of a distance at a control instant that counts as
            none [m].
        reach: A half-plane is imposed at a node where the last plan is nearer than the required
            distance plus this [m].
        near: Likewise at the control instants between nodes [m].
        penalty: Weight of a violated half-plane [N^2 s / m]; above the multipliers of the problem
            the penalty is exact.
        qp_tolerance: Residual of the quadratic programs.
        patience: Give up when the violation has not halved within this many passes.

    Raises:
        ValueError: A value is not positive.
    """

    max_iterations: int = 25
    effort_tolerance: float = 1e-2
    distance_tolerance: float = 4e-3
    reach: float = 1.0
    near: float = 0.1
    penalty: float = 1.0
    qp_tolerance: float = 1e-6
    patience: int = 6

    def __post_init__(self) -> None:
        """Check the values."""
        for name in self.__dataclass_fields__:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}={getattr(self, name)!r} must be > 0")


@dataclass(frozen=True)
class JointProblem:
    """What to plan. The grid of control instants has K = N * substeps steps.

    Attributes:
        starts: [p, v] at t = 0, shape (n, 4) [m, m/s].
        goals: [p, v] at the end, shape (n, 4).
        obstacles: Centres, shape (m, 2) [m].
        obstacle_required: R_ij at the control instants, shape (K + 1, n, m) [m].
        pair_required: R_ij at the control instants for the pairs of `pairs`, shape (K + 1, P) [m].
        node_period: Time from node to node [s].
        substeps: Control steps in a node step.
        mass: m [kg].
        speed_limit: v_max per agent and axis, shape (n, 2) [m/s].
        arrivals: Node at which each agent is at its goal, and from which on it stays there without
            force, shape (n,); the last node if left out.
        start_cost: If given, a plan may begin beside `starts`: each axis' deviation e = (position,
            velocity) costs e'Qe / 2 with this positive definite Q, shape (2, 2).
    """

    starts: FloatArray
    goals: FloatArray
    obstacles: FloatArray
    obstacle_required: FloatArray
    pair_required: FloatArray
    node_period: float
    substeps: int
    mass: float
    speed_limit: FloatArray
    arrivals: IntArray | None = None
    start_cost: FloatArray | None = None

    @property
    def nodes(self) -> int:
        """Number N of node steps."""
        return (len(self.pair_required) - 1) // self.substeps

    @property
    def pairs(self) -> tuple[IntArray, IntArray]:
        """Indices of the agents of each pair, both of shape (P,)."""
        first, second = np.triu_indices(len(self.starts), 1)
        return first, second


@dataclass(frozen=True)
class JointSolution:
    """What the iteration ended with.

    Attributes:
        states: [p, v] at the nodes, shape (n, N + 1, 4).
        forces: F, shape (n, N, 2) [N].
        solved: Whether every distance is kept at every control instant, within the tolerance.
        status: Why the iteration stopped, in words.
        violation: Largest violation of a distance at a control instant [m].
        iterations: Quadratic programs solved.
    """

    states: FloatArray
    forces: FloatArray
    solved: bool
    status: str
    violation: float
    iterations: int


def positions_between(
    states: FloatArray, forces: FloatArray, mass: float, node_period: float, substeps: int
) -> tuple[FloatArray, FloatArray]:
    """Evaluate a plan between its nodes, exactly.

    Args:
        states: [p, v] at the nodes, shape (n, N + 1, 4).
        forces: F held between them, shape (n, N, 2) [N].
        mass: m [kg].
        node_period: Time from node to node [s].
        substeps: Instants per node step.

    Returns:
        Positions and velocities, both of shape (n, N * substeps + 1, 2).
    """
    time = (np.arange(substeps) * (node_period / substeps))[:, None]
    place, speed = states[:, :-1, None, :2], states[:, :-1, None, 2:]
    pull = forces[:, :, None, :] / mass
    place = place + time * speed + 0.5 * time**2 * pull
    speed = speed + time * pull
    shape = len(states), -1, 2
    return (
        np.concatenate([place.reshape(shape), states[:, -1:, :2]], axis=1),
        np.concatenate([speed.reshape(shape), states[:, -1:, 2:]], axis=1),
    )


def solve_joint(
    problem: JointProblem, guess: FloatArray, settings: JointScpSettings
) -> JointSolution:
    """Iterate from a guess of the positions.

    Args:
        problem: What to plan.
        guess: Positions at the control instants, shape (n, K + 1, 2) [m].
        settings: How to iterate.

    Returns:
        The plan of the last pass; `solved` says whether it keeps the distances.
    """
    layout = _Layout(problem)
    places = guess
    states, forces = _rest(problem)
    effort = violation = np.inf
    best, stale = np.inf, 0
    status = f"distances not met in {settings.max_iterations} quadratic programs"
    iterations = 0
    while iterations < settings.max_iterations:
        program = layout.program(problem, places, settings)
        answer = solve_qp(program, settings.qp_tolerance)
        iterations += 1
        if not answer.solved:
            status = f"quadratic program {iterations} failed ({answer.status})"
            violation = np.inf
            break
        states = answer.values[layout.states].transpose(1, 0, 2)
        forces = answer.values[layout.forces].transpose(1, 0, 2)
        places, _ = positions_between(
            states, forces, problem.mass, problem.node_period, problem.substeps
        )
        violation = largest_violation(problem, places)
        before, effort = effort, 0.5 * problem.node_period * float(np.sum(forces**2))
        if violation <= settings.distance_tolerance:
            if before - effort <= settings.effort_tolerance * effort:
                status = "solved"
                break
            status = "solved, effort still falling"
        else:
            status = f"distances not met in {settings.max_iterations} quadratic programs"
            stale = 0 if violation < 0.5 * best else stale + 1
            if stale >= settings.patience:
                status = f"violation stays at {violation:.3f} m"
                break
        best = min(best, violation)
    solved = violation <= settings.distance_tolerance
    return JointSolution(states, forces, solved, status, float(violation), iterations)


def largest_violation(problem: JointProblem, places: FloatArray) -> float:
    """Return by how much the worst distance at a control instant falls short [m], at least 0.

    Args:
        problem: The problem.
        places: Positions at the control instants, shape (n, K + 1, 2) [m].
    """
    first, second = problem.pairs
    apart = np.linalg.norm(places[first] - places[second], axis=-1).T
    gaps = np.linalg.norm(places[:, :, None] - problem.obstacles, axis=-1).transpose(1, 0, 2)
    short = [problem.pair_required - apart, problem.obstacle_required - gaps]
    return max(0.0, *(float(np.max(part, initial=0.0)) for part in short))


def _rest(problem: JointProblem) -> tuple[FloatArray, FloatArray]:
    n, nodes = len(problem.starts), problem.nodes
    return np.repeat(problem.starts[:, None], nodes + 1, axis=1), np.zeros((n, nodes, 2))


class _Layout:
    """Where the unknowns lie, and the part of the program that no pass changes.

    Unknowns: per node the forces and states of all agents, then two per half-plane: by how much it
    is violated and by how much it is kept.
    """

    def __init__(self, problem: JointProblem) -> None:
        nodes, n = problem.nodes, len(problem.starts)
        block = np.arange(nodes + 1)[:, None, None] * (6 * n)
        agent = np.arange(n)[None, :, None] * 6
        self.forces = (block + agent + np.arange(2))[:nodes]  # (N, n, 2)
        self.states = block + agent + 2 + np.arange(4)  # (N + 1, n, 4)
        # From the arrival on, the last node included, there is no force: pinned to zero.
        self.size = (nodes + 1) * 6 * n
        h = problem.node_period
        here, there = self.states[:-1], self.states[1:]
        place, speed = slice(0, 2), slice(2, 4)
        one = np.ones(here[..., place].shape)
        rows = np.arange(nodes * n * 4).reshape(nodes, n, 4)
        entries = [
            (rows[..., place], there[..., place], one),
            (rows[..., place], here[..., place], -one),
            (rows[..., place], here[..., speed], -h * one),
            (rows[..., place], self.forces, -0.5 * h**2 / problem.mass * one),
            (rows[..., speed], there[..., speed], one),
            (rows[..., speed], here[..., speed], -one),
            (rows[..., speed], self.forces, -h / problem.mass * one),
        ]
        count = rows.size
        goal_target = problem.goals
        ends = count + np.arange(goal_target.size).reshape(goal_target.shape)
        arrivals = np.full(n, nodes) if problem.arrivals is None else problem.arrivals
        entries.append((ends, self.states[arrivals, np.arange(n)], np.ones(goal_target.shape)))
        stays = np.arange(nodes + 1)[:, None] >= arrivals
        self.idle = (block + agent + np.arange(2))[stays].ravel()
        count += goal_target.size
        start = count + np.arange(problem.starts.size).reshape(problem.starts.shape)
        start_target = problem.starts
        self.start_errors = np.empty(0, dtype=np.intp)
        if problem.start_cost is None:
            entries.append((start, self.states[0], np.ones(start_target.shape)))
        else:
            # Unknowns r = U e with Q = U'U make the cost of the deviation a diagonal one.
            root = np.linalg.cholesky(problem.start_cost).T
            self.start_errors = self.size + np.arange(start_target.size)
            self.size += start_target.size
            first = self.states[0]
            entries += [
                (start[:, place], first[:, place], np.full((n, 2), root[0, 0])),
                (start[:, place], first[:, speed], np.full((n, 2), root[0, 1])),
                (start[:, speed], first[:, speed], np.full((n, 2), root[1, 1])),
                (start.ravel(), self.start_errors, np.full(start.size, -1.0)),
            ]
            start_target = np.hstack(
                [
                    root[0, 0] * problem.starts[:, :2] + root[0, 1] * problem.starts[:, 2:],
                    root[1, 1] * problem.starts[:, 2:],
                ]
            )
        count += start_target.size
        self.count = count
        self.rows, self.columns, self.values = (
            np.concatenate([part[index].ravel() for part in entries]) for index in range(3)
        )
        self.target = np.concatenate(
            [np.zeros(rows.size), goal_target.ravel(), start_target.ravel()]
        )

    def program(
        self, problem: JointProblem, places: FloatArray, settings: JointScpSettings
    ) -> QuadraticProgram:
        """Return the quadratic program around positions (n, K + 1, 2)."""
        instant, agents, signs, normals, offset = _half_planes(problem, places, settings)
        rows, columns, values = self._entries(problem, instant, agents, signs, normals)
        count = len(instant)
        extra = self.size + np.arange(2 * count)
        plane = self.count + np.arange(count)
        equality = sparse.coo_matrix(
            (
                np.concatenate([self.values, values, np.ones(count), -np.ones(count)]),
                (
                    np.concatenate([self.rows, rows, plane, plane]),
                    np.concatenate([self.columns, columns, extra]),
                ),
            ),
            shape=(self.count + count, self.size + 2 * count),
        ).tocsc()
        size = self.size + 2 * count
        diagonal = np.zeros(size)
        diagonal[self.forces] = problem.node_period
        diagonal[self.start_errors] = 1.0
        linear = np.zeros(size)
        linear[self.size : self.size + count] = settings.penalty
        low, high = np.full(size, -UNBOUNDED), np.full(size, UNBOUNDED)
        low[self.size :] = 0.0
        low[self.idle] = high[self.idle] = 0.0
        speeds = self.states[1:-1, :, 2:]
        low[speeds], high[speeds] = -problem.speed_limit, problem.speed_limit
        target = np.concatenate([self.target, offset])
        return QuadraticProgram(diagonal, linear, equality, target, low, high)

    def _entries(
        self,
        problem: JointProblem,
        instant: IntArray,
        agents: IntArray,
        signs: FloatArray,
        normals: FloatArray,
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Return the entries of the half-planes on forces and states."""
        node = instant // problem.substeps
        time = (instant - node * problem.substeps) * (problem.node_period / problem.substeps)
        rows, columns, values = [], [], []
        for column in range(agents.shape[1]):
            takes_part = np.flatnonzero(signs[:, column] != 0.0)
            agent, k = agents[takes_part, column], node[takes_part]
            slope = signs[takes_part, column, None] * normals[takes_part]
            t = time[takes_part, None]
            for place, weight in (
                (self.states[k, agent, :2], np.ones_like(t)),
                (self.states[k, agent, 2:], t),
                (self.forces[np.minimum(k, problem.nodes - 1), agent], 0.5 * t**2 / problem.mass),
            ):
                keep = np.broadcast_to(weight != 0.0, slope.shape)
                row = np.broadcast_to((self.count + takes_part)[:, None], slope.shape)
                rows.append(row[keep])
                columns.append(place[keep])
                values.append((weight * slope)[keep])
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def _half_planes(
    problem: JointProblem, places: FloatArray, settings: JointScpSettings
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Linearise the distances that matter around positions.

    Returns:
        Control instant (r,), the two agents (r, 2), their signs (r, 2), unit normals (r, 2) and
        right sides (r,): sum of sign * normal'p >= right side.
    """
    last = places.shape[1] - 1
    reach = np.where(np.arange(last + 1) % problem.substeps == 0, settings.reach, settings.near)
    # Where an end is given nothing can be imposed.
    reach[last] = -np.inf
    if problem.start_cost is None:
        reach[0] = -np.inf
    first, second = problem.pairs
    # Obstacles: the second agent takes no part.
    delta = places[:, :, None, :] - problem.obstacles
    distance = np.linalg.norm(delta, axis=-1)
    required = problem.obstacle_required.transpose(1, 0, 2)
    agent, instant, disc = np.nonzero(distance < required + reach[None, :, None])
    chosen = agent, instant, disc
    normal = _unit(delta[chosen], distance[chosen])
    offset = required[chosen] + np.sum(normal * problem.obstacles[disc], axis=-1)
    # Pairs.
    between = places[first] - places[second]
    apart = np.linalg.norm(between, axis=-1)
    needed = problem.pair_required.T
    pair, when = np.nonzero(apart < needed + reach[None, :])
    side = _unit(between[pair, when], apart[pair, when])
    return (
        np.concatenate([instant, when]),
        np.concatenate(
            [np.stack([agent, agent], axis=1), np.stack([first[pair], second[pair]], axis=1)]
        ),
        np.concatenate(
            [np.tile([1.0, 0.0], (len(agent), 1)), np.tile([1.0, -1.0], (len(pair), 1))]
        ),
        np.concatenate([normal, side]),
        np.concatenate([offset, needed[pair, when]]),
    )


def _unit(delta: FloatArray, length: FloatArray) -> FloatArray:
    """Return unit vectors; where the length vanishes, a fixed one."""
    small = length < 1e-9
    unit: FloatArray = delta / np.where(small, 1.0, length)[:, None]
    unit[small] = (0.0, 1.0)
    return unit
