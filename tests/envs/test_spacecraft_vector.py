"""Many worlds as one vector environment, against the environment of one world."""

from contextlib import nullcontext

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs  # noqa: F401 - registers the ids
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

SHORT = SpacecraftSettings(time_limit=1.0)
METRIC = np.diag([2.0, 2.0, 1.0, 3.0, 3.0, 1.0])


def vector(worlds=4, agents=3, **settings):
    return gym.make_vec(
        "lagros/Spacecraft-v0", num_envs=worlds * agents, num_agents=agents, **settings
    ).unwrapped


def noise(envs, seed=0):
    rng = np.random.default_rng(seed)
    while True:
        yield rng.random((envs.num_envs, 8), np.float32)


def test_make_vec_gives_rows_for_agents():
    envs = vector(4, 3, disturbance="uniform", disturbance_bound=0.2)
    assert isinstance(envs, SpacecraftVectorEnv)
    assert (envs.num_envs, envs.num_worlds, envs.num_agents) == (12, 4, 3)
    assert envs.disturbance.bound == 0.2
    one = spacecraft_v0.parallel_env(num_agents=3)
    assert envs.single_observation_space == one.observation_space("agent_0")
    assert envs.single_action_space == one.action_space("agent_0")
    plain = gym.make_vec("lagros/Spacecraft-v0", num_envs=5)
    single = gym.make("lagros/Spacecraft-v0")
    assert plain.unwrapped.num_worlds == 5
    assert plain.single_observation_space == single.observation_space


@pytest.mark.parametrize("compiled", [False, None], ids=["plain", "as-it-comes"])
@pytest.mark.parametrize("agents", [1, 3])
def test_each_world_is_the_parallel_environment(agents, compiled):
    seeds = [11, 0, 2**62, 7]
    envs = vector(4, agents, disturbance="uniform", autoreset_mode="disabled", compiled=compiled)
    observations, infos = envs.reset(seed=seeds)
    singles = [spacecraft_v0.parallel_env(num_agents=agents, disturbance="uniform") for _ in seeds]
    results = [env.reset(seed=seed) for env, seed in zip(singles, seeds, strict=True)]
    for world, (seen, info) in enumerate(results):
        compare(world, agents, (observations, infos), (seen, info))
        np.testing.assert_array_equal(envs.state()[world], singles[world].state())
    actions = noise(envs)
    for _ in range(100):
        action = next(actions)
        result = envs.step(action)
        for world, env in enumerate(singles):
            if not env.agents:
                continue
            rows = action[world * agents : (world + 1) * agents]
            parts = env.step(dict(zip(env.agents, rows, strict=True)))
            compare(world, agents, (result[0], result[4]), (parts[0], parts[4]))
            for ours, theirs in zip(result[1:4], parts[1:4], strict=True):
                expected = list(theirs.values())
                block = ours[world * agents : (world + 1) * agents]
                np.testing.assert_allclose(block, expected, rtol=0, atol=1e-10)


def compare(world, agents, ours, theirs):
    for agent in range(agents):
        row, name = world * agents + agent, f"agent_{agent}"
        np.testing.assert_allclose(ours[0][row], theirs[0][name], rtol=1e-6, atol=1e-6)
        assert ours[1].keys() == theirs[1][name].keys()
        for key, value in theirs[1][name].items():
            np.testing.assert_allclose(
                ours[1][key][row], value, rtol=0, atol=1e-10, err_msg=f"{key} of {name}"
            )


def test_an_integer_seed_is_that_of_gymnasium_world_by_world():
    envs = vector(16, 2, disturbance="uniform")
    first, _ = envs.reset(seed=5)
    np.testing.assert_array_equal(envs.reset(seed=list(range(5, 21)))[0], first)
    single = spacecraft_v0.parallel_env(num_agents=2, disturbance="uniform")
    observations, _ = single.reset(seed=7)
    np.testing.assert_array_equal(first[4:6], np.stack(list(observations.values())))
    assert len(np.unique(first[:, 0])) == 32
    assert not np.intersect1d(envs.reset()[0][:, 0], first[:, 0]).size


