"""What an agent senses: exactly the disc, in named parts, in no particular order."""

import math

import numpy as np
import pytest
from gymnasium import spaces

from lagros_envs.disturbances import Disturbance
from lagros_envs.seeding import episode_streams
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Scenario
from lagros_envs.tasks.spacecraft.sensing import Layout, global_state, named_state_space, observe
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.world import SpacecraftWorld


def world_of(*scenarios, obstacles=6, steps=0, **settings):
    world = SpacecraftWorld(
        len(scenarios),
        scenarios[0].num_agents,
        obstacles,
        Disturbance("uniform", 0.4, (True,) * 6),
        SpacecraftSettings(**settings),
    )
    streams = [episode_streams(k).disturbance for k in range(len(scenarios))]
    world.begin(np.arange(len(scenarios)), scenarios, streams)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        world.step(rng.uniform(0.0, 1.0, (world.worlds, world.agents, 8)))
    return world


def layout_of(world):
    """A slot for everybody."""
    time_limit = world.settings.time_limit
    return Layout(max(1, world.agents - 1), max(1, world.obstacles), time_limit)


def named(world):
    """Observations by world, agent and name."""
    layout = layout_of(world)
    rows = observe(world, layout)
    assert rows.dtype == np.float32
    assert rows.shape == (world.worlds, world.agents, layout.size)
    return [[spaces.unflatten(layout.named_space, row) for row in agents] for agents in rows]


def paper(seed, agents=None):
    return PRESETS["paper"].sample(episode_streams(seed).scenario, agents)


@pytest.mark.parametrize("steps", [0, 37])
@pytest.mark.parametrize("agents", [1, 2, 6])
def test_observations_see_exactly_the_sensing_disc(agents, steps):
    """Every part, recomputed agent by agent in plain Python."""
    scenarios = [paper(seed, agents) for seed in range(20)]
    world = world_of(*scenarios, steps=steps)
    seen = {"neighbours": set(), "obstacles": set()}
    for index, (scenario, rows) in enumerate(zip(scenarios, named(world), strict=True)):
        states = world.states[index]
        for agent, parts in enumerate(rows):
            x, y, heading, *velocity, spin = states[agent]
            here, velocity = np.array([x, y]), np.array(velocity)
            same(parts["goal"], scenario.goals[agent] - here)
            same(parts["velocity"], velocity)
            turned = heading - scenario.headings[agent]
            same(parts["heading"], [math.cos(heading), math.sin(heading), turned])
            same(parts["spin"], [spin])
            same(parts["time"], [0.1 * steps])
            others = [k for k in range(agents) if k != agent]
            for slot in range(max(1, agents - 1)):
                values, flag = np.zeros(4), 0.0
                if slot < len(others):
                    other = states[others[slot]]
                    offset = np.concatenate([other[:2] - here, other[3:5] - velocity])
                    flag = float(np.hypot(*offset[:2]) <= 2.0)
                    values = flag * offset
                    seen["neighbours"].add(flag)
                same(parts["neighbours"][slot], values)
                assert parts["neighbour_mask"][slot] == flag
            for slot in range(6):
                values, flag = np.zeros(3), 0.0
                if slot < len(scenario.obstacles):
                    offset = scenario.obstacles[slot] - here
                    flag = float(np.hypot(*offset) - 0.5 <= 2.0)
                    values = flag * np.array([*offset, 0.5])
                    seen["obstacles"].add(flag)
                same(parts["obstacles"][slot], values)
                assert parts["obstacle_mask"][slot] == flag
    assert seen["obstacles"] == {0.0, 1.0}
    assert seen["neighbours"] == ({0.0, 1.0} if agents > 1 else set())


def same(actual, expected):
    np.testing.assert_allclose(actual, np.asarray(expected), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("gap", "sensed"), [(-1e-9, 1.0), (0.0, 1.0), (1e-9, 0.0)])
