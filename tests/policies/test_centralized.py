"""Policy (d) in the real environment, and what it does when there is no plan."""

import dataclasses

import numpy as np
import pytest

import lagros_policies
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Scenario
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.contraction.double_integrator import expected_margin
from lagros_policies.planning.joint.planner import JointPlannerSettings
from lagros_policies.policy import Policy
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy
from lagros_policies.tasks.spacecraft.thrusters import allocate

GOALS_AT = 1 + 6  # of one agent: time, state, goal


def fly(env, policy, seed, options=None, steps=None):
    """Fly an episode; return the states, the actions, the last infos and the memories."""
    env.reset(seed=seed, options=options)
    memory, visited, taken, infos = None, [env.states], [], []
    while env.agents and (steps is None or len(taken) < steps):
        actions, memory = policy.predict(env.state(), memory)
        _, _, _, _, info = env.step(dict(zip(env.agents, actions, strict=True)))
        visited.append(env.states)
        taken.append(actions)
        infos.append(info)
    return np.array(visited), np.array(taken), infos, memory


def measures(infos, name):
    return np.array([info[name] for info in infos[-1].values()])


def built(preset="paper", agents=3, bound=0.0, **arguments):
    """Return environment and policy of one task."""
    kind = "uniform" if bound else "none"
    env = spacecraft_v0.parallel_env(agents, preset, disturbance=kind, disturbance_bound=bound)
    return env, CentralizedPolicy(env.settings, preset, agents, bound, **arguments)


@pytest.fixture(scope="module")
def calm():
    """Return an undisturbed flight of three agents in `paper`, measured against its plan."""
    env, policy = built()
    env.reset(seed=4)
    _, memory = policy.predict(env.state())
    flight = fly(env, policy, 4, {"nominal": memory[0].nominal})
    return env, policy, memory[0], flight


def test_is_a_policy_of_the_global_state():
    policy = CentralizedPolicy()
    assert isinstance(policy, Policy)
    assert (policy.name, policy.observes, policy.agents) == ("centralized", "global", 6)


def test_without_disturbance_the_plan_is_flown(calm):
    env, _, memory, (_, actions, infos, memories) = calm
    assert memory.solved
    assert memories[0].plan.states == pytest.approx(memory.plan.states)
    assert max(i["tracking_error"] for info in infos for i in info.values()) < 1e-4
    # What rounding in float32 adds to the effort of the plan is small.
    assert measures(infos, "effort") == pytest.approx(memory.plan.effort, rel=1e-2)
    assert actions.shape == (env.settings.steps, 3, 8)
    assert actions.dtype == np.float32
    assert np.all(actions >= 0.0)


def test_all_arrive_on_time_and_keep_station(calm):
    env, _, memory, (states, actions, infos, _) = calm
    assert measures(infos, "strict_success").all()
    assert not measures(infos, "collided").any()
    arrived = round(env.settings.horizon / env.settings.control_period)
    assert states[arrived:, :, :2] == pytest.approx(
        np.broadcast_to(env.scenario.goals, states[arrived:, :, :2].shape), abs=1e-3
    )
    assert np.max(np.abs(actions[arrived:])) < 1e-3
    assert np.all(memory.nominal[arrived:, :, 3:] == 0.0)
    assert np.all(memory.nominal[arrived:] == memory.nominal[-1])


def test_the_heading_stays_as_it_was(calm):
    env, _, _, (states, _, _, _) = calm
    assert np.ptp(env.scenario.headings) > 0.1
    assert states[..., 2] == pytest.approx(
        np.broadcast_to(env.scenario.headings, states[..., 2].shape), abs=1e-4
    )


@pytest.mark.parametrize(("preset", "agents"), [("paper", 6), ("open", 4), ("crossing", 4)])
def test_all_reach_their_goals_under_disturbance(preset, agents):
    env, policy = built(preset, agents, bound=0.3)
    _, _, infos, memory = fly(env, policy, seed=8)
    assert measures(infos, "strict_success").all()
    assert measures(infos, "paper_success").all()
    assert policy.counters(memory) == {"plans": 1, "failed_plans": 0}