def test_a_world_that_starts_anew_is_brought_nothing_by_the_step():
    envs = vector(3, 2, settings=SHORT, disturbance="uniform")
    envs.reset(seed=0)
    strong = np.ones((6, 8), np.float32)
    while not envs.step(strong)[3].any():
        pass
    _, reward, terminated, truncated, info = envs.step(strong)
    assert not any(part.any() for part in (reward, terminated, truncated))
    for name in ("effort", "effort_to_success", "disturbance", "collided", "tube_radius"):
        assert not info[name].any(), name
    assert np.all(envs.step(strong)[4]["effort"] > 0.0)


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_worlds_start_anew_as_the_mode_says(mode):
    envs = vector(3, 2, settings=SHORT, autoreset_mode=mode)
    envs.reset(seed=0)
    actions = noise(envs)
    for _ in range(9):
        assert not envs.step(next(actions))[3].any()
    first = envs.scenarios
    observations, _, _, truncated, info = envs.step(next(actions))
    assert truncated.all()
    if mode == "same_step":
        assert all(new is not old for new, old in zip(envs.scenarios, first, strict=True))
        assert info["_final_obs"].all()
        assert not np.array_equal(info["final_obs"], observations)
        assert np.all(info["final_info"]["effort"] > 0.0)
        assert not info["effort"].any()
    else:
        assert envs.scenarios == first
        assert np.all(info["effort"] > 0.0)
    warned = pytest.warns(UserWarning, match="You should always call 'reset")
    with warned if mode == "disabled" else nullcontext():
        _, rewards, _, truncated, info = envs.step(next(actions))
    if mode == "next_step":
        assert all(new is not old for new, old in zip(envs.scenarios, first, strict=True))
        assert not rewards.any()
        assert not info["effort"].any()
        assert not truncated.any()
        assert np.any(envs.step(next(actions))[1])
    if mode == "disabled":
        assert truncated.all()
        assert envs.scenarios == first


def test_a_world_restarts_while_others_go_on():
    envs = vector(3, 2, settings=SHORT, autoreset_mode="next_step")
    envs.reset(seed=0)
    actions = noise(envs)
    for _ in range(4):
        envs.step(next(actions))
    mask = np.array([False, True, False])
    before = envs.states
    envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(envs.states[~mask], before[~mask])
    assert not envs.states[1, :, 3:].any()
    for _ in range(6):
        truncated = envs.step(next(actions))[3]
    np.testing.assert_array_equal(truncated, np.repeat(~mask, 2))
    before = envs.states
    _, rewards, _, _, info = envs.step(next(actions))
    np.testing.assert_array_equal(rewards != 0.0, np.repeat(mask, 2))
    np.testing.assert_array_equal(info["effort"] > 0.0, np.repeat(mask, 2))


def test_a_world_that_was_reset_after_its_end_is_not_reset_again():
    envs = vector(2, 2, settings=SHORT, autoreset_mode="next_step")
    envs.reset(seed=0)
    actions = noise(envs)
    for _ in range(10):
        envs.step(next(actions))
    envs.reset(options={"reset_mask": np.array([True, False])})
    _, rewards, _, _, info = envs.step(next(actions))
    np.testing.assert_array_equal(rewards != 0.0, [True, True, False, False])
    np.testing.assert_array_equal(info["effort"] > 0.0, [True, True, False, False])


def test_runs_with_autoreset_repeat():
    digests = []
    for _ in range(2):
        envs = vector(3, 2, settings=SHORT, disturbance="uniform")
        envs.reset(seed=[4, 5, 6])
        actions = noise(envs)
        digests.append(b"".join(envs.step(next(actions))[0].tobytes() for _ in range(35)))
    assert digests[0] == digests[1]


