"""Plans that agents improve by turns, against all at once and true distances on a fine grid."""

import numpy as np
import pytest

from lagros_envs.tasks.spacecraft.scenarios import preset_named
from lagros_policies.planning.joint import planner as joint_planner
from lagros_policies.planning.joint.planner import JointPlanner, JointPlannerSettings
from lagros_policies.planning.joint.scp import JointSolution
from lagros_policies.planning.joint.turns import MOST_PASSES
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy


def drawn(seed, agents=6, preset="paper"):
    """Draw a world: starts, goals, centres and radii of obstacles."""
    chosen = preset_named(preset).for_agents(agents)
    world = chosen.sample(np.random.default_rng([5, seed]))
    return world.starts, world.goals, world.obstacles, world.obstacle_radii


def least_room(plan, obstacles, radii, agent_radius, core, samples=100):
    """Return the least room of a plan from its polynomials, by an own loop over a fine grid."""
    h, least = plan.node_period, np.inf
    for k in range(plan.forces.shape[1]):
        place, speed, force = plan.states[:, k, :2], plan.states[:, k, 2:], plan.forces[:, k]
        for t in np.arange(samples) * (h / samples):
            at = place + t * speed + 0.5 * t * t * force / plan.mass
            away = np.hypot(*(at[:, None] - at).transpose(2, 0, 1))
            np.fill_diagonal(away, np.inf)
            gap = np.hypot(*(at[:, None] - obstacles).transpose(2, 0, 1)) - radii
            least = min(least, away.min() - 2 * agent_radius, gap.min(initial=np.inf) - core)
    return least


@pytest.mark.parametrize("seed", range(4))
def test_by_turns_plans_keep_the_margin_and_cost_little_more(monkeypatch, seed):
    starts, goals, obstacles, radii = drawn(seed)
    planner = JointPlanner(JointPlannerSettings(margins=(0.12,)))
    whole = planner.plan(starts, goals, obstacles, radii, 0.25)
    monkeypatch.setattr(joint_planner, "ALL_AT_ONCE", 1)
    plan = planner.plan(starts, goals, obstacles, radii, 0.25)
    assert whole.solved
    assert plan.solved
    assert "turns" in plan.status
    assert "turns" not in whole.status
    assert plan.states[:, 0, :2] == pytest.approx(starts, abs=1e-5)
    assert plan.states[:, -1, :2] == pytest.approx(goals, abs=1e-5)
    assert np.max(np.abs(plan.states[..., 2:])) <= 0.7 + 1e-5
    assert least_room(plan, obstacles, radii, 0.25, 0.25, samples=50) >= 0.12 - 2e-3
    assert plan.effort.sum() <= 2.0 * whole.effort.sum()
    h, before, after = plan.node_period, plan.states[:, :-1], plan.states[:, 1:]
    place = before[..., :2] + h * before[..., 2:] + 0.5 * h * h * plan.forces
    assert after[..., :2] == pytest.approx(place, abs=1e-5)
    assert after[..., 2:] == pytest.approx(before[..., 2:] + h * plan.forces, abs=1e-5)


def test_turns_only_save_effort(monkeypatch):
    found, sound = [], joint_planner.solve_many

    def first(problem, guess, settings):
        monkeypatch.setattr("lagros_policies.planning.joint.turns._SWEEPS", 0)
        found.append(sound(problem, guess, settings))
        monkeypatch.setattr("lagros_policies.planning.joint.turns._SWEEPS", 10)
        found.append(sound(problem, guess, settings))
        return found[-1]

    monkeypatch.setattr(joint_planner, "ALL_AT_ONCE", 1)
    monkeypatch.setattr(joint_planner, "solve_many", first)
    starts, goals, obstacles, radii = drawn(7)
    JointPlanner().plan(starts, goals, obstacles, radii, 0.25)
    all_at_once, by_turns = found[:2]
    assert all_at_once.solved
    assert by_turns.violation <= 4e-3
    assert np.sum(by_turns.forces**2) < np.sum(all_at_once.forces**2)


def test_of_many_agents_there_are_no_more_passes_than_the_budget(monkeypatch):
    asked = []

    def short(problem, guess, settings):
        asked.append(settings.max_iterations)
        nodes, count = problem.nodes, min(5, settings.max_iterations)
        states = np.repeat(problem.starts[:, None], nodes + 1, axis=1)
        forces = np.zeros((len(states), nodes, 2))
        return JointSolution(states, forces, False, "short", 0.1, count)

    monkeypatch.setattr(joint_planner, "solve_many", short)
    places = 2.0 * np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 2)
    planner = JointPlanner(JointPlannerSettings(margins=(0.3, 0.2, 0.1)))
    plan = planner.plan(places, places + 0.5, np.empty((0, 2)), 0.5, 0.25)
    assert not plan.solved
    assert asked == [MOST_PASSES, MOST_PASSES - 5, MOST_PASSES - 10]
    assert plan.iterations == MOST_PASSES


@pytest.mark.slow
def test_a_swarm_of_64_is_planned_and_clear_between_the_nodes():
    policy = CentralizedPolicy(preset="swarm", num_agents=64)
    starts, goals, obstacles, radii = drawn(1, 64, "swarm")
    plan = policy.planner.plan(starts, goals, obstacles, radii, 0.25)
    assert plan.solved, plan.status
    assert least_room(plan, obstacles, radii, 0.25, 0.25, samples=150) >= plan.margin - 2e-3
