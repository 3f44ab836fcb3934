"""Policy (b) of the spacecraft: what it remembers, and the closed loop among others."""

import dataclasses

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Scenario
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.planning.local.motion import Discs
from lagros_policies.planning.local.plan import LocalPlanner
from lagros_policies.planning.local.problem import LocalPlannerSettings, LocalProblem
from lagros_policies.policy import Policy
from lagros_policies.tasks.spacecraft.distributed import DistributedTubeMpcPolicy

HERE = np.zeros(2)


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
    # A busy machine makes no plan late here.
    arguments.setdefault("deadline", 1e9)
    return env, DistributedTubeMpcPolicy(env.settings, preset, agents, bound, **arguments)


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


def test_a_failure_of_the_solver_is_said_and_harmless(monkeypatch):
    monkeypatch.setattr("lagros_policies.planning.local.problem._solve", lambda *_: None)
    plan = LocalPlanner().plan(np.array([2.0, 0.0, 0.0, 0.0]), HERE, Discs.none(), 20.0)
    assert not plan.solved
    policy = DistributedTubeMpcPolicy()
    action, memory = policy.predict(observation(policy.layout))
    assert policy.counters(memory)["failed_plans"] == 1
    assert np.max(action) < 1e-6  # it holds its position


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


class Clock:
    """A clock that advances by `lag` whenever it is looked at."""

    def __init__(self, lag):
        self.lag, self.now = lag, 0.0

    def __call__(self):
        self.now += self.lag
        return self.now


def test_a_plan_that_comes_late_is_counted_and_the_last_one_stays_in_force():
    clock = Clock(0.0)
    policy = DistributedTubeMpcPolicy(replan_every=1, kept_for=0.0, clock=clock)
    row = observation(policy.layout, (2.0, 0.0))
    _, first = policy.predict(row)
    clock.lag = policy.settings.control_period * 1.01
    later = observation(policy.layout, (2.0, 0.0), time=0.1)
    action, second = policy.predict(later, first)
    assert second[0].plan is first[0].plan
    assert second[0].age == 1
    assert np.all(np.isfinite(action))
    counted = policy.counters(second)
    assert (counted["plans"], counted["late_plans"], counted["failed_plans"]) == (2, 1, 0)
    clock.lag = policy.settings.control_period * 0.99
    _, third = policy.predict(observation(policy.layout, (2.0, 0.0), time=0.2), second)
    assert third[0].plan is not first[0].plan
    assert policy.counters(third)["late_plans"] == 1
    # What was returned before stays what it was.
    assert policy.counters(first)["late_plans"] == 0


def test_the_first_plan_is_waited_for():
    clock = Clock(10.0)
    policy = DistributedTubeMpcPolicy(deadline=1.0, clock=clock)
    _, memory = policy.predict(observation(policy.layout, (2.0, 0.0)))
    assert memory[0].plan is not None
    assert policy.counters(memory)["late_plans"] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"deadline": 0.0}, "deadline"), ({"clock": 1.0}, "clock"), ({"law": "pid"}, "law='pid'")],
)
def test_a_deadline_a_clock_or_a_law_that_is_none_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        DistributedTubeMpcPolicy(**arguments)


@pytest.mark.parametrize("far", [20.0, 1e3, 1e6])
def test_a_goal_far_away_is_answered_by_a_plan_of_bounded_size(far):
    policy = DistributedTubeMpcPolicy(num_agents=2, deadline=1e9)
    goal = far * np.array([0.6, -0.8])
    row = observation(policy.layout, goal, obstacles=[(1.2, -1.6, 0.5)])
    action, memory = policy.predict(row)
    plan = memory[0].plan
    assert plan.solved
    assert np.isfinite(action).all()
    assert plan.duration <= policy.settings.horizon
    # In axes whose origin is the goal it ends at rest, 8 m ahead of where the agent is.
    place, speed = plan.at(np.array([plan.duration]))
    assert place[0] + goal == pytest.approx(8.0 * goal / far, abs=1e-6 * max(far, 10.0))
    assert speed == pytest.approx(0.0, abs=1e-5)
    times = np.linspace(0.0, plan.duration, 2000)
    around = np.linalg.norm(plan.at(times)[0] + goal - [1.2, -1.6], axis=-1)
    assert around.min() >= 0.75


def test_a_planner_alone_is_bounded_too_however_long_its_plan():
    settings = LocalPlannerSettings()
    counts = []
    for far in (8.0, 100.0, 1e4, 1e6):
        problem = LocalProblem(settings, np.zeros(4), np.array([far, 0.0]), Discs.none(), 1.0)
        counts.append(len(problem.times))
    assert counts[1] == counts[2] == counts[3]
    plan = LocalPlanner(settings).plan(np.zeros(4), np.array([1e4, 0.0]), Discs.none(), 1.0)
    assert plan.solved
    assert len(plan.forces) == settings.near_steps + settings.far_steps


def test_a_goal_20_m_away_is_reached_in_parts():
    far = Scenario([[0.0, 0.0]], [0.3], [[12.0, 16.0]], [[6.0, 8.2]], [0.5])
    settings = SpacecraftSettings(horizon=60.0, time_limit=90.0)
    env = spacecraft_v0.parallel_env(1, settings=settings, disturbance="none")
    policy = DistributedTubeMpcPolicy(settings, num_agents=1, disturbance_bound=0.0, deadline=1e9)
    states, _, info, _ = fly(env, policy, options={"scenario": far}, steps=800)
    assert all(part["strict_success"] for part in info.values())
    assert np.linalg.norm(states[:, 0, :2] - [6.0, 8.2], axis=-1).min() > 0.75
