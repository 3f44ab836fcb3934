"""The plan of one agent among what it senses: motion, distances, guesses, and its map."""

import numpy as np
import pytest

from lagros_policies.planning.grid_path import GridSettings, shortest_paths
from lagros_policies.planning.local.guess import pass_aside, way_around
from lagros_policies.planning.local.map import LocalMap
from lagros_policies.planning.local.motion import Discs
from lagros_policies.planning.local.plan import LocalPlanner
from lagros_policies.planning.local.problem import LocalPlannerSettings
from lagros_policies.planning.vectors import segment_distance

HERE = np.zeros(2)


def still(centres, touching=0.75, margin=0.15):
    """Return discs at rest."""
    centres = np.atleast_2d(np.asarray(centres, float))
    count = len(centres)
    return Discs(
        centres,
        np.zeros((count, 2)),
        np.full(count, touching),
        np.full(count, margin),
        np.zeros(count, bool),
    )


# The plan.


@pytest.mark.parametrize("seed", range(4))
def test_the_plan_obeys_the_double_integrator(seed):
    rng = np.random.default_rng(seed)
    start, mass = rng.uniform(-3.0, 3.0, 4) * [1.0, 1.0, 0.1, 0.1], 1.7
    planner = LocalPlanner(LocalPlannerSettings(mass=mass))
    plan = planner.plan(start, HERE, still(rng.uniform(-2.0, 2.0, (2, 2))), rng.uniform(10.0, 30.0))
    place, speed, now = start[:2].copy(), start[2:].copy(), 0.0
    for step, end in enumerate(plan.edges[1:]):
        count = 200
        h = (end - now) / count
        for _ in range(count):  # exact for a force that is held
            force = plan.force(now)
            assert np.array_equal(force, plan.forces[step])
            place += h * speed + 0.5 * h**2 * force / mass
            speed += h * force / mass
            now += h
        now = end
        places, speeds = plan.at(np.array([end]))
        assert places[0] == pytest.approx(place, abs=1e-9)
        assert speeds[0] == pytest.approx(speed, abs=1e-9)
    assert np.concatenate([place, speed]) == pytest.approx(np.zeros(4), abs=1e-4)


def test_after_its_end_the_plan_rests_at_the_goal():
    plan = LocalPlanner().plan(np.array([1.0, 2.0, 0.0, 0.0]), HERE, Discs.none(), 12.0)
    assert plan.duration == 12.0
    places, speeds = plan.at(np.array([12.0, 50.0]))
    assert places == pytest.approx(np.zeros((2, 2)), abs=1e-5)
    assert np.all(speeds[1] == 0.0)
    assert np.all(plan.force(12.0) == 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_without_obstacles_the_plan_is_the_motion_of_least_energy(seed):
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-2.0, 2.0, 2), rng.uniform(-0.1, 0.1, 2)
    left = 20.0
    plan = LocalPlanner().plan(np.concatenate([place, speed]), HERE, Discs.none(), left)
    assert plan.solved
    assert plan.short == 0.0
    # The cubic p(t) of Hermite's data, and 1/2 int |p''|^2 of it.
    t = np.linspace(0.0, left, 101)
    share = (t / left)[:, None]
    cubic = place * (1 - share) ** 2 * (1 + 2 * share) + left * speed * share * (1 - share) ** 2
    effort = 6 * place @ place / left**3 + 6 * place @ speed / left**2 + 2 * speed @ speed / left
    assert plan.at(t)[0] == pytest.approx(cubic, abs=0.02)
    assert effort <= plan.cost <= 1.03 * effort


