"""Policy (b): the plan of one agent, what it remembers, and the closed loop among others."""

import dataclasses

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.observation import Layout
from lagros_envs.scenarios import PRESETS, Scenario
from lagros_envs.spacecraft_task import SpacecraftSettings
from lagros_policies.distributed import DistributedTubeMpcPolicy
from lagros_policies.planning.grid_path import GridSettings, segment_distance, shortest_paths
from lagros_policies.planning.local_guess import pass_aside, way_around
from lagros_policies.planning.local_map import LocalMap
from lagros_policies.planning.local_motion import Discs
from lagros_policies.planning.local_plan import LocalPlanner, LocalPlannerSettings
from lagros_policies.policy import Policy

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


def observation(
    layout, goal=(1.0, 0.0), neighbours=(), obstacles=(), time=0.0, velocity=(0.0, 0.0)
):
    """Return the o_l of one agent, written by hand."""
    row = np.zeros(layout.size, np.float32)
    at = layout.slices
    row[at["goal"]], row[at["velocity"]], row[at["time"]] = goal, velocity, time
    row[at["heading"]] = 1.0, 0.0, 0.0
    for name, values in (("neighbour", neighbours), ("obstacle", obstacles)):
        flat = np.ravel(np.asarray(values, np.float32))
        row[at[name + "s"]][: flat.size] = flat
        row[at[name + "_mask"]][: len(values)] = 1.0
    return row


def fly(env, policy, seed=0, options=None, steps=None):
    """Fly an episode; return the states, the actions, the last infos and the memories."""
    observations, _ = env.reset(seed=seed, options=options)
    memory, visited, taken, info = None, [env.states], [], {}
    while env.agents and (steps is None or len(taken) < steps):
        rows = np.stack([observations[agent] for agent in env.agents])
        actions, memory = policy.predict(rows, memory)
        observations, _, _, _, info = env.step(dict(zip(env.agents, actions, strict=True)))
        visited.append(env.states)
        taken.append(actions)
    return np.array(visited), np.array(taken), info, memory


def built(preset="paper", agents=3, bound=0.0, **arguments):
    """Return environment and policy of one task."""
    kind = "uniform" if bound else "none"
    env = spacecraft_v0.parallel_env(agents, preset, disturbance=kind, disturbance_bound=bound)
    return env, DistributedTubeMpcPolicy(env.settings, preset, agents, bound, **arguments)


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


def test_a_failure_of_the_solver_is_said_and_harmless(monkeypatch):
    monkeypatch.setattr("lagros_policies.planning.local_plan._solve", lambda *_: None)
    plan = LocalPlanner().plan(np.array([2.0, 0.0, 0.0, 0.0]), HERE, Discs.none(), 20.0)
    assert not plan.solved
    policy = DistributedTubeMpcPolicy()
    action, memory = policy.predict(observation(policy.layout))
    assert policy.counters(memory)["failed_plans"] == 1
    assert np.max(action) < 1e-6  # it holds its position


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


# The policy.


def test_is_a_policy_of_the_local_observation():
    policy = DistributedTubeMpcPolicy()
    assert isinstance(policy, Policy)
    assert (policy.name, policy.observes) == ("tube-mpc", "local")


@pytest.mark.parametrize(
    ("preset", "agents"), [("paper", 3), pytest.param("crossing", 4, marks=pytest.mark.slow)]
)
def test_agents_reach_their_goals_and_keep_their_heading(preset, agents):
    env, policy = built(preset, agents)
    steps = 340
    states, actions, info, memory = fly(env, policy, seed=4, steps=steps)
    assert all(part["strict_success"] and not part["collided"] for part in info.values())
    assert states[..., 2] == pytest.approx(
        np.broadcast_to(env.scenario.headings, states[..., 2].shape), abs=1e-3
    )
    assert actions.dtype == np.float32
    assert np.all(actions >= 0.0)
    counted = policy.counters(memory)
    assert counted["plans"] + counted["confirmed_plans"] >= agents * steps // policy.replan_every
    assert counted["stuck"] == 0


