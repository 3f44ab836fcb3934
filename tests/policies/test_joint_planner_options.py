"""Joint plans with arrivals of their own and plans that begin in a tube around the states."""

import numpy as np
import pytest

from lagros_policies.contraction.double_integrator import design_axis
from lagros_policies.planning.joint.plan import swept_distances
from lagros_policies.planning.joint.planner import (
    JointPlanner,
    JointPlannerSettings,
)

NONE = np.empty((0, 2))
STARTS = np.array([[0.0, 0.0], [0.0, 2.0], [4.0, 4.0]])
GOALS = np.array([[3.0, 0.0], [3.0, 2.0], [1.0, 4.0]])


def test_who_arrives_early_rests_at_its_goal_without_force():
    planner = JointPlanner()
    plan = planner.plan(STARTS, GOALS, NONE, 0.5, 0.25, duration=np.array([10.0, 20.0, 15.3]))
    assert plan.solved
    assert plan.states.shape == (3, 41, 4)
    for agent, node in enumerate((20, 40, 30)):  # 15.3 s is cut to whole node steps of 0.5 s
        np.testing.assert_allclose(plan.states[agent, node:, :2] - GOALS[agent], 0.0, atol=1e-6)
        np.testing.assert_allclose(plan.states[agent, node:, 2:], 0.0, atol=1e-6)
        assert np.all(plan.forces[agent, node:] == pytest.approx(0.0, abs=1e-6))
        assert np.linalg.norm(plan.states[agent, node - 4, :2] - GOALS[agent]) > 1e-3
    # Least effort of rest to rest over a time: 6 d^2 / T^3 for half the integral of F^2.
    way = np.linalg.norm(GOALS - STARTS, axis=1)
    expected = 6.0 * way**2 / np.array([10.0, 20.0, 15.0]) ** 3
    np.testing.assert_allclose(plan.effort, expected, rtol=5e-3)


def test_one_arrival_for_all_is_the_plain_duration():
    planner = JointPlanner()
    one = planner.plan(STARTS, GOALS, NONE, 0.5, 0.25, duration=12.0)
    many = planner.plan(STARTS, GOALS, NONE, 0.5, 0.25, duration=np.full(3, 12.0))
    np.testing.assert_array_equal(one.states, many.states)


def test_the_begin_of_a_free_plan_is_the_optimum_of_a_quadratic():
    # Without obstacles the effort of a plan from (p, v) to rest at 0 in T is y'Py/2 per axis.
    horizon = 10.0
    cost = 0.3 * design_axis(2.0, 0.1).matrix
    go = np.array([[12.0 / horizon**3, 6.0 / horizon**2], [6.0 / horizon**2, 4.0 / horizon]])
    state = np.array([[-2.0, 1.0, 0.4, -0.3]])
    settings = JointPlannerSettings(horizon=horizon, nodes=100, margins=(0.3,))
    plan = JointPlanner(settings).plan(state, np.zeros((1, 2)), NONE, 0.5, 0.25, start_cost=cost)
    for axis in range(2):
        begin = np.linalg.solve(go + cost, cost @ state[0, [axis, axis + 2]])
        np.testing.assert_allclose(plan.states[0, 0, [axis, axis + 2]], begin, atol=2e-3)


def test_a_plan_from_a_lost_margin_begins_clear_and_recovers_it():
    obstacle = np.array([[2.0, 0.02]])
    states = np.array([[1.28, 0.0, 0.1, 0.0], [3.0, 3.0, 0.0, 0.0]])  # overlaps by 0.03 m
    goals = np.array([[4.0, 0.0], [1.0, 3.0]])
    settings = JointPlannerSettings(margins=(0.3,), margin_growth=0.05)
    planner = JointPlanner(settings)
    assert not planner.plan(states, goals, obstacle, 0.5, 0.25).solved
    cost = design_axis(2.0, 0.1).matrix
    plan = planner.plan(states, goals, obstacle, 0.5, 0.25, start_cost=cost)
    assert plan.solved
    gaps, _ = swept_distances(plan.resample(0.1)[0][..., :2], obstacle)
    room = gaps[:, 0, 0] - 0.75
    assert room[0] >= settings.start_margin - 1e-3
    assert room[0] < 0.2
    assert room[60:].min() >= 0.3 - 1e-3
    # The other agent has little reason to begin elsewhere.
    np.testing.assert_allclose(plan.states[1, 0, :2], states[1, :2], atol=0.03)


def test_too_early_an_arrival_is_refused():
    with pytest.raises(ValueError, match="two node steps"):
        JointPlanner().plan(STARTS, GOALS, NONE, 0.5, 0.25, duration=np.array([10.0, 0.9, 9.0]))
