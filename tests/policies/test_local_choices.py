"""What the planner of one agent chooses: ways, sides, distances and how long it looks ahead."""

import math

import numpy as np
import pytest

from lagros_policies.planning.local.guess import progress
from lagros_policies.planning.local.map import LocalMap
from lagros_policies.planning.local.motion import Discs, required_distances
from lagros_policies.planning.local.plan import LocalPlanner
from lagros_policies.planning.local.problem import LocalPlannerSettings, LocalProblem

HERE = np.zeros(2)
START = np.array([3.0, 0.0, 0.0, 0.0])


def discs(centres, velocities=None, touching=0.75, margin=0.15, moving=None):
    """Return discs that rest unless velocities are given."""
    centres = np.atleast_2d(np.asarray(centres, float))
    count = len(centres)
    velocities = np.zeros((count, 2)) if velocities is None else np.atleast_2d(velocities)
    moving = np.any(velocities != 0.0, axis=1) if moving is None else np.full(count, moving)
    return Discs(centres, velocities, np.full(count, touching), np.full(count, margin), moving)


@pytest.fixture
def looks(monkeypatch):
    """How often the planner has looked for other ways."""
    seen = []
    sound = LocalProblem.ways

    def ways(self):
        seen.append(True)
        return sound(self)

    monkeypatch.setattr(LocalProblem, "ways", ways)
    return seen


def test_who_is_faster_than_the_limit_slows_down_as_least_effort_would():
    speed, left, way = 0.9, 20.0, 6.0
    plan = LocalPlanner().plan(np.array([way, 0.0, -speed, 0.0]), HERE, Discs.none(), left)
    assert plan.solved
    # The energy of the cubic that is at rest at the goal in time.
    effort = 6 * way**2 / left**3 - 6 * way * speed / left**2 + 2 * speed**2 / left
    assert effort <= plan.cost <= 1.03 * effort


def test_a_far_goal_gets_the_time_that_the_speed_limit_needs():
    plan = LocalPlanner().plan(np.array([10.0, 0.0, 0.0, 0.0]), HERE, Discs.none(), 5.0)
    assert plan.solved
    assert plan.duration == pytest.approx(2.0 * 10.0 / 0.7)
    assert np.max(np.abs(plan.at(plan.edges)[1])) <= 0.7 + 1e-4
    # A near one gets the least duration.
    near = LocalPlanner().plan(np.array([1.0, 0.0, 0.0, 0.0]), HERE, Discs.none(), 5.0)
    assert near.duration == LocalPlannerSettings().least_duration


def test_where_not_all_distances_fit_the_tightest_are_kept():
    # A post in the middle of a lane whose sides are within reach all the way.
    lane = [[x, side] for x in np.arange(0.3, 2.8, 0.25) for side in (0.68, -0.68)]
    around = discs([[1.5, 0.02], *lane], touching=np.array([0.15] + [0.2] * len(lane)), margin=0.1)
    few = LocalPlanner(LocalPlannerSettings(most_distances=12))
    plan = few.plan(START, HERE, around, 20.0)
    assert plan.solved
    assert plan.short <= 0.01
    places, _ = plan.at(np.arange(0.0, 20.0, 0.05))
    assert np.linalg.norm(places - around.centres[0], axis=-1).min() >= 0.25 - 2e-3


def test_a_plan_that_became_dearer_is_held_against_other_ways(looks):
    planner = LocalPlanner()
    free = planner.plan(START, HERE, Discs.none(), 20.0)
    looks.clear()
    same = planner.plan(START, HERE, Discs.none(), 20.0, free, fresh=False)
    assert same.cost == pytest.approx(free.cost, abs=1e-3)
    assert not looks
    detour = planner.plan(START, HERE, discs([[1.5, 0.3]]), 20.0, free, fresh=False)
    assert detour.short <= 0.01
    assert detour.cost > free.cost + 5e-3
    assert looks


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_side_is_not_changed_for_a_small_gain(side):
    planner = LocalPlanner()

    def height(plan):
        return plan.at(np.array([0.5 * plan.duration]))[0][0, 1]

    before = planner.plan(START, HERE, discs([[1.5, -0.05 * side]]), 20.0)
    assert side * height(before) > 0.5
    # The obstacle is seen a little beyond the straight line now: the other side is shorter.
    moved = discs([[1.5, 0.02 * side]])
    anew = planner.plan(START, HERE, moved, 20.0)
    assert side * height(anew) < -0.5
    kept = planner.plan(START, HERE, moved, 20.0, before)
    assert side * height(kept) > 0.5
    assert 0.8 * kept.cost < anew.cost < kept.cost


def test_the_check_of_a_plan_looks_beyond_its_end():
    plan = LocalPlanner().plan(START, HERE, Discs.none(), 12.0)
    # Half a second before the end somebody comes who will stand at the goal in three.
    comes = discs([[0.0, 1.5]], [[0.0, -0.5]], touching=0.5)
    short = LocalPlanner().shortfall(plan, 11.5, HERE, comes, 0.5)
    assert short == pytest.approx(0.5 + 0.15 + 0.01, abs=0.1)


@pytest.mark.parametrize(("left", "asked"), [(5.0, 0.5 + 0.3 + 0.01), (-1.0, 0.5 + 0.02)])
def test_who_is_late_may_end_beside_one_that_covers_its_goal(left, asked):
    covers = discs([[0.0, 0.0]], touching=0.5, margin=0.3, moving=True)
    times = np.linspace(0.0, 8.0, 9)
    found = required_distances(covers, times, np.array([3.0, 0.0]), HERE, left, 0.05)
    assert found[:, 0] == pytest.approx(np.full(9, asked))


def test_the_filter_of_a_neighbour_is_critically_damped():
    period, smoothing = 0.1, 0.7
    place, speed = np.array([1.0, -2.0]), np.array([0.3, 0.1])
    known, errors = LocalMap(), []
    for step in range(12):
        true = place + period * step * speed
        # Its velocity is taken from the first look, where it is said to rest.
        known.notice_neighbours(np.array([[*true, 0.0, 0.0]]), period, smoothing)
        errors.append(known.neighbours[0] - np.concatenate([true, speed]))
    errors, root = np.array(errors), math.exp(-period / smoothing)
    assert np.abs(errors[3]).max() > 1e-3
    # Both roots of the recurrence of the error are exp(-period / smoothing).
    expected = 2.0 * root * errors[1:-1] - root**2 * errors[:-2]
    assert errors[2:] == pytest.approx(expected, abs=1e-12)


def test_a_guess_never_overshoots_however_fast_it_begins():
    times = np.linspace(0.0, 10.0, 101)
    for speed in (-1.0, 0.0, 0.1, 1.0, 50.0):
        share = progress(times, 2.0, speed)
        assert share[0] == 0.0
        assert share[-1] == pytest.approx(1.0)
        assert np.all(np.diff(share) >= -1e-12)