def test_radii_of_the_released_preset_are_planned_for():
    env, policy = built("released", 2)
    env.reset(seed=1)
    _, memory = policy.predict(env.state())
    plan = memory[0].plan
    assert plan.solved
    places = plan.resample(0.1)[0][..., :2]
    apart = np.linalg.norm(places[0] - places[1], axis=-1)
    assert apart.min() >= 1.0
    assert plan.clearance >= 0.0


def test_one_seed_gives_one_flight():
    first, second = (fly(*built(bound=0.5), seed=3, steps=40) for _ in range(2))
    assert np.array_equal(first[0], second[0])
    assert np.array_equal(first[1], second[1])


def blocked():
    """Return a scenario whose first goal lies in an obstacle."""
    return Scenario(
        starts=[[0.5, 0.5], [0.5, 4.0]],
        headings=[0.3, -1.0],
        goals=[[3.0, 2.5], [4.0, 4.0]],
        obstacles=[[3.0, 2.5]],
        obstacle_radii=[0.5],
    )


def test_without_a_plan_all_hold_their_positions_and_it_is_counted():
    env, policy = built(agents=2, bound=0.2)
    states, _, infos, memory = fly(env, policy, seed=0, options={"scenario": blocked()})
    assert not memory[0].solved
    assert "overlap" in memory[0].plan.status
    assert policy.counters(memory) == {"plans": 1, "failed_plans": 1}
    away = np.linalg.norm(states[..., :2] - blocked().starts, axis=-1)
    assert away.max() < 0.15
    assert not measures(infos, "success").any()


def test_a_planner_is_asked_once_an_episode():
    env, policy = built(agents=2)
    asked = []
    plan = policy.certified.plan
    policy.certified.plan = lambda *args: asked.append(args) or plan(*args)
    _, _, _, memory = fly(env, policy, seed=5, steps=20)
    assert len(asked) == 1
    env.reset(seed=6)
    _, memory = policy.predict(env.state(), memory, np.array([True]))
    assert len(asked) == 2
    assert memory[0].plan.states[:, -1, :2] == pytest.approx(env.scenario.goals, abs=1e-5)


def test_a_row_of_actions_belongs_to_its_agent():
    env, policy = built(agents=3)
    env.reset(seed=7)
    state = env.state()
    actions, memory = policy.predict(state)
    moved = state.copy()
    moved[1 + 6 + 3] += 0.2  # v_x of the second agent
    changed, _ = policy.predict(moved, memory)
    assert np.array_equal(np.any(changed != actions, axis=1), [False, True, False])
    # Against the excess, in the world's axes.
    body, heading = env.settings.system, state[1 + 6 + 2]
    first, second, _ = body.wrench(list(changed[1].astype(float)))
    assert np.cos(heading) * first + np.sin(heading) * second < 0.0


def test_a_batch_of_worlds_is_each_world_alone():
    env, policy = built(agents=2)
    rows = []
    for seed in (1, 2):
        env.reset(seed=seed)
        for _ in range(3):
            env.step(
                {agent: np.full(8, 0.1, np.float32) for agent in env.agents[:1]}
                | {agent: np.zeros(8, np.float32) for agent in env.agents[1:]}
            )
        rows.append(env.state())
    together, memory = policy.predict(np.stack(rows))
    assert together.shape == (2, 2, 8)
    assert policy.counters(memory) == {"plans": 2, "failed_plans": 0}
    for row, actions in zip(rows, together, strict=True):
        alone, _ = policy.predict(row)
        assert alone == pytest.approx(actions, abs=1e-6)
    again, kept = policy.predict(np.stack(rows), memory, np.array([False, True]))
    assert again == pytest.approx(together, abs=1e-6)
    assert kept[0] is memory[0]
    assert kept[1] is not memory[1]


