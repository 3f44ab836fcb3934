"""Joint plans against the full dynamics, true distances on a fine grid and other optimisers."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from lagros_envs.dynamics import hold_step
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.planning import grid_path
from lagros_policies.planning.grid_path import (
    GridSettings,
    shortest_paths,
    smooth_progress,
    straighten,
    walk,
)
from lagros_policies.planning.joint import scp as joint_scp
from lagros_policies.planning.joint import search
from lagros_policies.planning.joint.plan import swept_distances
from lagros_policies.planning.joint.planner import (
    JointPlanner,
    JointPlannerSettings,
)
from lagros_policies.planning.joint.problem import JointScpSettings
from lagros_policies.planning.joint.search import search_in_turn
from lagros_policies.planning.qp import QpSolution
from lagros_policies.planning.vectors import segment_distance
from lagros_policies.tasks.spacecraft.setup import write_plan
from lagros_policies.tasks.spacecraft.thrusters import thrust_for_acceleration

OBSTACLE, AGENT = 0.5, 0.25
NONE = np.empty((0, 2))


def apart(rng, count, distance, others, away, far_from=None):
    """Draw points in [0, 5]^2, `distance` from each other and `away` from the others, or None."""
    points = []
    for _ in range(4000):
        point = rng.uniform(0.0, 5.0, 2)
        clear = all(np.linalg.norm(point - other) >= distance for other in points)
        clear &= all(np.linalg.norm(point - other) >= away for other in others)
        if far_from is not None:
            clear &= np.linalg.norm(point - far_from[len(points)]) >= 2.5
        if clear:
            points.append(point)
            if len(points) == count:
                return np.array(points)
    return None


def scenario(seed, agents=6, margin=0.3):
    """Draw starts, goals and obstacles like the preset `paper`, with passages open for a margin."""
    rng = np.random.default_rng([77, seed])
    while True:
        count = int(rng.integers(3, 7))
        obstacles = apart(rng, count, 2 * (OBSTACLE + AGENT + margin), [], 0.0)
        if obstacles is None:
            continue
        room = OBSTACLE + AGENT + margin
        starts = apart(rng, agents, 2 * AGENT + margin, obstacles, room)
        if starts is None:
            continue
        goals = apart(rng, agents, 2 * AGENT + margin, obstacles, room, starts)
        if goals is not None:
            return starts, goals, obstacles


def true_clearance(plan, obstacles, samples=50):
    """Return the least room of a plan from its polynomials, every 0.01 s."""
    h = plan.node_period
    time = (np.arange(samples) * h / samples)[:, None]
    least = np.inf
    for k in range(plan.forces.shape[1]):
        place, speed = plan.states[:, k, None, :2], plan.states[:, k, None, 2:]
        points = place + time * speed + 0.5 * time**2 * plan.forces[:, k, None] / plan.mass
        for one in range(len(points)):
            for centre in obstacles:
                gap = np.linalg.norm(points[one] - centre, axis=1) - OBSTACLE - AGENT
                least = min(least, gap.min())
            for other in range(one):
                gap = np.linalg.norm(points[one] - points[other], axis=1) - 2 * AGENT
                least = min(least, gap.min())
    return least


def check(plan, starts, goals, obstacles, settings):
    assert plan.solved, plan.status
    assert plan.states[:, 0, :2] == pytest.approx(starts, abs=1e-5)
    assert plan.states[:, -1, :2] == pytest.approx(goals, abs=1e-5)
    assert plan.states[:, [0, -1], 2:] == pytest.approx(0.0, abs=1e-5)
    assert np.max(np.abs(plan.states[..., 2:])) <= settings.speed_limit + 1e-5
    least = true_clearance(plan, obstacles)
    assert least >= plan.margin - 2e-3
    # The sweep moves straight between instants of 0.05 s; the plan bends a little.
    assert plan.clearance == pytest.approx(least, abs=2e-3)


def count_solved(seeds):
    planner = JointPlanner()
    solved = 0
    for seed in seeds:
        starts, goals, obstacles = scenario(seed)
        plan = planner.plan(starts, goals, obstacles, OBSTACLE, AGENT)
        if plan.solved:
            solved += 1
            check(plan, starts, goals, obstacles, planner.settings)
        else:
            assert "solved" not in plan.status
    return solved


def test_plans_of_random_scenarios_keep_their_margins_between_nodes():
    assert count_solved(range(8)) == 8


@pytest.mark.slow
def test_at_least_98_percent_of_random_scenarios_are_solved():
    assert count_solved(range(100, 200)) >= 98


@pytest.fixture(scope="module")
def crowded():
    starts, goals, obstacles = scenario(3)
    plan = JointPlanner().plan(starts, goals, obstacles, OBSTACLE, AGENT)
    assert plan.solved
    return starts, goals, obstacles, plan


def test_eight_thrusters_fly_the_plan_at_any_heading(crowded):
    *_, plan = crowded
    headings = np.linspace(-3.0, 3.0, 6)
    reference, accelerations = np.full((306, 6, 6), np.nan), np.full((305, 6, 3), np.nan)
    assert write_plan(plan, 2, headings, 0.1, reference, accelerations) == 302
    body = Spacecraft()
    thrust = thrust_for_acceleration(body, reference[2:-1], accelerations[2:])
    state, states = reference[2], [reference[2]]
    for held in thrust:
        state = hold_step(body, state, held, 0.1)
        states.append(state)
    assert np.all(thrust >= 0.0)
    assert np.isnan(reference[:2]).all()
    assert np.isnan(accelerations[:2]).all()
    # The quadratic programs keep their equalities to 1e-6 per node step.
    assert np.max(np.abs(np.array(states) - reference[2:])) < 1e-3
    assert np.array(states)[..., 2] == pytest.approx(np.tile(headings, (304, 1)), abs=1e-9)
    effort = 0.1 * np.sum(thrust**2, axis=(0, 2))
    assert effort == pytest.approx(plan.effort, rel=1e-9)


def test_resampling_is_the_same_motion(crowded):
    *_, plan = crowded
    states, forces = plan.resample(0.1)
    assert states.shape == (6, 301, 4)
    assert forces.shape == (6, 300, 2)
    assert states[:, ::5] == pytest.approx(plan.states, abs=1e-12)
    place, speed, pull = states[:, :-1, :2], states[:, :-1, 2:], forces / plan.mass
    assert states[:, 1:, :2] == pytest.approx(place + 0.1 * speed + 0.005 * pull, abs=1e-5)
    assert states[:, 1:, 2:] == pytest.approx(speed + 0.1 * pull, abs=1e-5)
    with pytest.raises(ValueError, match="divide"):
        plan.resample(0.3)


def test_a_plan_is_the_same_every_time(crowded):
    starts, goals, obstacles, plan = crowded
    again = JointPlanner().plan(starts, goals, obstacles, OBSTACLE, AGENT)
    assert np.array_equal(plan.states, again.states)
    code = (
        "import numpy as np\n"
        "from lagros_policies.planning.joint.planner import JointPlanner\n"
        f"p = JointPlanner().plan(np.array({starts.tolist()}), np.array({goals.tolist()}),"
        f" np.array({obstacles.tolist()}), {OBSTACLE}, {AGENT})\n"
        "print(p.states.tobytes().hex()[:4000])"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == plan.states.tobytes().hex()[:4000]


def test_alone_in_the_open_the_plan_is_the_least_norm_one():
    start, goal = np.array([[0.3, 0.4]]), np.array([[4.0, 2.0]])
    plan = JointPlanner().plan(start, goal, NONE, OBSTACLE, AGENT)
    assert plan.solved
    assert plan.clearance == np.inf
    left = 0.5 * np.arange(59, -1, -1)
    gain = np.array([0.125 + 0.5 * left, np.full(60, 0.5)])
    force = np.linalg.pinv(gain) @ np.vstack([goal - start, np.zeros((1, 2))])
    assert plan.forces[0] == pytest.approx(force, abs=1e-4)
    assert plan.effort[0] == pytest.approx(0.25 * np.sum(force**2), rel=1e-4)


def test_around_one_obstacle_no_optimiser_does_better():
    from scipy.optimize import minimize

    settings = JointPlannerSettings(horizon=8.0, nodes=16, margins=(0.2,))
    start, goal, obstacle = np.array([0.0, 0.05]), np.array([3.0, 0.0]), np.array([[1.5, 0.0]])
    plan = JointPlanner(settings).plan(start[None], goal[None], obstacle, OBSTACLE, AGENT)
    assert plan.solved

    left = 0.5 * np.arange(15, -1, -1)
    ends = np.array([0.125 + 0.5 * left, np.full(16, 0.5)])
    fine = np.arange(1, 80)
    reach = np.zeros((79, 16))
    for row, instant in enumerate(fine):
        for k in range(16):
            active = np.clip(0.1 * instant - 0.5 * k, 0.0, 0.5)
            after = max(0.1 * instant - 0.5 * (k + 1), 0.0)
            reach[row, k] = 0.5 * active**2 + active * after
    required = OBSTACLE + AGENT + 0.2 + 5e-3

    def room(force):
        points = start + reach @ force.reshape(16, 2)
        return np.sum((points - obstacle[0]) ** 2, axis=1) - required**2

    def miss(force):
        return (ends @ force.reshape(16, 2) - np.vstack([goal - start, np.zeros(2)])).ravel()

    guess = plan.forces[0].ravel() + 0.05 * np.random.default_rng(0).standard_normal(32)
    answer = minimize(
        lambda f: 0.25 * f @ f,
        guess,
        jac=lambda f: 0.5 * f,
        constraints=[{"type": "ineq", "fun": room}, {"type": "eq", "fun": miss}],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert answer.success
    assert plan.effort[0] == pytest.approx(answer.fun, rel=0.03)


def test_coarse_nodes_and_large_forces_keep_the_margin_in_between():
    # The force bends the path by up to F t^2 / 2 = 5 cm between two nodes.
    settings = JointPlannerSettings(horizon=7.0, nodes=7, margins=(0.2,), restarts=0, searches=0)
    starts = np.array([[0.0, 0.05], [3.0, 1.6]])
    goals = np.array([[3.0, 0.0], [0.0, 1.6]])
    obstacle = np.array([[1.5, 0.0]])
    plan = JointPlanner(settings).plan(starts, goals, obstacle, OBSTACLE, AGENT)
    assert np.max(np.abs(plan.forces)) > 0.3
    check(plan, starts, goals, obstacle, settings)


def test_agents_that_swap_places_keep_to_the_right():
    starts = np.array([[0.0, 2.5], [5.0, 2.5]])
    plan = JointPlanner().plan(starts, starts[::-1], NONE, OBSTACLE, AGENT)
    assert plan.solved
    assert plan.clearance >= 0.3
    middle = plan.states[:, 30, 1]
    assert middle[0] < 2.5 < middle[1]


def test_a_symmetric_obstacle_is_left_on_the_left():
    obstacle = np.array([[2.5, 2.5]])
    for angle in np.linspace(0.0, 2.0 * np.pi, 7):
        arm = 2.0 * np.array([np.cos(angle), np.sin(angle)])
        plan = JointPlanner().plan((obstacle - arm), (obstacle + arm), obstacle, OBSTACLE, AGENT)
        assert plan.solved
        away = plan.states[0, 30, :2] - obstacle[0]
        assert arm[0] * away[1] - arm[1] * away[0] < 0.0


def test_speed_is_bounded_where_time_is_short():
    settings = JointPlannerSettings(horizon=8.0, nodes=16)
    plan = JointPlanner(settings).plan(
        np.array([[0.0, 0.0]]), np.array([[5.0, 0.0]]), NONE, OBSTACLE, AGENT
    )
    assert plan.solved
    assert np.max(np.abs(plan.states[..., 2:])) == pytest.approx(0.7, abs=1e-3)
    hasty = JointPlanner(settings).plan(
        np.array([[0.0, 0.0]]), np.array([[6.0, 0.0]]), NONE, OBSTACLE, AGENT
    )
    assert not hasty.solved
    assert "failed" in hasty.status


def test_replanning_takes_over_the_rest_of_a_plan():
    starts, goals, obstacles = scenario(1)
    planner = JointPlanner()
    whole = planner.plan(starts, goals, obstacles, OBSTACLE, AGENT)
    rest = planner.plan(whole.states[:, 20], goals, obstacles, OBSTACLE, AGENT, duration=20.0)
    assert rest.solved, rest.status
    assert rest.states.shape == (6, 41, 4)
    remaining = 0.25 * np.sum(whole.forces[:, 20:] ** 2)
    assert np.sum(rest.effort) <= 1.1 * remaining


def test_margins_give_way_near_ends_that_lack_room_and_there_only():
    obstacle = np.array([[2.0, 0.0]])
    start, goal = np.array([[2.0, 0.85]]), np.array([[5.0, 0.0]])
    plan = JointPlanner().plan(start, goal, obstacle, OBSTACLE, AGENT)
    assert plan.solved, plan.status
    assert plan.clearance == pytest.approx(0.1, abs=6e-3)
    states, _ = plan.resample(0.1)
    gap = np.linalg.norm(states[0, 60:, :2] - obstacle[0], axis=1) - OBSTACLE - AGENT
    assert np.min(gap) >= 0.3


def test_a_smaller_margin_is_taken_where_the_larger_does_not_fit():
    # A wall of discs with one gap that fits an agent with 0.2 m on either side, too long to round.
    wall = np.array([[0.0, y] for y in np.arange(0.95, 12.0, 0.9)])
    wall = np.vstack([wall, -wall])
    plan = JointPlanner().plan(
        np.array([[-2.0, 0.0]]), np.array([[2.0, 0.0]]), wall, OBSTACLE, AGENT
    )
    assert plan.solved, plan.status
    assert plan.margin == 0.15
    assert 0.15 <= plan.clearance <= 0.2


def test_the_impossible_is_reported_not_raised():
    starts, goals = np.array([[0.0, 0.0], [3.0, 0.0]]), np.array([[3.0, 3.0], [3.0, 3.2]])
    plan = JointPlanner().plan(starts, goals, NONE, OBSTACLE, AGENT)
    assert not plan.solved
    assert "overlap" in plan.status
    assert plan.clearance < 0.0
    assert plan.attempts >= 1


def test_failing_quadratic_programs_are_counted_and_named(monkeypatch):
    def fail(program, tolerance):
        return QpSolution(np.full(program.cost_diagonal.size, np.nan), False, "PIQP: broken")

    monkeypatch.setattr(joint_scp, "solve_qp", fail)
    starts, goals, obstacles = scenario(0)
    plan = JointPlanner().plan(starts, goals, obstacles, OBSTACLE, AGENT)
    assert not plan.solved
    assert "broken" in plan.status
    assert np.all(np.isfinite(plan.states))
    assert plan.iterations == plan.attempts > 1


def test_candidates_never_cost_more_effort():
    starts, goals, obstacles = scenario(2)
    efforts = []
    for candidates in (1, 3):
        settings = JointPlannerSettings(candidates=candidates)
        plan = JointPlanner(settings).plan(starts, goals, obstacles, OBSTACLE, AGENT)
        assert plan.solved
        efforts.append(np.sum(plan.effort))
    assert efforts[1] <= efforts[0]


def test_sweep_sees_a_pass_between_two_instants():
    places = np.array([[[-1.0, 0.1], [1.0, 0.1]], [[0.0, -1.0], [0.0, 1.0]]])
    gaps, pairs = swept_distances(places, np.array([[0.0, 0.0], [3.0, 0.1]]))
    assert gaps.shape == (1, 2, 2)
    assert gaps[0] == pytest.approx(np.array([[0.1, 2.0], [0.0, np.hypot(3.0, 0.0)]]), abs=2e-3)
    assert pairs[0, 0] == pytest.approx(0.1 / np.sqrt(2.0))


def test_segment_distance_of_a_point_is_the_distance():
    points = np.array([[1.0, 1.0]])
    assert segment_distance(np.zeros(2), np.zeros(2), points) == pytest.approx([np.sqrt(2.0)])


def test_shortest_path_goes_around_and_is_nearly_shortest():
    obstacle, radius = np.array([[2.5, 2.5]]), np.array([1.0])
    start, goal = np.array([[0.5, 2.5]]), np.array([[4.5, 2.5]])
    (path,) = shortest_paths(start, goal, obstacle, radius, GridSettings())
    assert np.array_equal(path[[0, -1]], np.vstack([start, goal]))
    length = np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1))
    # Two tangents of length sqrt(3) and an arc of 60 degrees.
    exact = 2.0 * np.sqrt(3.0) + np.pi / 3.0
    assert exact - 0.05 < length < 1.08 * exact


def test_straight_path_stays_straight():
    path = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])
    assert np.array_equal(straighten(path, NONE, np.empty(0)), path[[0, -1]])


def test_walk_follows_the_path_and_steps_to_the_right():
    path = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])
    assert walk(path, np.array([0.0, 0.5, 0.75, 1.0])) == pytest.approx(
        np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [2.0, 2.0]])
    )
    straight = walk(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([0.0, 0.5, 1.0]), 0.1)
    assert straight == pytest.approx(np.array([[0.0, 0.0], [0.5, -0.1], [1.0, 0.0]]), abs=1e-12)
    still = walk(np.ones((2, 2)), smooth_progress(np.linspace(0.0, 9.0, 5), 0.0, 9.0), 0.1)
    assert still == pytest.approx(np.ones((5, 2)))


def test_search_in_turn_lets_the_later_agent_give_way():
    starts = np.array([[0.0, 0.0], [4.0, 0.0]])
    times = np.linspace(0.0, 30.0, 301)
    for order in (np.array([0, 1]), np.array([1, 0])):
        guess = search_in_turn(
            starts, starts[::-1], NONE, np.empty(0), 0.8, times, order, GridSettings()
        )
        assert guess[:, 0] == pytest.approx(starts)
        assert guess[:, -1] == pytest.approx(starts[::-1])
        _, pairs = swept_distances(guess, NONE)
        assert np.min(pairs) > 0.5
        assert np.max(np.abs(guess[order[0], :, 1])) < 0.25


@pytest.mark.parametrize("far", [60.0, 300.0, 1e6])
def test_no_more_cells_are_looked_at_however_far_things_are(monkeypatch, far):
    counts = []
    dijkstra, chain = grid_path.dijkstra, search._cheapest_chain
    monkeypatch.setattr(
        grid_path,
        "dijkstra",
        lambda graph, **options: (counts.append(graph.shape[0]), dijkstra(graph, **options))[1],
    )
    monkeypatch.setattr(
        search,
        "_cheapest_chain",
        lambda prices, *ends: (counts.append(prices[0].size), chain(prices, *ends))[1],
    )
    settings = GridSettings(most_cells=20_000, most_search_cells=5_000)
    starts = np.array([[0.0, 0.0], [far, far], [0.0, 1.0]])
    goals = np.array([[4.0, 0.0], [far + 4.0, far], [far, 0.2 * far]])
    obstacles, radius = np.array([[2.0, 0.0], [0.5 * far, 0.1 * far]]), np.array([1.0, 1.0])
    paths = shortest_paths(starts, goals, obstacles, radius, settings)
    assert sum(counts) <= 20_000
    counts.clear()
    times, order = np.linspace(0.0, 30.0, 31), np.arange(3)
    guess = search_in_turn(starts, goals, obstacles, radius, 0.8, times, order, settings)
    assert sum(counts) <= 5_000
    for agent in range(3):
        for way in (paths[agent], guess[agent]):
            assert np.array_equal(way[[0, -1]], np.stack([starts[agent], goals[agent]]))
    # Near by, each has a grid as fine as ever: the first goes around, the second straight on.
    assert np.min(segment_distance(paths[0][:-1], paths[0][1:], obstacles[:1])) > 0.99
    assert len(paths[1]) == 2


def test_a_grid_that_is_small_enough_is_what_it_was():
    starts, goals, obstacles = scenario(0)
    radius = np.full(len(obstacles), 0.9)
    every = [
        shortest_paths(starts, goals, obstacles, radius, GridSettings(most_cells=most))
        for most in (100_000, 10**9)
    ]
    for one, other in zip(*every, strict=True):
        assert np.array_equal(one, other)


def test_positions_beyond_all_sense_are_named():
    ends = np.array([[0.0, 0.0]]), np.array([[1e300, 0.0]])
    with pytest.raises(ValueError, match=r"1e\+300 m must be below"):
        shortest_paths(*ends, NONE, np.empty(0), GridSettings())


@pytest.mark.parametrize("far", [25.0, 1e3])
def test_a_goal_out_of_reach_is_a_failed_plan_after_one_program(far):
    starts = np.array([[0.0, 0.0], [1.5, 0.0]])
    goals = starts + np.array([far, 0.0])
    plan = JointPlanner().plan(starts, goals, np.array([[3.0, 0.1]]), OBSTACLE, AGENT)
    assert not plan.solved
    assert plan.attempts == 1
    assert "out of reach at speed_limit=0.7 m/s" in plan.status
    assert np.all(np.isfinite(plan.states))


def test_agents_far_apart_are_planned_each_in_its_own_place():
    starts = np.array([[0.0, 0.0], [400.0, 300.0]])
    plan = JointPlanner().plan(
        starts, starts + np.array([5.0, 0.0]), np.array([[2.5, 0.0]]), OBSTACLE, AGENT
    )
    assert plan.solved
    assert plan.attempts == 1
    assert true_clearance(plan, np.array([[2.5, 0.0]])) > 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"starts": np.zeros((2, 3))}, "starts"),
        ({"goals": np.zeros((3, 2))}, "goals"),
        ({"starts": np.full((2, 2), np.nan)}, "finite"),
        ({"agent_radius": 0.0}, "agent_radius"),
        ({"core_radius": -0.1}, "core_radius"),
        ({"duration": 0.7}, "duration"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    arguments = {
        "starts": np.array([[0.0, 0.0], [3.0, 0.0]]),
        "goals": np.array([[3.0, 3.0], [0.0, 3.0]]),
        "obstacles": np.array([[1.5, 1.5]]),
        "obstacle_radius": OBSTACLE,
        "agent_radius": AGENT,
    }
    with pytest.raises(ValueError, match=message):
        JointPlanner().plan(**{**arguments, **change})


@pytest.mark.parametrize(
    ("settings", "change"),
    [
        (JointPlannerSettings(), {"horizon": 0.0}),
        (JointPlannerSettings(), {"nodes": 1}),
        (JointPlannerSettings(), {"control_period": 0.3}),
        (JointPlannerSettings(), {"check_period": 0.4}),
        (JointPlannerSettings(), {"margins": ()}),
        (JointPlannerSettings(), {"margins": (0.1, 0.3)}),
        (JointPlannerSettings(), {"margins": (-0.1,)}),
        (JointPlannerSettings(), {"pair_share": -1.0}),
        (JointPlannerSettings(), {"candidates": 0}),
        (JointScpSettings(), {"penalty": 0.0}),
        (JointScpSettings(), {"max_iterations": 0}),
        (GridSettings(), {"cell": 0.0}),
        (GridSettings(), {"preference": 1.0}),
        (GridSettings(), {"border": -1.0}),
        (GridSettings(), {"most_cells": 1}),
        (GridSettings(), {"most_search_cells": 1e5}),
    ],
)
def test_settings_are_checked(settings, change):
    with pytest.raises(ValueError, match=next(iter(change))):
        dataclasses.replace(settings, **change)
