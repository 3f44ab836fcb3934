"""What joint plans owe to mass, arrivals, growing margins and late starts."""

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.scenarios import Scenario
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.planning.joint.plan import swept_distances
from lagros_policies.planning.joint.planner import (
    JointPlanner,
    JointPlannerSettings,
)
from lagros_policies.planning.joint.problem import JointScpSettings
from lagros_policies.planning.joint.scp import JointSolution
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy
from lagros_policies.tasks.spacecraft.expert import (
    SEARCH_RADIUS,
    SpacecraftExpert,
    SpacecraftExpertSettings,
)
from lagros_policies.tasks.spacecraft.pace import time_to_go

NONE = np.empty((0, 2))
OBSTACLE, AGENT = 0.5, 0.25
TASK = SpacecraftSettings()


@pytest.mark.parametrize("mass", [0.3, 3.0])
def test_the_way_between_coarse_nodes_is_that_of_the_mass(mass):
    starts, goals = np.array([[0.0, 0.05], [3.0, 1.6]]), np.array([[3.0, 0.0], [0.0, 1.6]])
    obstacle = np.array([[1.5, 0.0]])

    def planned(mass):
        settings = JointPlannerSettings(
            horizon=7.0,
            nodes=7,
            margins=(0.2,),
            restarts=0,
            searches=0,
            mass=mass,
            # The effort goes with the square of the mass, and so must its price.
            scp=JointScpSettings(penalty=mass**2),
        )
        return JointPlanner(settings).plan(starts, goals, obstacle, OBSTACLE, AGENT)

    # The same motion as that of one kilogram, by forces in proportion.
    plan, reference = planned(mass), planned(1.0)
    assert plan.solved, plan.status
    assert plan.states == pytest.approx(reference.states, abs=0.01)
    assert plan.forces == pytest.approx(mass * reference.forces, abs=0.02 * mass)
    motion, _ = plan.resample(0.1)
    gaps, _ = swept_distances(motion[..., :2], obstacle)
    assert gaps.min() >= OBSTACLE + AGENT + 0.2 - 5e-3


def test_a_margin_that_grows_fast_is_kept_as_it_is_between_instants():
    settings = JointPlannerSettings(
        margin_growth=0.6, margins=(0.5,), restarts=0, searches=0, horizon=20.0, nodes=40
    )
    starts, goals = np.array([[0.0, 0.0]]), np.array([[3.0, 0.1]])
    # The start has 1 cm of room beside the obstacle.
    obstacle = np.array([[0.0, -(OBSTACLE + AGENT + 0.01)]])
    plan = JointPlanner(settings).plan(starts, goals, obstacle, OBSTACLE, AGENT)
    assert plan.solved, plan.status
    assert plan.margin == 0.5


def test_beside_one_that_has_arrived_the_margin_lasts_until_the_other_arrives():
    settings = JointPlannerSettings(margins=(0.3,), restarts=1, searches=1)
    # Their goals are 0.6 m apart, so that the margin has to shrink there; the second one comes
    # along a line that is as near to the first one's goal for longer than that.
    starts, goals = np.array([[-1.5, 0.0], [3.0, 0.6]]), np.array([[0.0, 0.0], [0.0, 0.6]])
    arrivals = np.array([10.0, 30.0])
    plan = JointPlanner(settings).plan(starts, goals, NONE, OBSTACLE, AGENT, duration=arrivals)
    assert plan.solved, plan.status
    motion, _ = plan.resample(0.1)
    apart = np.linalg.norm(motion[0, :, :2] - motion[1, :, :2], axis=-1)
    remaining = arrivals[1] - 0.1 * np.arange(len(apart))
    full = 2.0 * AGENT + 0.3
    allowed = np.minimum(full, 0.6 + 0.5 * settings.margin_growth * remaining**2)
    assert np.all(apart >= allowed - 5e-3)
    # On the straight line it would have been too near too early.
    share = np.linspace(0.0, 1.0, 301)
    straight = np.hypot(3.0 * (1.0 - share * share * (3.0 - 2.0 * share)), 0.6)
    assert np.any(straight < allowed - 0.02)


@pytest.mark.parametrize(("time", "planned"), [(44.0, True), (44.1, False)])
def test_two_node_steps_are_enough_for_a_plan(time, planned):
    env = spacecraft_v0.parallel_env(2, "open")
    policy = CentralizedPolicy(preset="open", num_agents=2)
    env.reset(seed=0)
    state = env.state()
    state[0] = time
    _, memory = policy.predict(state)
    assert (memory[0].plan is not None) is planned


