"""The batched world: collisions between instants, measures, and independence of its parts."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.disturbances import OPEN_LOOP, Disturbance
from lagros_envs.dynamics import control_matrix, hold_step
from lagros_envs.seeding import episode_streams
from lagros_envs.sweep import Path, closest_approach, swept_agents, swept_obstacles
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Scenario
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, applied_forces
from lagros_envs.tasks.spacecraft.world import SUBSTEPS, SpacecraftWorld

ALL = (True,) * 6
NONE = Disturbance("none", 0.0, ALL)


def scene(starts, goals=None, obstacles=(), **radii):
    starts = np.asarray(starts, float)
    goals = starts + 30.0 if goals is None else goals
    count = len(obstacles)
    return Scenario(starts, np.zeros(len(starts)), goals, obstacles, np.full(count, 0.5), **radii)


def begun(scenario, velocities=0.0, disturbance=NONE, seed=0, **settings):
    world = SpacecraftWorld(
        1,
        scenario.num_agents,
        max(1, len(scenario.obstacles)),
        disturbance,
        SpacecraftSettings(**settings),
    )
    world.begin(np.array([0]), [scenario], [episode_streams(seed).disturbance])
    world.parts[3:5, 0] = np.broadcast_to(velocities, (scenario.num_agents, 2)).T
    return world


def coast(world, steps=1):
    for _ in range(steps):
        outcome = world.step(np.zeros((world.worlds, world.agents, 8)))
    return outcome


@pytest.fixture
def fly():
    """Return forces u >= 0 that bring agents straight to their goals, whatever is in the way."""

    def forces(states, scenario):
        wanted = np.zeros_like(states)
        wanted[:, 3:5] = 0.5 * (scenario.goals - states[:, :2]) - 1.2 * states[:, 3:5]
        wanted[:, 5] = 0.5 * (scenario.headings - states[:, 2]) - states[:, 5]
        inverse = np.linalg.pinv(control_matrix(Spacecraft(), states))
        # Of each opposing pair one thruster does what the two would have done.
        return 2.0 * np.maximum(np.einsum("aij,aj->ai", inverse, wanted), 0.0)

    return forces


# Collisions.


@pytest.mark.parametrize("heading", np.linspace(0.0, 2.0 * math.pi, 7))
def test_two_agents_that_fly_through_each_other_collide(heading):
    """At 40 m/s they are 2 m apart at both control instants, and at both ends of each substep."""
    way = np.array([math.cos(heading), math.sin(heading)])
    world = begun(scene([-way, way]), 20.0 * np.array([way, -way]))
    outcome = coast(world)
    np.testing.assert_allclose(world.parts[:2, 0].T, [way, -way], atol=1e-12)
    assert world.collided.all()
    np.testing.assert_allclose(world.collision_time, 0.1)
    np.testing.assert_allclose(outcome.reward, [[-5.0 + delta for delta in approach(world)]])


def approach(world):
    scenario = world.scenarios[0]
    before = np.linalg.norm(scenario.starts - scenario.goals, axis=1)
    return before - world.goal_distance[0]


def test_an_agent_that_flies_through_an_obstacle_collides():
    scenario = scene([[-1.0, 0.1], [-1.0, 5.0]], obstacles=[[0.0, 0.0]])
    world = begun(scenario, [20.0, 0.0])
    coast(world)
    np.testing.assert_array_equal(world.collided, [[True, False]])


@pytest.mark.parametrize(("gap", "hit"), [(-1e-6, True), (1e-6, False)])
def test_a_straight_pass_is_judged_to_the_micrometre(gap, hit):
    pair = begun(scene([[-1.0, 0.0], [1.0, 0.5 + gap]]), [[20.0, 0.0], [-20.0, 0.0]])
    coast(pair)
    assert pair.collided.tolist() == [[hit, hit]]
    stone = begun(scene([[-1.0, 0.75 + gap]], obstacles=[[0.0, 0.0]]), [20.0, 0.0])
    coast(stone)
    assert stone.collided.tolist() == [[hit]]


def test_crossing_the_same_place_at_different_times_is_no_collision():
    starts, velocities = [[-1.0, 0.0], [0.0, -2.2]], [[20.0, 0.0], [0.0, 20.0]]
    late = begun(scene(starts), velocities)
    coast(late)
    assert not late.collided.any()
    starts[1] = [0.0, -1.0]
    together = begun(scene(starts), velocities)
    coast(together)
    assert together.collided.all()


def test_three_agents_and_only_the_two_that_meet():
    world = begun(
        scene([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]), [[10.0, 0.0], [-10.0, 0.0], [0.0, 0.0]]
    )
    coast(world)
    assert world.collided.tolist() == [[True, True, False]]


def test_the_core_radius_is_for_obstacles_alone():
    scenario = scene([[-1.0, 0.3]], obstacles=[[0.0, 0.0]], agent_radius=0.5, core_radius=0.0)
    world = begun(scenario, [20.0, 0.0])
    coast(world)
    assert world.collided.all()
    scenario = scene([[-1.0, 0.51]], obstacles=[[0.0, 0.0]], agent_radius=0.5, core_radius=0.0)
    world = begun(scenario, [20.0, 0.0])
    coast(world)
    assert not world.collided.any()


def dense(points, count=400):
    """Positions along polylines (corners, 2, ...), finely."""
    shares = np.linspace(0.0, 1.0, count)
    pieces = [
        start + shares.reshape(-1, *[1] * start.ndim) * (end - start)
        for start, end in itertools.pairwise(points)
    ]
    return np.concatenate(pieces)


@given(st.integers(0, 2**32), st.sampled_from([1, 2, 5]))
def test_no_collision_of_random_paths_is_missed(seed, agents):
    rng = np.random.default_rng(seed)
    worlds, contact = 12, rng.uniform(0.2, 0.8, 12)
    points = np.cumsum(rng.normal(size=(SUBSTEPS + 1, 2, worlds, agents)), axis=0)
    path = Path.through(points, np.zeros((worlds, agents)))
    fine = dense(points)
    offsets = fine[..., :, None] - fine[..., None, :]
    least = np.min(np.hypot(offsets[:, 0], offsets[:, 1]), axis=0)
    least[:, np.arange(agents), np.arange(agents)] = np.inf
    least = least.min(axis=2)
    hit = swept_agents(path, contact)
    # The samples are 0.02 m apart, at most.
    assert np.all(hit[least < contact[:, None] - 1e-9])
    assert not np.any(hit[least > contact[:, None] + 0.02])
    centres = rng.normal(size=(2, worlds, 3))
    reach = rng.uniform(0.2, 0.8, (worlds, 3))
    reach[rng.random((worlds, 3)) < 0.3] = -np.inf
    offsets = fine[..., :, None] - centres[:, :, None]
    gaps = np.min(np.hypot(offsets[:, 0], offsets[:, 1]), axis=0) - reach[:, None]
    hit = swept_obstacles(path, centres, reach)
    assert np.all(hit[gaps.min(axis=2) < -1e-9])
    assert not np.any(hit[gaps.min(axis=2) > 0.02])


def test_the_closest_approach_of_a_point_at_rest_is_its_distance():
    offsets = np.broadcast_to(np.array([3.0, 4.0])[None, :, None], (3, 2, 1))
    np.testing.assert_allclose(closest_approach(offsets), [5.0])


def test_the_bulge_of_a_curved_path_counts_as_contact():
    """A fine integration never finds a collision that the sweep of the held step misses."""
    rng = np.random.default_rng(5)
    found = 0
    for _ in range(300):
        centre = rng.normal((1.2, 0.0))
        if np.linalg.norm(centre) < 0.76:
            continue
        scenario = scene([[0.0, 0.0]], obstacles=[centre])
        world = begun(scenario, rng.normal(size=2) * 8.0)
        state, control = world.states[0, 0], rng.uniform(0.0, 20.0, 8)
        state[5] = world.parts[5, 0, 0] = rng.normal()
        gaps = []
        for _ in range(200):
            state = hold_step(Spacecraft(), state, control, 0.1 / 200, None, 1)
            gaps.append(np.linalg.norm(state[:2] - scenario.obstacles[0]) - 0.75)
        world.step(control[None, None])
        np.testing.assert_allclose(world.states[0, 0, :2], state[:2], atol=1e-5)
        if min(gaps) < 0.0:
            found += 1
            assert world.collided.all()
        if min(gaps) > 0.05:
            assert not world.collided.any()
    assert found > 25


@pytest.mark.parametrize("what", ["obstacle", "agent"])
@pytest.mark.parametrize(("gap", "hit"), [(0.02, True), (0.035, False)])
def test_a_path_that_bends_into_something_between_its_corners_collides(what, gap, hit):
    """Under 100 m/s^2 the path of a substep of 0.05 s leaves its chord by 31 mm."""
    drop = 100.0 * 0.05**2 / 2.0
    normal = np.array([-drop, -1.0]) / math.hypot(drop, 1.0)  # of a chord 1 m long
    contact = 0.75 if what == "obstacle" else 0.5
    centre = np.array([0.5, -drop / 2.0]) + (contact + gap) * normal
    if what == "obstacle":
        world = begun(scene([[0.0, 0.0]], obstacles=[centre]), [20.0, -5.0])
    else:
        world = begun(scene([[0.0, 0.0], centre]), [[20.0, -5.0], [0.0, 0.0]])
    forces = np.zeros((1, world.agents, 8))
    forces[0, 0, 6:] = 50.0
    world.step(forces)
    np.testing.assert_allclose(world.parts[:2, 0, 0], [2.0, 0.0], atol=1e-12)
    assert np.all(world.collided == hit)


def test_a_collision_is_for_good_and_stops_nobody():
    world = begun(scene([[-1.0, 0.0], [1.0, 0.0], [9.0, 9.0]]), [[20.0, 0], [-20.0, 0], [0, 0]])
    coast(world)
    first = world.collision_time.copy()
    assert coast(world, 3).reward[0, 0] > -5.0
    np.testing.assert_array_equal(world.collision_time, first)
    np.testing.assert_allclose(world.parts[0, 0, :2], [7.0, -7.0], atol=1e-9)


def test_a_collision_that_lasts_is_counted_once():
    """Four steps pass while the two overlap."""
    world = begun(scene([[-0.3, 0.0], [0.3, 0.0], [9.0, 9.0]]), [[1.5, 0.0], [-1.5, 0.0], [0, 0]])
    penalties = []
    for _ in range(4):
        outcome = coast(world)
        penalties.append(outcome.reward[0, :2] < -4.0)
        np.testing.assert_allclose(world.collision_time[0, :2], 0.1)
    assert np.sum(penalties, axis=0).tolist() == [1, 1]


def test_a_world_ends_when_all_have_collided_or_at_the_limit():
    some = begun(scene([[-1.0, 0.0], [1.0, 0.0], [9.0, 9.0]]), [[20.0, 0], [-20.0, 0], [0, 0]])
    assert not coast(some).terminated.any()
    outcome = coast(begun(scene([[-1.0, 0.0], [1.0, 0.0]]), [[20.0, 0], [-20.0, 0]]))
    assert outcome.terminated.all()
    assert not outcome.truncated.any()
    outcome = coast(some, 448)
    assert not outcome.truncated.any()
    assert coast(some).truncated.all()
    assert some.time[0] == pytest.approx(45.0)


@pytest.mark.parametrize("seed", range(5))
def test_no_axis_goes_faster_than_the_speed_limit(seed):
    """Against very small steps of a point whose speed is cut along each axis, as GCBF+ cuts it."""
    limit, period, fine = 0.5, 0.1, 400
    rng = np.random.default_rng(seed)
    world = begun(scene([[0.0, 0.0], [9.0, 0.0]]), [[0.45, -0.48], [0.1, 0.3]], speed_limit=limit)
    places, speeds = world.states[0, :, :2], world.states[0, :, 3:5]
    for _ in range(25):
        forces = rng.uniform(0.0, 1.0, (1, 2, 8))
        # Of each pair of pairs the same torque: the body keeps its heading, zero.
        forces[..., [1, 3, 5, 7]] = forces[..., [0, 2, 4, 6]]
        world.step(forces)
        wrench = np.moveaxis(np.array(Spacecraft().wrench(list(forces[0].T)))[:2], 0, -1)
        for _ in range(fine):
            faster = np.clip(speeds + wrench * period / fine, -limit, limit)
            places = places + 0.5 * (speeds + faster) * period / fine
            speeds = faster
        np.testing.assert_allclose(world.states[0, :, :2], places, atol=1e-4)
        np.testing.assert_allclose(world.states[0, :, 3:5], speeds, atol=1e-9)
        assert np.max(np.abs(world.states[0, :, 3:5])) <= limit


def test_a_thrust_too_large_to_integrate_is_a_collision_of_that_agent_alone():
    world = begun(scene([[0.0, 0.0], [3.0, 0.0]]))
    actions = np.zeros((1, 2, 8))
    actions[0, 0, 4] = 1e308
    forces = applied_forces(SpacecraftSettings(thrust_scale=100.0), actions)
    outcome = world.step(forces)
    assert np.all(np.isfinite(outcome.reward))
    np.testing.assert_array_equal(world.collided, [[True, False]])
    np.testing.assert_array_equal(world.parts[:2, 0].T, [[0.0, 0.0], [3.0, 0.0]])
    assert not outcome.terminated.any()


# Measures.


def redefine(world, states, forces, scenario, tube):
    """Recompute success, its times and the effort from states and forces alone."""
    rows = []
    for agent in range(world.agents):
        success = paper = math.inf
        effort = 0.0
        collided = world.collision_time[0, agent]
        for step, state in enumerate(states):
            time = 0.1 * step
            if step:
                effort += 0.1 * np.sum(forces[step - 1][agent] ** 2)
            if success == math.inf:
                effort_to = effort
            gap = math.dist(state[agent, :2], scenario.goals[agent])
            if time < collided - 1e-9:
                if gap <= 0.2:
                    success = min(success, time)
                if math.hypot(gap, *state[agent, 3:5]) <= tube(time):
                    paper = min(paper, time)
        rows.append((success, paper, effort, effort_to, gap))
    return rows


@pytest.mark.parametrize("kind", ["none", "uniform", "gust"])
def test_measures_follow_their_definitions(kind, fly):
    disturbance = Disturbance(kind, 0.1, ALL)
    arrived = collided = 0
    for seed in range(6):
        scenario = PRESETS["paper"].sample(episode_streams(seed).scenario)
        world = begun(scenario, disturbance=disturbance, seed=seed)
        states, forces = [world.states[0]], []
        for _ in range(300):
            forces.append(fly(world.states[0], scenario))
            world.step(forces[-1][None])
            states.append(world.states[0])
        rows = redefine(
            world, states, forces, scenario, lambda t: 0.125 * (1.0 - math.exp(-0.3 * t))
        )
        info = world.info()
        for agent, (success, paper, effort, effort_to, gap) in enumerate(rows):
            assert info["success_time"][0, agent] == pytest.approx(success)
            assert info["success"][0, agent] == (success < math.inf)
            assert info["paper_success_time"][0, agent] == pytest.approx(paper)
            assert info["paper_success"][0, agent] == (paper < math.inf)
            assert info["effort"][0, agent] == pytest.approx(effort)
            assert info["effort_to_success"][0, agent] == pytest.approx(effort_to)
            assert info["goal_distance"][0, agent] == pytest.approx(gap)
            strict = gap <= 0.2 and math.isinf(info["collision_time"][0, agent])
            assert info["strict_success"][0, agent] == strict
        arrived += info["success"].sum()
        collided += info["collided"].sum()
    # The agents fly straight at their goals: some arrive, some hit something.
    assert arrived > 2
    assert collided > 3


def test_arriving_in_the_step_of_a_collision_is_no_success():
    scenario = scene([[-1.0, 0.0], [1.0, 0.0]], goals=[[1.0, 0.0], [-1.0, 0.0]])
    world = begun(scenario, [[20.0, 0.0], [-20.0, 0.0]])
    outcome = coast(world)
    assert np.all(world.goal_distance < 1e-9)
    info = world.info()
    assert not info["success"].any()
    assert not info["strict_success"].any()
    np.testing.assert_allclose(outcome.reward, 2.0 - 5.0)


def test_arriving_first_and_colliding_later_is_a_success_but_not_a_strict_one():
    world = begun(scene([[0.0, 0.0], [2.0, 0.0]], goals=[[0.3, 0], [9, 0]]), [[2.0, 0.0], [0, 0]])
    coast(world, 30)
    info = world.info()
    assert info["success"].tolist() == [[True, False]]
    assert info["success_time"][0, 0] == pytest.approx(0.1)
    assert info["collided"].all()
    assert not info["strict_success"].any()


def test_rewards_add_up_to_the_way_made_good(fly):
    scenario = PRESETS["open"].sample(episode_streams(1).scenario, 1)
    world = begun(scenario)
    start, total = world.goal_distance[0, 0], 0.0
    for _ in range(450):
        total += world.step(fly(world.states[0], scenario)[None]).reward[0, 0]
    info = world.info()
    assert info["strict_success"].all()
    expected = start - info["goal_distance"][0, 0] - 0.02 * info["effort"][0, 0] + 5.0
    assert total == pytest.approx(expected)


def test_thrusters_cannot_pull_and_a_limit_clips():
    actions = np.array([-1.0, 0.0, 0.5, 1.0, 2.0])
    settings = SpacecraftSettings(thrust_scale=3.0)
    np.testing.assert_allclose(applied_forces(settings, actions), [0, 0, 1.5, 3, 6])
    settings = SpacecraftSettings(thrust_scale=3.0, thrust_limit=4.0)
    np.testing.assert_allclose(applied_forces(settings, actions), [0, 0, 1.5, 3, 4])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"control_period": 0.0}, "control_period=0.0"),
        ({"time_limit": 45.05}, "time_limit=45.05 must be a whole number"),
        ({"sensing_radius": -1.0}, "sensing_radius=-1.0"),
        ({"thrust_limit": 0.0}, "thrust_limit=0.0"),
        ({"speed_limit": 0.0}, "speed_limit=0.0"),
        ({"effort_weight": math.nan}, "effort_weight=nan"),
    ],
)
def test_settings_that_make_no_sense_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        SpacecraftSettings(**values)


# Each agent has its own disturbance, and each world its own life.


@pytest.mark.parametrize("kind", sorted(OPEN_LOOP.keys() - {"none"}))
def test_every_agent_meets_its_own_bounded_disturbance(kind):
    scenario = PRESETS["open"].sample(episode_streams(0).scenario)
    met = []
    for bound in (0.3, 0.6):
        world = begun(scenario, disturbance=Disturbance(kind, bound, ALL))
        pushes = []
        for _ in range(20):
            coast(world)
            pushes.append(world.info()["disturbance"][0])
        met.append(np.array(pushes))
        assert np.max(np.linalg.norm(met[-1], axis=-1)) <= bound
    np.testing.assert_allclose(met[1], 2.0 * met[0], rtol=1e-12)
    flat = met[0].transpose(1, 0, 2).reshape(6, -1)
    assert len(np.unique(flat, axis=0)) == 6


def test_an_agent_meets_the_same_disturbance_among_any_number():
    pushes = []
    for agents in (1, 6):
        starts = 3.0 * np.arange(agents)[:, None] * np.ones(2)
        world = begun(scene(starts), disturbance=Disturbance("uniform", 0.5, ALL))
        coast(world, 7)
        pushes.append(world.info()["disturbance"][0, 0])
    np.testing.assert_array_equal(*pushes)


def test_a_step_is_the_held_step_of_every_agent():
    scenario = PRESETS["paper"].sample(episode_streams(2).scenario)
    world = begun(scenario, disturbance=Disturbance("sphere", 0.5, ALL))
    rng = np.random.default_rng(0)
    for _ in range(20):
        before, forces = world.states, rng.uniform(0.0, 3.0, (1, 6, 8))
        world.step(forces)
        push = world.info()["disturbance"]
        expected = hold_step(Spacecraft(), before, forces, 0.1, push, SUBSTEPS)
        np.testing.assert_allclose(world.states, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["uniform", "worst", "callable"])
def test_a_batch_of_one_is_the_batch(kind, fly):
    worlds, agents = 5, 4
    disturbance = Disturbance(
        {"callable": lambda now: np.sin(now.state + now.time[..., None])}.get(kind, kind),
        0.4,
        ALL,
        np.diag([2.0, 2.0, 1.0, 3.0, 3.0, 1.0]),
    )
    settings = SpacecraftSettings(time_limit=20.0)
    scenarios = [PRESETS["paper"].sample(episode_streams(k).scenario, agents) for k in range(5)]
    nominal = np.random.default_rng(1).normal(size=(worlds, 201, agents, 6))
    together = SpacecraftWorld(worlds, agents, 6, disturbance, settings)
    together.nominal = nominal
    generators = [episode_streams(seed).disturbance for seed in range(worlds)]
    together.begin(np.arange(worlds), scenarios, generators)
    alone = []
    for seed, scenario in enumerate(scenarios):
        world = SpacecraftWorld(1, agents, 6, disturbance, settings)
        world.nominal = nominal[seed : seed + 1]
        world.begin(np.array([0]), [scenario], [episode_streams(seed).disturbance])
        alone.append(world)
    for _ in range(200):
        forces = np.stack(
            [fly(world.states[0], scene_) for world, scene_ in zip(alone, scenarios, strict=True)]
        )
        outcome = together.step(forces)
        info = together.info()
        for index, world in enumerate(alone):
            single = world.step(forces[index : index + 1])
            np.testing.assert_allclose(together.states[index], world.states[0], rtol=0, atol=1e-10)
            for ours, theirs in zip(outcome, single, strict=True):
                np.testing.assert_allclose(ours[index], theirs[0], rtol=0, atol=1e-10)
            for name, value in world.info().items():
                np.testing.assert_allclose(
                    info[name][index], value[0], rtol=0, atol=1e-10, err_msg=name
                )
    assert 0 < together.collided.sum() < together.collided.size


def test_agents_may_be_numbered_in_any_order(fly):
    scenario = PRESETS["paper"].sample(episode_streams(3).scenario)
    order = np.random.default_rng(0).permutation(6)
    swapped = Scenario(
        scenario.starts[order],
        scenario.headings[order],
        scenario.goals[order],
        scenario.obstacles[::-1],
        scenario.obstacle_radii,
    )
    one, other = begun(scenario), begun(swapped)
    for _ in range(120):
        one.step(fly(one.states[0], scenario)[None])
        other.step(fly(other.states[0], swapped)[None])
    np.testing.assert_allclose(one.states[0, order], other.states[0], atol=1e-10)
    np.testing.assert_array_equal(one.collision_time[0, order], other.collision_time[0])


def test_scenarios_that_do_not_fit_the_world_are_refused():
    world = SpacecraftWorld(1, 2, 1, NONE, SpacecraftSettings())
    streams = [episode_streams(0).disturbance]
    with pytest.raises(ValueError, match="has 3 agents; this environment was built with num_agen"):
        world.begin(np.array([0]), [scene([[0, 0], [1, 1], [2, 2]])], streams)
    crowded = scene([[0, 0], [1, 1]], obstacles=[[5, 5], [7, 7]])
    with pytest.raises(ValueError, match=r"has 2 obstacles; .* at most 1: .*obstacle_count=\(0, 2"):
        world.begin(np.array([0]), [crowded], streams)