def test_without_obstacles_the_plan_is_the_optimum_of_its_own_steps():
    start, left = np.array([1.5, -0.7, 0.1, 0.05]), 25.0
    plan = LocalPlanner().plan(start, HERE, Discs.none(), left)
    lengths = np.diff(plan.edges)
    # Position and velocity at the end of one axis, for a unit force in each step in turn.
    ends = []
    for step in range(len(lengths)):
        place = speed = 0.0
        for index, h in enumerate(lengths):
            force = float(index == step)
            place, speed = place + h * speed + 0.5 * h * h * force, speed + h * force
        ends.append((place, speed))
    response = np.array(ends).T
    target = -np.stack([start[:2] + left * start[2:], start[2:]])
    weighted = response / lengths
    forces = weighted.T @ np.linalg.solve(weighted @ response.T, target)
    assert plan.forces == pytest.approx(forces, abs=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_the_plan_clears_obstacles_between_its_instants(seed):
    rng = np.random.default_rng(seed)
    start = np.array([3.0, 0.0, 0.0, 0.0])
    centres = np.array([[1.6, rng.uniform(-0.6, 0.6)], [-1.0, 1.5]])
    plan = LocalPlanner().plan(start, HERE, still(centres), rng.uniform(12.0, 30.0))
    assert plan.solved
    assert plan.short <= 0.01
    places, _ = plan.at(np.arange(0.0, plan.duration, 0.01))
    gaps = np.linalg.norm(places[:, None] - centres, axis=-1)
    assert gaps.min() >= 0.9 - 1e-3
    assert gaps.min() <= 0.95  # and no detour


def test_the_plan_keeps_clear_of_one_that_moves():
    start = np.array([2.0, 0.0, 0.0, 0.0])
    crossing = Discs(
        np.array([[1.5, -1.0]]),
        np.array([[0.0, 0.25]]),
        np.array([0.5]),
        np.array([0.2]),
        np.array([True]),
    )
    planner = LocalPlanner()
    plan = planner.plan(start, HERE, crossing, 10.0)
    times = np.arange(0.0, planner.settings.foresight, 0.01)
    apart = np.linalg.norm(
        plan.at(times)[0] - crossing.centres - times[:, None] * crossing.velocities, axis=-1
    )
    assert plan.short <= 0.01
    assert apart.min() >= 0.7 - 2e-3
    free = planner.plan(start, HERE, Discs.none(), 10.0)
    apart = np.linalg.norm(
        free.at(times)[0] - crossing.centres - times[:, None] * crossing.velocities, axis=-1
    )
    assert apart.min() < 0.7


def test_the_speed_stays_below_its_limit():
    # Someone comes fast, and to give way in time is to hurry.
    comes = Discs(
        np.array([[4.2, 0.1]]),
        np.array([[0.5, -0.1]]),
        np.array([0.5]),
        np.array([0.3]),
        np.array([True]),
    )
    start = np.array([5.0, 0.0, -0.1, 0.0])
    fastest = []
    for limit in (5.0, 0.35):
        planner = LocalPlanner(LocalPlannerSettings(speed_limit=limit))
        plan = planner.plan(start, HERE, comes, 30.0)
        assert plan.solved
        assert plan.duration >= 2.0 * 5.0 / limit
        fastest.append(np.max(np.abs(plan.at(plan.edges)[1])))
    assert fastest[0] > 0.4
    assert fastest[1] <= 0.35 + 1e-4


def test_what_cannot_be_kept_is_said():
    # Three of the four ways out are closed and the fourth is too narrow for the margins.
    corners = [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]
    start, goal = np.zeros(4), np.array([3.0, 0.0])
    tight = LocalPlanner().plan(start, goal, still(corners, 0.75, 0.4), 20.0)
    assert tight.solved
    assert tight.short > 0.05
    # Shortfalls are shared: it passes in the middle of the two.
    places, _ = tight.at(np.arange(0.0, 20.0, 0.1))
    gaps = np.linalg.norm(places[:, None] - np.array(corners)[:2], axis=-1).min(axis=0)
    assert gaps[0] == pytest.approx(gaps[1], abs=0.02)
    loose = LocalPlanner().plan(start, goal, still(corners, 0.75, 0.1), 20.0)
    assert loose.short <= 0.01


def test_a_start_inside_a_margin_is_left_not_refused():
    plan = LocalPlanner().plan(np.array([2.0, 0.0, 0.0, 0.0]), HERE, still([[2.85, 0.0]]), 20.0)
    assert plan.short <= 0.01


@pytest.mark.parametrize(
    "arguments",
    [{"mass": 0.0}, {"near_steps": 0}, {"passes": 1.5}, {"penalty": -1.0}, {"least_duration": 5.0}],
)
def test_planner_settings_are_checked(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        LocalPlannerSettings(**arguments)


@pytest.mark.parametrize("seed", range(5))
def test_the_shortfall_of_a_plan_in_force_is_that_of_its_motion(seed):
    rng = np.random.default_rng(seed)
    start, elapsed = np.array([3.0, 0.0, 0.0, 0.0]), 1.0
    plan = LocalPlanner().plan(start, HERE, Discs.none(), 20.0)
    comes = Discs(
        np.array([[1.5, -0.6], [-0.5, 2.0]]) + rng.uniform(-0.2, 0.2, (2, 2)),
        np.array([[0.0, rng.uniform(0.0, 0.2)], [0.0, 0.0]]),
        np.full(2, 0.5),
        np.full(2, 0.2),
        np.array([True, False]),
    )
    times = np.arange(0.0, 6.0, 0.01)  # the foresight
    places = plan.at(times + elapsed)[0]
    other = comes.centres[0] + times[:, None] * comes.velocities[0]
    least = np.linalg.norm(places - other, axis=-1).min()
    expected = max(0.7 - least, 0.0)
    short = LocalPlanner().shortfall(plan, elapsed, HERE, comes, 19.0)
    # It asks for a centimetre more, at instants 0.4 s apart.
    assert expected - 0.005 <= short <= expected + 0.011
    assert LocalPlanner().shortfall(plan, elapsed, HERE, Discs.none(), 19.0) == 0.0


# The guesses.


@pytest.mark.parametrize("seed", range(5))
def test_the_way_around_is_clear_and_about_as_short_as_a_grid_finds(seed):
    rng = np.random.default_rng(seed)
    centres = np.array([[1.0, 0.0], [2.5, 1.0], [2.2, -1.6]]) + rng.uniform(-0.3, 0.3, (3, 2))
    distance = np.full(3, 0.8)
    start, goal = np.array([-0.5, 0.0]), np.array([4.0, rng.uniform(-0.5, 0.5)])
    path = way_around(start, goal, centres, distance)
    assert np.all(segment_distance(path[:-1], path[1:], centres) >= 0.8 - 1e-6)
    assert np.array_equal(path[[0, -1]], [start, goal])
    grid = shortest_paths(start[None], goal[None], centres, distance, GridSettings(cell=0.1))[0]
    lengths = [np.sum(np.linalg.norm(np.diff(way, axis=0), axis=1)) for way in (path, grid)]
    assert lengths[0] <= 1.05 * lengths[1]


@pytest.mark.parametrize("seed", range(10))
def test_two_that_meet_choose_the_same_side(seed):
    rng = np.random.default_rng(seed)
    times = np.linspace(0.0, 6.0, 25)[:, None]
    velocity = rng.uniform(0.1, 0.3) * np.array([1.0, 0.0])
    first = np.array([-3.0, 0.0]) * velocity[0] + times * velocity
    second = np.array([3.0, 0.0]) * velocity[0] + [0.0, rng.uniform(-0.4, 0.4)] - times * velocity
    required, meets = np.full((25, 1), 0.7), np.ones((25, 1), bool)
    aside = [
        pass_aside(own, other[:, None], required, meets, 0.2)
        for own, other in ((first, second), (second, first))
    ]
    sides = np.sign([(aside[0] - second)[12, 1], (first - aside[1])[12, 1]])
    assert sides[0] == sides[1]
    expected = 1.0 if second[0, 1] < -0.2 else -1.0  # y grows to the left of the first
    assert sides[0] == expected
    assert abs((aside[0] - second)[12, 1]) >= 0.7 - 1e-9


# The map.


def test_obstacles_are_remembered_and_sorted():
    known = LocalMap()
    far, near = np.array([[2.0, 1.0, 0.5]]), np.array([[-1.0, 0.0, 0.5]])
    assert known.notice_obstacles(far)
    assert not known.notice_obstacles(far + np.array([1e-6, 0.0, 0.0]))
    assert known.notice_obstacles(near)
    assert not known.notice_obstacles(np.zeros((0, 3)))
    assert known.obstacles == pytest.approx(np.vstack([near, far]))


def test_velocities_of_neighbours_lose_their_noise_and_keep_their_mean():
    rng = np.random.default_rng(0)
    known, truth = LocalMap(), np.array([0.2, -0.1])
    found = []
    for step in range(600):
        noise = rng.normal(0.0, [0.05, 0.05, 0.2, 0.2])
        row = np.concatenate([[1.0, 1.0] + 0.1 * step * truth, truth]) + noise
        assert known.notice_neighbours(row[None], 0.1, 1.0) == (step == 0)
        found.append(known.neighbours[0])
    late = np.array(found[100:])
    assert late[:, 2:].mean(axis=0) == pytest.approx(truth, abs=0.01)
    assert late[:, 2:].std(axis=0).max() < 0.1
    known.notice_neighbours(np.zeros((0, 4)), 0.1, 1.0)
    assert known.neighbours.shape == (0, 4)
