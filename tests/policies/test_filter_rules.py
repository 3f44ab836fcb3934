"""Rules of the safety filter one by one: limits, what is sensed, who stays, which radius counts."""

import dataclasses

import numpy as np
import pytest

from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Scenario
from lagros_envs.tasks.spacecraft.sensing import Layout, global_state, observe
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.thrusters import allocate

REST = np.zeros((1, 8), np.float32)


class Idle:
    """Never fires a thruster."""

    name = "idle"

    def __init__(self, observes="local"):
        self.observes = observes

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return REST, state


def row(layout, goal, neighbours=(), obstacles=(), velocity=(0.0, 0.0)):
    """Return what an agent with the heading zero senses."""
    values, at = np.zeros(layout.size, np.float32), layout.slices
    values[at["goal"]], values[at["velocity"]], values[at["heading"]] = goal, velocity, (1, 0, 0)
    for name, parts in (("neighbour", neighbours), ("obstacle", obstacles)):
        flat = np.ravel(np.asarray(parts, np.float32))
        values[at[name + "s"]][: flat.size] = flat
        values[at[name + "_mask"]][: len(parts)] = 1.0
    return values[None]


def force(settings, action):
    """Return the force [N] of an action at the heading zero, in the axes of the world."""
    first, second, _ = settings.system.wrench(list(settings.thrust_scale * action[0]))
    return np.array([first, second])


@pytest.mark.parametrize(("limit", "mass", "braking"), [(0.3, 1.0, 0.3), (0.3, 2.0, 0.15)])
def test_half_of_the_thrust_on_an_axis_is_what_braking_counts_on(limit, mass, braking):
    task = SpacecraftSettings(thrust_limit=limit)
    task = dataclasses.replace(task, system=dataclasses.replace(task.system, mass=mass))
    wearing = SafetyFilter(Idle(), task)
    assert wearing.barrier.settings.braking == pytest.approx(braking)
    # Two thrusters push along an axis.
    assert 2.0 * limit / mass == pytest.approx(2.0 * braking)
    unlimited = SafetyFilter(Idle(), dataclasses.replace(task, thrust_limit=None))
    assert unlimited.barrier.settings.braking == 1.0


def test_an_obstacle_is_sensed_by_its_rim_in_the_global_state_too():
    # Its centre lies beyond the sensing radius of 2 m and its rim within.
    world = Scenario([[0.0, 0.0]], [0.0], [[4.0, 0.0]], [[2.3, 0.0]], [0.5])
    env = SpacecraftVectorEnv(1, 1, compiled=False, autoreset_mode="disabled")
    env.reset(seed=0, options={"scenarios": [world]})
    env.world.parts[3] = 1.85  # too fast to brake at 1 m/s^2
    rows = observe(env.world, env.layout)[0]
    assert rows[0, env.layout.slices["obstacle_mask"]].sum() == 1.0
    answers = [
        SafetyFilter(Idle(observes), num_agents=1).predict(observation)
        for observes, observation in (("local", rows), ("global", global_state(env.world)))
    ]
    (local, memory), (world_wide, _) = answers
    assert memory.counts.tolist() == [[1, 1, 0]]
    assert world_wide == pytest.approx(local, abs=1e-6)


@pytest.mark.parametrize(("distance", "steps_aside"), [(0.5, True), (0.15, False)])
def test_who_has_arrived_is_not_led_around_what_it_must_not_touch(distance, steps_aside):
    wearing = SafetyFilter(Idle(), preset="open", num_agents=2)
    assert steps_aside is (distance > wearing.settings.goal_radius)
    # Just clear of a neighbour that stands behind the goal, and inside the margin.
    observation = row(wearing.layout, (distance, 0.0), [(0.55, 0.0, 0.0, 0.0)])
    action, memory = wearing.predict(observation)
    assert memory.counts.tolist() == [[1, 1, 0]]
    back, aside = force(wearing.settings, action)
    assert back < 0.0
    assert bool(abs(aside) > 0.1) is steps_aside


def test_against_obstacles_the_radius_of_the_core_counts():
    # In this preset an agent is half a metre wide to others and a point to obstacles.
    assert (PRESETS["released"].agent_radius, PRESETS["released"].core_radius) == (0.5, 0.0)
    wearing = SafetyFilter(Idle(), preset="released", num_agents=2)
    layout = Layout.for_preset(wearing.preset, wearing.settings)
    beside = row(layout, (0.0, 3.0), obstacles=[(0.8, 0.0, 0.5)])
    _, memory = wearing.predict(beside)
    assert memory.counts.tolist() == [[1, 0, 0]]
    too_near = row(layout, (0.0, 3.0), obstacles=[(0.53, 0.0, 0.5)])
    _, memory = wearing.predict(too_near)
    assert memory.counts.tolist() == [[1, 1, 0]]


@pytest.mark.parametrize("share", [-1.9, -1.0, 0.5, 1.5])
def test_with_a_limit_the_force_leaves_room_for_the_torque(share):
    limit = 0.3
    task = SpacecraftSettings(thrust_limit=limit)
    # A torque as large as this takes a quarter of it from a thruster of each axis.
    torque = share * limit
    wanted = allocate(task.system, np.array([[0.0, 0.0, torque]])).astype(np.float32)
    wearing = SafetyFilter(Idle(), task, "open", 2)
    observation = row(wearing.layout, (3.0, 0.0), [(0.6, 0.0, -0.5, 0.0)], velocity=(0.5, 0.0))
    sensed = Sensed.of(wearing.layout, observation)
    action, changed, _ = wearing.filter(wanted, sensed)
    assert changed.all()
    back, _, kept = task.system.wrench(list(action[0].astype(float)))
    assert kept == pytest.approx(torque, abs=1e-6)
    assert back == pytest.approx(-2.0 * (limit - 0.25 * abs(torque)), abs=0.02)
