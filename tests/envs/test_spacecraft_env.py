"""The multi-agent environment through PettingZoo, and its single-agent form through Gymnasium."""

import dataclasses
import math
import os

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
)

import lagros_envs  # noqa: F401 - registers the ids
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Scenario
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

METRIC = np.diag([2.0, 2.0, 1.0, 3.0, 3.0, 1.0])
STILL = np.zeros(8, np.float32)


def parallel(agents=3, **settings):
    return spacecraft_v0.parallel_env(num_agents=agents, **settings)


def single(**settings):
    return gym.make("lagros/Spacecraft-v0", **settings).unwrapped


def actions_of(env, value=0.2):
    return dict.fromkeys(env.agents, np.full(8, value, np.float32))


# The checks of PettingZoo and Gymnasium. Warnings are errors in this suite.


@pytest.mark.parametrize("preset", PRESETS)
def test_pettingzoo_checks_the_parallel_environment_without_a_warning(preset):
    parallel_api_test(spacecraft_v0.parallel_env(preset=preset, disturbance="uniform"), 100)


def test_pettingzoo_checks_a_whole_episode_without_a_warning():
    parallel_api_test(parallel(2, disturbance="gust"), 1000)


# Positions and rates have no bound; the checkers warn so of their own environments, too.
UNBOUNDED = pytest.mark.filterwarnings("ignore:.*observation space.* value is -?infinity")


@UNBOUNDED
@pytest.mark.parametrize("agents", [1, 3])
def test_pettingzoo_checks_the_cycle_environment_without_another_warning(agents):
    api_test(spacecraft_v0.env(num_agents=agents, max_cycles=60), 200)


def test_pettingzoo_finds_the_same_episode_for_the_same_seed():
    parallel_seed_test(lambda: parallel(disturbance="uniform"), 60)
    seed_test(lambda: spacecraft_v0.env(num_agents=3, disturbance="uniform"), 60)


def test_pettingzoo_finds_the_number_of_cycles():
    max_cycles_test(spacecraft_v0)