def test_an_episode_joined_late_is_planned_for_the_time_that_is_left():
    env, policy = built("open", agents=2)
    env.reset(seed=2)
    state = env.state()
    state[0] = 35.0
    state[1 + 3] = 0.1  # v_x of the first agent
    _, (memory,) = policy.predict(state)
    assert memory.solved
    assert memory.plan.states.shape[1] - 1 == 20
    assert memory.plan.states[0, 0, 2] == pytest.approx(0.1, abs=1e-5)
    assert memory.nominal[350, :, :2] == pytest.approx(env.scenario.starts, abs=1e-5)
    assert memory.nominal[450, :, :2] == pytest.approx(env.scenario.goals, abs=1e-4)
    state[0] = 44.9
    actions, (memory,) = policy.predict(state)
    assert not memory.solved
    assert policy.counters([memory])["failed_plans"] == 1
    assert np.all(np.isfinite(actions))


def test_past_the_time_limit_station_is_kept(calm):
    env, policy, memory, _ = calm
    state = env.state()
    assert state[0] == env.settings.time_limit
    actions, _ = policy.predict(state, [memory])
    assert np.max(np.abs(actions)) < 1e-3


def test_actions_are_in_units_of_the_thrust_scale():
    env, _ = built(agents=2)
    env.reset(seed=3)
    one, two = (
        CentralizedPolicy(SpacecraftSettings(thrust_scale=scale), "paper", 2).predict(env.state())
        for scale in (1.0, 2.0)
    )
    assert np.max(one[0]) > 0.0
    assert one[0] == pytest.approx(2.0 * two[0], rel=1e-5)


def test_the_mass_of_the_task_is_planned_for():
    body = dataclasses.replace(SpacecraftSettings().system, mass=3.0)
    settings = SpacecraftSettings(system=body)
    env = spacecraft_v0.parallel_env(2, "open", settings=settings)
    policy = CentralizedPolicy(settings, "open", 2)
    env.reset(seed=3)
    actions, (memory,) = policy.predict(env.state())
    force = memory.plan.forces[:, 0]
    heading = env.scenario.headings
    wrench = np.stack(
        [
            np.cos(heading) * force[:, 0] - np.sin(heading) * force[:, 1],
            np.sin(heading) * force[:, 0] + np.cos(heading) * force[:, 1],
            np.zeros(2),
        ],
        axis=-1,
    )
    assert actions == pytest.approx(allocate(body, wrench), abs=1e-6)


def test_the_margin_follows_the_bound_and_the_rate():
    def asked(**arguments):
        return CentralizedPolicy(**arguments).planner.settings.margins[0]

    assert asked(disturbance_bound=0.8) == pytest.approx(expected_margin(0.8, 2.0))
    assert asked(disturbance_bound=0.8, contraction_rate=1.0) == pytest.approx(
        expected_margin(0.8, 1.0)
    )
    assert asked(disturbance_bound=0.0) == pytest.approx(0.05)
    assert asked(disturbance_bound=0.8, margin=0.1) == pytest.approx(0.1)
    planner = CentralizedPolicy(disturbance_bound=0.8).planner.settings
    assert planner.pair_share == pytest.approx(np.sqrt(2.0))
    assert list(planner.margins) == sorted(planner.margins, reverse=True)
    own = JointPlannerSettings(margins=(0.2,))
    assert CentralizedPolicy(planner=own).planner.settings is own


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"disturbance_bound": -0.1}, "disturbance_bound=-0.1"),
        ({"disturbance_bound": float("nan")}, "disturbance_bound=nan"),
        ({"contraction_rate": 0.0}, "contraction_rate=0.0"),
        ({"turning_rate": -1.0}, "turning_rate=-1.0"),
        ({"margin": -1.0}, "margin=-1.0"),
        ({"margin": 0.1, "planner": JointPlannerSettings()}, "not both"),
        ({"planner": JointPlannerSettings(mass=2.0)}, "mass=2.0"),
        ({"planner": JointPlannerSettings(control_period=0.05)}, "control_period=0.05"),
        ({"settings": SpacecraftSettings(horizon=20.2)}, "horizon=20.2"),
        ({"preset": "papers"}, "papers"),
        ({"num_agents": 0}, "num_agents=0"),
    ],
)
def test_bad_settings_get_a_clear_error(arguments, message):
    with pytest.raises(ValueError, match=message):
        CentralizedPolicy(**arguments)