def test_the_edge_of_the_disc_is_sharp_and_belongs_to_it(gap, sensed):
    """In double precision: 2 m, and 2.5 m to the centre of an obstacle of 0.5 m."""
    scenario = Scenario(
        [[0.0, 0.0], [0.0, 2.0 + gap]],
        [0.0, 0.0],
        [[1.0, 0.0], [1.0, 1.0]],
        [[2.5 + gap, 0.0]],
        [0.5],
    )
    parts = named(world_of(scenario))[0][0]
    assert parts["neighbour_mask"][0] == sensed
    assert parts["obstacle_mask"][0] == sensed
    assert parts["obstacle_mask"].sum() == sensed


def test_nothing_beyond_the_disc_changes_what_is_seen():
    starts = np.array([[0.0, 0.0], [1.0, 0.0], [8.0, 8.0]])
    goals = starts + 3.0
    seen = []
    for far in ([8.0, 7.0], [20.0, -3.0]):
        starts[2] = far
        obstacles = [[0.0, 2.0], [far[1], far[0]]]
        world = world_of(Scenario(starts, np.zeros(3), goals, obstacles, [0.5, 0.4]))
        seen.append(observe(world, layout_of(world))[0, 0])
    np.testing.assert_array_equal(*seen)
    assert np.count_nonzero(seen[0]) == 8  # goal, cos phi, and one of each kind with its mask


def test_a_sensing_radius_of_zero_sees_nobody():
    parts = named(world_of(paper(0), sensing_radius=0.0))[0][0]
    assert not parts["neighbour_mask"].any()
    assert not parts["obstacles"].any()


def test_renumbering_agents_and_obstacles_permutes_the_slots():
    scenario = paper(1)
    order = np.random.default_rng(2).permutation(6)
    turn = np.random.default_rng(3).permutation(len(scenario.obstacles))
    swapped = Scenario(
        scenario.starts[order],
        scenario.headings[order],
        scenario.goals[order],
        scenario.obstacles[turn],
        scenario.obstacle_radii[turn],
    )
    first, second = named(world_of(scenario))[0], named(world_of(swapped))[0]
    for position, agent in enumerate(order):
        ours, theirs = first[agent], second[position]
        for name in ("goal", "velocity", "heading", "spin", "time"):
            np.testing.assert_array_equal(ours[name], theirs[name])
        for name, mask in (("neighbours", "neighbour_mask"), ("obstacles", "obstacle_mask")):
            rows = [
                sorted(map(tuple, np.column_stack([parts[name], parts[mask]]).tolist()))
                for parts in (ours, theirs)
            ]
            assert rows[0] == rows[1]


def test_flattening_the_named_parts_gives_the_observation_back():
    world = world_of(paper(0), steps=3)
    layout = layout_of(world)
    for row in observe(world, layout)[0]:
        parts = spaces.unflatten(layout.named_space, row)
        assert list(parts) == list(layout.shapes)
        np.testing.assert_array_equal(spaces.flatten(layout.named_space, parts), row)
        assert spaces.flatten_space(layout.named_space).contains(row)
        for name, part in layout.slices.items():
            np.testing.assert_array_equal(row[part], parts[name].ravel())


def test_a_caller_who_goes_on_past_the_limit_stays_in_the_space():
    world = world_of(paper(0), steps=5, time_limit=0.3)
    layout = layout_of(world)
    space = spaces.flatten_space(layout.named_space)
    assert all(space.contains(row) for row in observe(world, layout)[0])
    space = spaces.flatten_space(named_state_space(6, 6, 0.3))
    assert space.contains(global_state(world)[0])


def test_the_global_state_names_everything():
    scenarios = [paper(0), paper(4)]
    world = world_of(*scenarios, steps=5)
    space = named_state_space(6, 6, 45.0)
    rows = global_state(world)
    for index, (row, scenario) in enumerate(zip(rows, scenarios, strict=True)):
        assert spaces.flatten_space(space).contains(row)
        parts = spaces.unflatten(space, row)
        assert parts["time"][0] == np.float32(0.5)
        same(parts["states"], world.states[index])
        same(parts["goals"], scenario.goals)
        count = len(scenario.obstacles)
        same(parts["obstacles"][:count, :2], scenario.obstacles)
        same(parts["obstacles"][:count, 2], scenario.obstacle_radii)
        assert not parts["obstacles"][count:].any()
        np.testing.assert_array_equal(parts["obstacle_mask"], np.arange(6) < count)