def test_pettingzoo_finds_that_every_mode_draws(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(spacecraft_v0.env)


@UNBOUNDED
@pytest.mark.parametrize("preset", PRESETS)
def test_gymnasium_checks_the_single_environment_without_another_warning(preset):
    # Gymnasium ends an episode of this id after 45 s unless told otherwise; gcbf takes longer.
    steps = spacecraft_v0.parallel_env(preset=preset).unwrapped.settings.steps
    env = single(preset=preset, disturbance="uniform", max_episode_steps=steps)
    check_env(env, skip_render_check=True)


# Spaces and names.


def test_every_agent_has_spaces_of_its_own():
    env = parallel(6)
    assert env.possible_agents == [f"agent_{k}" for k in range(6)]
    assert len({id(env.action_space(agent)) for agent in env.possible_agents}) == 6
    for agent in env.possible_agents:
        assert env.action_space(agent) == spaces.Box(0.0, 1.0, (8,), np.float32)
        assert env.observation_space(agent) == spaces.flatten_space(env.named_space)
    observations, _ = env.reset(seed=0)
    assert observations.keys() == set(env.possible_agents)
    for agent, observation in observations.items():
        assert env.observation_space(agent).contains(observation)
    assert env.state_space.contains(env.state())
    assert env.state().shape == spaces.flatten_space(env.named_state_space).shape


def test_the_environment_of_the_issue_is_built_as_written():
    env = spacecraft_v0.parallel_env(
        num_agents=6, disturbance="uniform", disturbance_bound=0.4, preset="paper"
    )
    env.reset(seed=0)
    infos = env.step(actions_of(env))[4]
    assert all(0.0 < np.linalg.norm(info["disturbance"]) <= 0.4 for info in infos.values())
    assert spacecraft_v0.env().unwrapped.max_num_agents == 6
    assert str(env) == "spacecraft_v0"


def test_rows_belong_to_their_agents():
    env = parallel(3)
    env.reset(seed=1)
    actions = dict.fromkeys(env.agents, STILL)
    actions["agent_1"] = np.ones(8, np.float32) * [0, 0, 0, 0, 1, 1, 0, 0]
    observations, rewards, *_, infos = env.step(actions)
    assert [info["effort"] for info in infos.values()] == pytest.approx([0.0, 0.2, 0.0])
    assert rewards["agent_0"] == rewards["agent_2"] == 0.0 != rewards["agent_1"]
    parts = spaces.unflatten(env.named_space, observations["agent_1"])
    heading = env.scenario.headings[1]
    expected = 0.2 * np.array([math.cos(heading), -math.sin(heading)])
    np.testing.assert_allclose(parts["velocity"], expected, atol=1e-6)
    assert not spaces.unflatten(env.named_space, observations["agent_0"])["velocity"].any()


def test_infos_hold_python_numbers_and_their_own_arrays():
    env = parallel(2, disturbance="uniform")
    _, infos = env.reset(seed=0)
    kept = {agent: dict(info) for agent, info in infos.items()}
    pushes = {agent: info["disturbance"].copy() for agent, info in infos.items()}
    env.step(actions_of(env))
    for agent, info in kept.items():
        np.testing.assert_array_equal(info["disturbance"], pushes[agent])
        for name in ("success", "strict_success", "paper_success", "collided"):
            assert type(info[name]) is bool
        for name in ("success_time", "collision_time", "effort", "goal_distance", "tube_radius"):
            assert type(info[name]) is float
        assert info["success_time"] == info["collision_time"] == math.inf


# An episode.


def test_an_episode_ends_for_all_at_its_limit(caplog):
    env = parallel(2, preset="open", settings=SpacecraftSettings(time_limit=2.0))
    env.reset(seed=0)
    for step in range(20):
        assert env.agents == env.possible_agents
        _, _, terminated, truncated, _ = env.step(dict.fromkeys(env.agents, STILL))
        assert set(truncated.values()) == {step == 19}
        assert not any(terminated.values())
    assert env.time == pytest.approx(2.0)
    assert env.agents == []
    assert not caplog.records
    assert env.step({}) == ({}, {}, {}, {}, {})
    assert "step() called after all agents are terminated or truncated" in caplog.text
    env.reset(seed=0)
    assert env.num_agents == 2


def test_an_episode_ends_for_all_when_all_have_collided():
    env = parallel(2)
    scenario = Scenario([[0, 0], [0.6, 0.0]], [0.0, 0.0], [[3, 0], [-3, 0]], [], [])
    env.reset(seed=0, options={"scenario": scenario})
    towards = {"agent_0": [4, 5], "agent_1": [0, 1]}
    actions = {
        agent: np.isin(np.arange(8), fires).astype(np.float32) for agent, fires in towards.items()
    }
    for _ in range(10):
        _, rewards, terminated, _, infos = env.step(actions)
        if any(terminated.values()):
            break
    assert all(terminated.values())
    assert all(info["collided"] for info in infos.values())
    assert all(reward < -4.0 for reward in rewards.values())
    assert env.agents == []


def test_a_given_scenario_is_started():
    env = parallel(6)
    env.reset(seed=11)
    drawn = env.scenario
    for seed in (0, 5):
        env.reset(seed=seed, options={"scenario": drawn})
        np.testing.assert_array_equal(env.states[:, :2], drawn.starts)
        np.testing.assert_array_equal(env.states[:, 2], drawn.headings)
        assert not env.states[:, 3:].any()
        assert env.scenario is drawn


def test_a_scenario_read_from_a_file_gives_the_same_episode(tmp_path):
    seen = []
    env = parallel(4, disturbance="uniform")
    env.reset(seed=9)
    env.scenario.save(tmp_path / "task.json")
    for options in ({}, {"scenario": Scenario.load(tmp_path / "task.json")}):
        env.reset(seed=9, options=options)
        for _ in range(10):
            env.step(actions_of(env, 0.7))
        seen.append(env.state())
    np.testing.assert_array_equal(*seen)


def test_the_single_environment_is_the_parallel_one_with_one_agent():
    one = single(disturbance="uniform")
    other = parallel(1, disturbance="uniform")
    observation, info = one.reset(seed=5)
    observations, infos = other.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(60):
        np.testing.assert_array_equal(observation, observations["agent_0"])
        np.testing.assert_equal(info, infos["agent_0"])
        np.testing.assert_array_equal(one.state, other.states[0])
        action = rng.random(8, np.float32)
        observation, reward, terminated, truncated, info = one.step(action)
        observations, rewards, ends, limits, infos = other.step({"agent_0": action})
        assert (reward, terminated, truncated) == tuple(
            part["agent_0"] for part in (rewards, ends, limits)
        )
        if terminated:
            break


def test_a_single_spacecraft_ends_at_a_collision():
    env = single()
    scenario = Scenario([[0.0, 0.0]], [0.0], [[5.0, 0.0]], [[1.5, 0.0]], [0.5])
    env.reset(seed=0, options={"scenario": scenario})
    action = np.isin(np.arange(8), [4, 5]).astype(np.float32)
    for _ in range(30):
        _, reward, terminated, truncated, info = env.step(action)
        assert terminated is info["collided"]
        if terminated:
            break
    assert terminated
    assert not truncated
    assert reward < -4.0
    # 0.75 m at 2 m/s^2.
    assert info["collision_time"] == pytest.approx(0.9)


@pytest.mark.parametrize("kind", ["worst", "callable"])
def test_a_feedback_disturbance_sees_every_agent(kind):
    seen = []

    def push(now):
        seen.append(now)
        return now.state

    env = parallel(2, disturbance=push if kind == "callable" else kind, metric=METRIC)
    nominal = np.zeros((451, 2, 6))
    nominal[:, 1, 3] = 1.0
    env.reset(seed=0, options={"nominal": nominal})
    states = env.states
    infos = env.step(actions_of(env))[4]
    for index, info in enumerate(infos.values()):
        assert np.linalg.norm(info["disturbance"]) == pytest.approx(0.4)
        error = states[index] - nominal[0, index]
        gradient = METRIC @ error if kind == "worst" else states[index]
        cosine = info["disturbance"] @ gradient / np.linalg.norm(gradient)
        assert cosine == pytest.approx(0.4)
        expected = np.linalg.norm(env.states[index] - nominal[1, index])
        assert info["tracking_error"] == pytest.approx(expected)
    if seen:
        assert seen[0].state.shape == (1, 2, 6)
        assert seen[0].time.shape == (1, 2)


# Seeds.

EPISODES = """
import hashlib, numpy as np
from lagros_envs import spacecraft_v0
digest = hashlib.sha256()
for preset in ("paper", "crossing", "swarm"):
    env = spacecraft_v0.parallel_env(preset=preset, disturbance="gust")
    for seed in (0, 2**62):
        env.reset(seed=seed)
        for step in range(8):
            env.step({agent: np.full(8, 0.1 * step) for agent in env.agents})
            digest.update(env.state().tobytes())
    env.reset()
    digest.update(env.state().tobytes())
"""


def test_episodes_are_the_same_in_every_process(run_python):
    here = {}
    exec(EPISODES, here)
    for hash_seed in ("1", "2"):
        printed = run_python(
            EPISODES + "print(digest.hexdigest())",
            PYTHONHASHSEED=hash_seed,
            PATH=os.environ["PATH"],
        )
        assert printed.strip() == here["digest"].hexdigest()


def test_the_disturbance_does_not_change_the_scenario():
    starts = set()
    for kind in ("none", "uniform", "gust"):
        for bound in (0.1, 1.0):
            env = parallel(disturbance=kind, disturbance_bound=bound)
            env.reset(seed=3)
            starts.add(env.state().tobytes())
    assert len(starts) == 1


def test_without_a_seed_episodes_go_on_drawing():
    env = parallel()
    env.reset(seed=5)
    first = env.state()
    env.reset()
    second = env.state()
    assert not np.array_equal(first, second)
    env.reset(seed=5)
    np.testing.assert_array_equal(env.state(), first)
    env.reset()
    np.testing.assert_array_equal(env.state(), second)


# Refusals.


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"agent_1": np.zeros(7)}, ValueError, r"agent_1: the action has shape \(7,\).* \(8,\)"),
        ({"agent_1": np.full(8, np.nan)}, ValueError, "agent_1: the action is not finite"),
        ({"agent_1": np.full(8, np.inf)}, ValueError, "agent_1: the action is not finite"),
        ({"agent_1": ["a"] * 8}, ValueError, "agent_1: the action is .* must be numbers of shape"),
        ({"agent_1": None}, ValueError, "agent_1: the action is None; it must be numbers"),
        ({"agent_9": STILL}, ValueError, "no agent 'agent_9'; the agents are agent_0, agent_1"),
        ({"bob": STILL}, ValueError, "no agent 'bob'"),
    ],
)
def test_actions_that_make_no_sense_are_refused_and_change_nothing(change, error, message):
    env = parallel()
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(error, match=message):
        env.step({**actions_of(env), **change})
    np.testing.assert_array_equal(env.state(), before)