def test_observations_of_something_else_get_a_clear_error():
    env, policy = built("open", agents=2)
    observations, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match=r"2 agents and up to 1 obstacles has 21 numbers"):
        policy.predict(observations["agent_0"])
    with pytest.raises(ValueError, match="build the policy with"):
        CentralizedPolicy(preset="open", num_agents=3).predict(env.state())
    with pytest.raises(ValueError, match="not finite"):
        policy.predict(np.full(21, np.nan, np.float32))
    with pytest.raises(ValueError, match="mask"):
        policy.predict(np.full(21, 0.5, np.float32))
    with pytest.raises(ValueError, match="shape"):
        policy.predict(env.state()[None, None])


def test_a_state_of_the_right_length_for_other_agents_is_refused():
    # Four agents and three obstacles fill as many numbers as three agents and five.
    preset = dataclasses.replace(PRESETS["paper"], obstacle_count=(3, 3))
    env = spacecraft_v0.parallel_env(4, preset)
    env.reset(seed=0)
    wide = dataclasses.replace(preset, obstacle_count=(0, 5))
    with pytest.raises(ValueError, match="mask is neither 0 nor 1"):
        CentralizedPolicy(preset=wide, num_agents=3).predict(env.state())


def test_memories_of_something_else_get_a_clear_error():
    env, policy = built("open", agents=2)
    env.reset(seed=0)
    state = env.state()
    _, memory = policy.predict(state)
    with pytest.raises(ValueError, match="remembers 2 worlds"):
        policy.predict(state, memory * 2)
    with pytest.raises(ValueError, match="episode_start is for 2"):
        policy.predict(state, memory, np.zeros(2, bool))
    env.reset(seed=1)
    with pytest.raises(ValueError, match="other starts or goals"):
        policy.predict(env.state(), memory)


def test_make_builds_it_for_the_spacecraft_and_names_what_there_is():
    env = spacecraft_v0.parallel_env(num_agents=2, preset="open")
    policy = lagros_policies.make("centralized", env, disturbance_bound=0.2)
    assert policy.observes == "global"
    assert policy.agents == 2
    env.reset(seed=0)
    action, _ = policy.predict(env.state())
    assert action.shape == (2, 8)
    with pytest.raises(ValueError, match="centralized"):
        lagros_policies.make("lqr", env)


@pytest.mark.parametrize(("far", "planned"), [(20.0, True), (1e3, False)])
def test_a_goal_far_away_is_answered_by_a_plan_of_bounded_size(far, planned):
    env, policy = built(agents=2)
    starts = np.array([[0.0, 0.0], [0.0, 2.0]])
    goals = starts + np.array([far, 0.0])
    scenario = Scenario(starts, np.zeros(2), goals, [[6.0, 1.0]], [0.5])
    env.reset(seed=0, options={"scenario": scenario})
    action, memory = policy.predict(env.state())
    assert np.isfinite(action).all()
    assert memory[0].solved is planned
    assert memory[0].plan.states.shape == (2, 61, 4)
    if not planned:
        # Out of reach in the time: one guess shows it, and agents hold their positions.
        assert memory[0].plan.attempts == 1
        assert "out of reach" in memory[0].plan.status
        assert action == pytest.approx(0.0, abs=1e-6)