def test_two_head_on_pass_each_other_on_the_right():
    env, policy = built("open", 2)
    goals = np.array([[4.0, 2.0], [1.0, 2.0]])
    scenario = Scenario(goals[::-1], np.zeros(2), goals, np.zeros((0, 2)), np.zeros(0))
    states, _, info, _ = fly(env, policy, options={"scenario": scenario}, steps=320)
    assert all(part["strict_success"] for part in info.values())
    meet = np.argmin(np.linalg.norm(states[:, 0, :2] - states[:, 1, :2], axis=-1))
    assert states[meet, 0, 1] < states[meet, 1, 1]


def test_a_plan_is_kept_while_it_holds_and_renewed_when_it_does_not():
    policy = DistributedTubeMpcPolicy(disturbance_bound=0.0, kept_for=100.0)
    memory, step = None, 0

    def look(neighbours):
        nonlocal memory, step
        plan = memory[0].plan if memory else None
        here = np.array([2.0, 0.0]) if plan is None else plan.at(np.array([0.1 * step]))[0][0]
        row = observation(policy.layout, -here, neighbours, time=0.1 * step)
        _, memory = policy.predict(row, memory)
        step += 1

    for _ in range(7):
        look(())
    counted = policy.counters(memory)
    assert (counted["plans"], counted["confirmed_plans"]) == (1, 3)
    first = memory[0].plan
    look([(0.0, 1.5, 0.0, 0.0)])  # in nobody's way, and new: looked at, at once
    assert memory[0].plan is first
    assert policy.counters(memory)["confirmed_plans"] == 4
    look([(-1.2, 0.1, 0.0, 0.0), (0.0, 1.5, 0.0, 0.0)])
    assert memory[0].plan is not first
    assert policy.counters(memory)["plans"] == 2
    assert memory[0].plan.short <= 0.01


def test_the_first_step_tracks_the_plan():
    env, policy = built(agents=2)
    observations, _ = env.reset(seed=2)
    rows = np.stack([observations[agent] for agent in env.agents])
    actions, memory = policy.predict(rows)
    env.step(dict(zip(env.agents, actions, strict=True)))
    for state, goal, part in zip(env.states, env.scenario.goals, memory, strict=True):
        place, speed = part.plan.at(np.array([0.1]))
        assert state[:2] - goal == pytest.approx(place[0], abs=1e-5)
        assert state[3:5] == pytest.approx(speed[0], abs=1e-5)


def rows_of_a_flight(steps=21):
    """Return the observations of six disturbed agents over some steps, and their policy."""
    env, policy = built(agents=6, bound=0.6)
    observations, _ = env.reset(seed=5)
    rows, memory = [], None
    for _ in range(steps):
        rows.append(np.stack([observations[agent] for agent in env.agents]))
        actions, memory = policy.predict(rows[-1], memory)
        observations, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
    # Otherwise the order of the slots would say nothing.
    for name in ("neighbour_mask", "obstacle_mask"):
        assert np.max(np.sum(rows[0][:, policy.layout.slices[name]], axis=1)) >= 2.0
    return np.array(rows), policy


@pytest.fixture(scope="module")
def flight():
    return rows_of_a_flight()


def replay(policy, rows):
    memory, taken = None, []
    for row in rows:
        actions, memory = policy.predict(row, memory)
        taken.append(actions)
    return np.array(taken)


def test_an_action_depends_on_its_own_row_only(flight):
    rows, policy = flight
    together = replay(policy, rows)
    order = np.array([3, 0, 5, 1, 4, 2])
    assert np.array_equal(replay(policy, rows[:, order]), together[:, order])
    assert replay(policy, rows[:, 2]) == pytest.approx(together[:, 2], abs=1e-6)


def test_the_order_of_slots_does_not_matter(flight):
    rows, policy = flight
    at = policy.layout.slices
    rng = np.random.default_rng(0)
    shuffled = rows.copy()
    for step in range(len(rows)):
        for name in ("neighbour", "obstacle"):
            slots = rows[step][:, at[name + "s"]].reshape(6, -1, 4 if name == "neighbour" else 3)
            order = rng.permutation(slots.shape[1])
            shuffled[step][:, at[name + "s"]] = slots[:, order].reshape(6, -1)
            shuffled[step][:, at[name + "_mask"]] = rows[step][:, at[name + "_mask"]][:, order]
    assert not np.array_equal(shuffled, rows)
    assert np.array_equal(replay(policy, shuffled), replay(policy, rows))