def test_an_agent_without_an_action_is_named():
    env = parallel()
    env.reset(seed=0)
    actions = actions_of(env)
    del actions["agent_2"]
    with pytest.raises(ValueError, match="the actions lack 'agent_2'"):
        env.step(actions)
    with pytest.raises(ValueError, match="there is no agent 'nobody'"):
        env.action_space("nobody")
    with pytest.raises(ValueError, match="there is no agent 'nobody'"):
        env.observation_space("nobody")


def test_the_single_environment_refuses_bad_actions():
    env = single()
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(STILL)
    env.reset(seed=0)
    for action in (np.zeros(4), np.full(8, np.nan), np.zeros((1, 8))):
        with pytest.raises(ValueError, match="the action"):
            env.step(action)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": {"starts": []}}, r"options\['scenario'\] has a dict; it must be"),
        ({"scenario": PRESETS["open"].sample(np.random.default_rng(0), 2)}, "has 2 agents"),
        ({"nominal": np.zeros((451, 6))}, r"shape \(451, 6\); .* \(451, 3, 6\)"),
        ({"nominal": np.full((451, 3, 6), np.nan)}, "finite"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        parallel().reset(seed=0, options=options)


def test_worst_without_a_plan_is_refused():
    with pytest.raises(ValueError, match=r'disturbance="worst" needs the nominal'):
        parallel(disturbance="worst", metric=METRIC).reset(seed=0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "papers"}, "preset='papers'"),
        ({"num_agents": 0}, "num_agents=0"),
        ({"disturbance": "storm"}, "disturbance='storm'"),
        ({"disturbance_bound": -1.0}, "disturbance_bound=-1.0"),
        ({"disturbance_channels": [True]}, "1 entries; the state has 6"),
        ({"render_mode": "ansi"}, "render_mode='ansi'"),
        ({"max_cycles": 0}, "max_cycles=0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        spacecraft_v0.parallel_env(**settings)


def test_step_and_render_before_reset_are_refused():
    with pytest.raises(RuntimeError, match="call reset"):
        parallel().step({})
    with pytest.raises(RuntimeError, match="call reset"):
        parallel(render_mode="rgb_array").render()


def test_importing_and_stepping_imports_no_heavy_library(run_python):
    printed = run_python(
        "import sys, numpy as np\n"
        "from lagros_envs import spacecraft_v0\n"
        "env = spacecraft_v0.parallel_env(disturbance='gust')\n"
        "env.reset(seed=0); env.step({agent: np.ones(8) for agent in env.agents})\n"
        "heavy = {'torch', 'pygame', 'scipy', 'cvxpy', 'matplotlib', 'stable_baselines3'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    assert printed == "[]\n"


@pytest.mark.parametrize("change", [{"agent_radius": 0.2}, {"core_radius": 0.1}])
def test_a_scenario_of_other_radii_than_the_presets_is_refused(change):
    # Observations do not tell the radii: who flies would keep the wrong distances.
    env = spacecraft_v0.parallel_env(2)
    env.reset(seed=0)
    (name,) = change
    other = dataclasses.replace(env.scenario, **change)
    with pytest.raises(ValueError, match=rf"{name}=.*preset has 0\.25"):
        env.reset(options={"scenario": other})
    worlds = SpacecraftVectorEnv(2, 2)
    with pytest.raises(ValueError, match=rf"{name}=.*preset has 0\.25"):
        worlds.reset(options={"scenarios": [other]})
    fitting = dataclasses.replace(
        PRESETS["paper"], agent_radius=other.agent_radius, core_radius=other.core
    )
    spacecraft_v0.parallel_env(2, fitting).reset(options={"scenario": other})