def test_a_start_nearer_to_an_obstacle_than_the_agents_keep_from_each_other():
    # Agents of half a metre that are points to obstacles.
    place = Scenario(
        [[0.0, 0.0], [0.0, 3.0]],
        [0.0, 0.0],
        [[5.5, 0.0], [5.5, 3.0]],
        [[-0.8, 0.0]],
        [0.5],
        0.5,
        0.0,
    )
    env = spacecraft_v0.parallel_env(2, "released")
    env.reset(seed=0, options={"scenario": place})
    _, memory = CentralizedPolicy(preset="released", num_agents=2).predict(env.state())
    assert memory[0].solved, memory[0].plan.status
    # Half a metre from the centre is touching, so that 0.3 m are free.
    assert memory[0].plan.clearance == pytest.approx(0.3, abs=0.01)


def test_who_is_late_gets_whole_node_steps_rounded_up_and_then_rests():
    goal = np.array([[2.2, 0.0]])
    place = Scenario([[0.0, 0.0]], [0.3], goal, [], [])
    expert = SpacecraftExpert([place], SpacecraftExpertSettings(), TASK)
    states = np.array([[0.0, 0.0, 0.3, 0.0, 0.0, 0.0]])
    step = 310  # a second after the horizon
    needed = time_to_go(np.array([2.2]), -1.0)[0]
    assert needed == pytest.approx(2.2 / 0.3)
    assert expert.plan(0, step, states)
    end = step + 10 * int(np.ceil(needed))
    pushes, nominal = expert.pushes[0, :, 0], expert.nominal[0, :, 0]
    assert np.linalg.norm(pushes[end - 5]) > 1e-3
    assert np.all(pushes[end:] == 0.0)
    assert nominal[end:, :2] == pytest.approx(
        np.broadcast_to(goal, (len(nominal) - end, 2)), abs=1e-5
    )
    assert np.all(nominal[end + 1 :, 3:] == 0.0)


def test_whoever_strayed_too_far_keeps_the_last_plan():
    place = Scenario([[0.0, 0.0]], [0.0], [[2.2, 0.0]], [], [])
    expert = SpacecraftExpert([place], SpacecraftExpertSettings(), TASK)
    assert expert.plan(0, 0, np.zeros((1, 6)))
    nominal = expert.nominal.copy()
    states = np.zeros((1, 6))
    states[0, 0] = 2.2 - 1.01 * SEARCH_RADIUS
    assert not expert.plan(0, 100, states)
    assert (expert.plans, expert.failed_plans) == (2, 1)
    np.testing.assert_array_equal(expert.nominal, nominal)


def test_of_several_plans_the_one_of_least_effort_is_taken(monkeypatch):
    found = []
    sound = JointPlanner._checked

    def checked(self, *arguments):
        plan = sound(self, *arguments)
        if plan.solved:
            found.append(plan.effort.sum())
        return plan

    monkeypatch.setattr(JointPlanner, "_checked", checked)
    settings = JointPlannerSettings(candidates=4, restarts=2, searches=2)
    starts, goals = np.array([[0.0, 2.0], [4.0, 2.0]]), np.array([[4.0, 2.2], [0.0, 1.8]])
    plan = JointPlanner(settings).plan(starts, goals, np.array([[2.0, 2.0]]), OBSTACLE, AGENT)
    assert len(found) == 4
    assert max(found) > min(found)
    assert plan.effort.sum() == min(found)


def test_where_no_plan_is_found_the_one_that_violates_least_is_shown(monkeypatch):
    violations = iter([0.5, 0.1, 0.3, 0.2, 0.4])

    def solve(problem, guess, settings):
        violation = next(violations)
        states = np.repeat(problem.starts[:, None], problem.nodes + 1, axis=1)
        forces = np.zeros((len(states), problem.nodes, 2))
        return JointSolution(states, forces, False, f"short by {violation}", violation, 1)

    monkeypatch.setattr("lagros_policies.planning.joint.planner.solve_joint", solve)
    settings = JointPlannerSettings(margins=(0.3,), restarts=2, searches=2)
    starts, goals = np.array([[0.0, 0.0]]), np.array([[3.0, 0.0]])
    plan = JointPlanner(settings).plan(starts, goals, NONE, OBSTACLE, AGENT)
    assert not plan.solved
    assert "short by 0.1" in plan.status
    assert (plan.attempts, plan.iterations) == (5, 5)