def test_one_seed_gives_one_flight():
    first, second = (fly(*built(bound=0.5), seed=3, steps=30) for _ in range(2))
    assert np.array_equal(first[0], second[0])
    assert np.array_equal(first[1], second[1])


def test_episode_start_forgets(flight):
    rows, policy = flight
    _, memory = policy.predict(rows[0])
    for row in rows[1:20]:
        _, memory = policy.predict(row, memory)
    starts = np.array([True, False, False, False, True, False])
    again = np.where(starts[:, None], rows[0], rows[20])
    actions, memory = policy.predict(again, memory, starts)
    fresh, _ = policy.predict(rows[0])
    assert np.array_equal(actions[starts], fresh[starts])
    assert [part.plans == 1 for part in memory] == starts.tolist()
    with pytest.raises(ValueError, match="episode_start"):
        policy.predict(rows[0], memory)


RING = [(np.cos(a), np.sin(a), 0.5) for a in np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False)]


def test_a_start_without_a_way_is_counted_and_shown_as_stuck():
    policy = DistributedTubeMpcPolicy(disturbance_bound=0.4)
    memory = None
    for step in range(62):
        row = observation(policy.layout, (3.0, 0.0), (), RING, 0.1 * step)
        action, memory = policy.predict(row, memory)
        assert np.all(np.isfinite(action))
    counted = policy.counters(memory)
    assert counted["failed_plans"] >= 1
    assert counted["failed_plans"] <= counted["plans"]
    assert counted["stuck"] == 1
    assert counted["stuck_steps"] == 1
    assert memory[0].plan.short > policy.planner.settings.tolerance


def test_at_the_goal_nobody_is_stuck():
    policy = DistributedTubeMpcPolicy()
    memory = None
    for step in range(70):
        _, memory = policy.predict(observation(policy.layout, (0.0, 0.0), time=0.1 * step), memory)
    counted = policy.counters(memory)
    assert counted["plans"] + counted["confirmed_plans"] == 35
    assert counted["confirmed_plans"] > 0
    assert [counted[name] for name in ("failed_plans", "stuck", "stuck_steps")] == [0, 0, 0]


def test_units_mass_and_radii_are_those_of_the_task():
    settings = SpacecraftSettings(thrust_scale=0.5)
    strong = DistributedTubeMpcPolicy(settings).predict(observation(Layout(5, 6, 45.0)))[0]
    plain = DistributedTubeMpcPolicy().predict(observation(Layout(5, 6, 45.0)))[0]
    assert strong == pytest.approx(2.0 * plain, rel=1e-5)
    assert plain.max() > 0.0
    body = dataclasses.replace(SpacecraftSettings().system, mass=2.0)
    assert DistributedTubeMpcPolicy(SpacecraftSettings(system=body)).planner.settings.mass == 2.0
    with pytest.raises(ValueError, match="mass"):
        DistributedTubeMpcPolicy(planner=LocalPlannerSettings(mass=2.0))
    preset = dataclasses.replace(PRESETS["paper"], agent_radius=0.1)
    assert DistributedTubeMpcPolicy(preset=preset).preset.agent_radius == 0.1


@pytest.mark.parametrize(
    "arguments",
    [
        {"disturbance_bound": -1.0},
        {"contraction_rate": 0.0},
        {"turning_rate": np.inf},
        {"margin": -0.1},
        {"replan_every": 0},
        {"kept_for": -0.1},
        {"smoothing": np.nan},
    ],
)
def test_arguments_are_checked(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        DistributedTubeMpcPolicy(**arguments)


def test_wrong_observations_get_clear_errors():
    policy = DistributedTubeMpcPolicy()
    row = observation(policy.layout)
    with pytest.raises(ValueError, match="preset"):
        policy.predict(row[:-1])
    with pytest.raises(ValueError, match="preset"):
        policy.predict(row[None, None])
    with pytest.raises(ValueError, match="finite"):
        policy.predict(np.where(np.arange(row.size) == 3, np.nan, row))
    _, memory = policy.predict(np.stack([row, row]))
    with pytest.raises(ValueError, match="2 agents"):
        policy.predict(row, memory)
    with pytest.raises(ValueError, match="episode_start"):
        policy.predict(row, None, np.zeros(3, bool))