def test_what_a_step_returns_is_not_changed_by_the_next():
    envs = vector(disturbance="uniform", settings=SHORT, autoreset_mode="same_step")
    envs.reset(seed=0)
    kept, copies = [], []
    actions = noise(envs)
    for _ in range(25):
        result = envs.step(next(actions))
        arrays = [*result[:4], *(v for v in result[4].values() if isinstance(v, np.ndarray))]
        kept += arrays
        copies += [array.copy() for array in arrays]
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_given_scenarios_are_started_in_their_worlds():
    envs = vector(3, 2)
    envs.reset(seed=1)
    given = envs.scenarios
    envs.reset(seed=2, options={"scenarios": [given[2], None, given[0]]})
    assert envs.scenarios[0] is given[2]
    assert envs.scenarios[2] is given[0]
    assert envs.scenarios[1] is not given[1]
    np.testing.assert_array_equal(envs.states[0, :, :2], given[2].starts)


def test_worst_needs_plans_for_every_episode():
    envs = vector(2, 2, disturbance="worst", metric=METRIC, settings=SHORT)
    with pytest.raises(ValueError, match=r'"worst" needs the nominal'):
        envs.reset(seed=0)
    nominal = np.zeros((2, 11, 2, 6))
    envs.reset(seed=0, options={"nominal": nominal})
    actions = noise(envs)
    for _ in range(10):
        info = envs.step(next(actions))[4]
        np.testing.assert_allclose(np.linalg.norm(info["disturbance"], axis=-1), 0.4)
    with pytest.raises(ValueError, match="an autoreset starts one without"):
        envs.step(next(actions))


def test_a_nominal_of_an_ended_episode_is_not_used_for_the_next():
    envs = vector(2, 2, disturbance="uniform", settings=SHORT)
    nominal = np.zeros((2, 11, 2, 6))
    _, info = envs.reset(seed=0, options={"nominal": nominal})
    assert np.all(np.isfinite(info["tracking_error"]))
    actions = noise(envs)
    for _ in range(11):
        info = envs.step(next(actions))[4]
    assert np.all(np.isnan(info["tracking_error"]))
    assert not nominal.any()


def test_a_masked_reset_without_a_nominal_forgets_that_of_the_episode_before():
    envs = vector(2, 2, disturbance="uniform", settings=SHORT, autoreset_mode="disabled")
    envs.reset(seed=0, options={"nominal": np.zeros((2, 11, 2, 6))})
    _, info = envs.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(np.isnan(info["tracking_error"]), [True, True, False, False])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 7, "num_agents": 3}, "num_envs=7 must be a positive multiple"),
        ({"num_envs": 0}, "num_envs=0"),
        ({"num_agents": 0}, "num_agents=0"),
        ({"render_mode": "human"}, "does not draw"),
        ({"autoreset_mode": "later"}, "autoreset_mode='later'"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        SpacecraftVectorEnv(**settings)


def test_actions_seeds_and_options_that_make_no_sense_are_refused():
    envs = vector(2, 2)
    with pytest.raises(RuntimeError, match="call reset"):
        envs.step(np.zeros((4, 8)))
    with pytest.raises(ValueError, match="first reset must start every world"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ValueError, match="2 non-negative integers, one per world"):
        envs.reset(seed=[1, 2, 3, 4])
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(2, 8\).*\(4, 8\)"):
        envs.step(np.zeros((2, 8)))
    bad = np.zeros((4, 8))
    bad[2, 3] = np.nan
    with pytest.raises(ValueError, match=r"not finite in the rows \[2\]"):
        envs.step(bad)
    for options, message in (
        ({"reset_mask": np.ones(4, bool)}, "2 booleans, one per world"),
        ({"scenarios": [None]}, "must have 2 entries"),
        ({"scenarios": [None, "file.json"]}, "has a str"),
        ({"nominal": np.zeros((2, 451, 6))}, r"\(2, 451, 2, 6\)"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.reset(options=options)


def test_a_reset_of_no_world_changes_nothing():
    envs = vector(3, 2, disturbance="uniform")
    before, _ = envs.reset(seed=0)
    after, _ = envs.reset(seed=1, options={"reset_mask": np.zeros(3, bool)})
    np.testing.assert_array_equal(after, before)
