"""The vectorised twin against the single environment, world by world."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import lagros_envs  # noqa: F401 - registers the ids
from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv

SEEDS = [11, 0, 2**62, 7, 123456789, 3]
WORLDS = len(SEEDS)
METRIC = np.array(
    [
        [2.0, 0.5, 0.3, 0.1],
        [0.5, 9.0, 0.2, 1.5],
        [0.3, 0.2, 1.0, 0.4],
        [0.1, 1.5, 0.4, 3.0],
    ]
)


def metric_of_state(state):
    return METRIC + state[..., 1, None, None] ** 2 * np.eye(4)


def push_of_state(now):
    return np.stack(
        [np.sin(now.time) + 0.0 * now.state[..., 0], *(-0.3 * np.moveaxis(now.state, -1, 0)[1:])],
        axis=-1,
    )


KINDS = [
    *[pytest.param({"disturbance": kind}, id=kind) for kind in sorted(OPEN_LOOP)],
    pytest.param({"disturbance": "worst", "metric": METRIC}, id="worst"),
    pytest.param({"disturbance": "worst", "metric": metric_of_state}, id="worst-of-state"),
    pytest.param({"disturbance": push_of_state}, id="callable"),
    pytest.param({"disturbance": "sphere", "disturbance_channels": "rates"}, id="rates"),
    pytest.param(
        {"disturbance": "uniform", "settings": CartPoleSettings(force_limit=12.0)}, id="limit"
    ),
]


def close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-10)


def vector(worlds=WORLDS, **settings):
    return gym.make_vec("lagros/CartPole-v0", num_envs=worlds, **settings)


class Mixed:
    """Holds the pole in the even worlds and pushes it over in the odd ones, sooner or later."""

    def __init__(self, hold):
        self.hold = hold

    def __call__(self, state, goal, world):
        force = 0.05 * (1 + world)
        return np.array([force]) if world % 2 else self.hold(state, goal)

    def batch(self, states, goals):
        parts = zip(states, goals, strict=True)
        return np.stack([self(state, goal, world) for world, (state, goal) in enumerate(parts)])


@pytest.fixture
def mixed(hold):
    return Mixed(hold)


# One world is one environment.


def test_make_vec_gives_the_vectorised_class():
    envs = vector(3, disturbance="uniform", disturbance_bound=0.2)
    assert isinstance(envs.unwrapped, CartPoleVectorEnv)
    assert envs.num_envs == 3
    assert envs.unwrapped.disturbance.bound == 0.2
    single = gym.make("lagros/CartPole-v0")
    assert envs.single_observation_space == single.observation_space
    assert envs.single_action_space == single.action_space
    assert envs.observation_space.shape == (3, 13)
    assert envs.action_space.shape == (3, 1)


@pytest.mark.parametrize("compiled", [False, None], ids=["plain", "as-it-comes"])
@pytest.mark.parametrize("change", KINDS)
def test_each_world_is_the_single_environment(change, compiled, mixed):
    """Observations, rewards, ends, infos and states, until the end of each world's episode."""
    change = {"disturbance_bound": 0.6, **change}
    nominals = 0.2 * np.cumsum(
        np.random.default_rng(5).standard_normal((WORLDS, 91, 4)) * 0.1, axis=1
    )
    envs = vector(autoreset_mode="disabled", compiled=compiled, **change).unwrapped
    observations, infos = envs.reset(seed=SEEDS, options={"nominal": nominals})
    singles = [CartPoleEnv(**change) for _ in SEEDS]
    for world, (env, seed) in enumerate(zip(singles, SEEDS, strict=True)):
        observation, info = env.reset(seed=seed, options={"nominal": nominals[world]})
        np.testing.assert_array_equal(observations[world], observation)
        same_info(infos, info, world)
    goals = np.stack([env.scenario.goal for env in singles])
    alive, falls = list(range(WORLDS)), 0
    for _ in range(90):
        result = envs.step(mixed.batch(envs.state, goals))
        for world in list(alive):
            env = singles[world]
            observation, reward, terminated, truncated, info = env.step(
                mixed(env.state, goals[world], world)
            )
            close(envs.state[world], env.state)
            np.testing.assert_allclose(result[0][world], observation, rtol=1e-6, atol=1e-7)
            close(result[1][world], reward)
            assert result[2][world] == terminated
            assert result[3][world] == truncated
            same_info(result[4], info, world)
            if terminated or truncated:
                falls += terminated
                alive.remove(world)
    assert not alive
    assert 0 < falls < WORLDS


def same_info(infos, info, world):
    assert infos.keys() == info.keys()
    for name, value in info.items():
        # inf before the first success
        np.testing.assert_allclose(
            infos[name][world], value, rtol=0.0, atol=1e-10, err_msg=f"{name} of world {world}"
        )


@pytest.mark.parametrize("kind", ["none", "uniform"])
def test_an_integer_seed_is_that_of_gymnasium(kind):
    envs = vector(4, disturbance=kind)
    sync = SyncVectorEnv([lambda: CartPoleEnv(disturbance=kind) for _ in range(4)])
    for seed in (5, np.int64(5), 2**63):
        np.testing.assert_array_equal(envs.reset(seed=seed)[0], sync.reset(seed=int(seed))[0])
    actions = np.full((4, 1), 0.1, np.float32)
    ours, theirs = envs.step(actions), sync.step(actions)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-6)
    np.testing.assert_array_equal(ours[4]["disturbance"], theirs[4]["disturbance"])
    with pytest.raises(ValueError, match="seed=-1"):
        envs.reset(seed=-1)


def test_a_seed_of_none_in_a_list_leaves_that_world_without():
    envs = vector(3)
    observations = [envs.reset(seed=[7, None, 9])[0] for _ in range(2)]
    np.testing.assert_array_equal(*observations)
    single = CartPoleEnv()
    np.testing.assert_array_equal(observations[0][2], single.reset(seed=9)[0])
    assert len(np.unique(observations[0][:, 1])) == 3


def test_without_a_seed_the_worlds_go_on_drawing():
    envs = vector(4)
    first, _ = envs.reset(seed=5)
    second, _ = envs.reset()
    assert not np.intersect1d(first[:, 1], second[:, 1]).size
    envs.reset(seed=5)
    np.testing.assert_array_equal(envs.reset()[0], second)


def test_a_thousand_worlds_step(hold):
    envs = vector(1024, disturbance="uniform").unwrapped
    observations, _ = envs.reset(seed=0)
    for _ in range(3):
        observations, rewards, *_ = envs.step(hold(envs.state, observations[:, 4:8]))
    assert envs.observation_space.contains(observations)
    assert rewards.shape == (1024,)


def test_a_force_too_large_to_integrate_is_a_fall_of_that_world_alone():
    envs = vector(3, autoreset_mode="disabled").unwrapped
    envs.reset(seed=0)
    before = envs.state
    observations, rewards, terminated, _, info = envs.step(np.array([[0.1], [1e25], [0.1]]))
    np.testing.assert_array_equal(terminated, [False, True, False])
    np.testing.assert_array_equal(info["fallen"], terminated)
    np.testing.assert_array_equal(envs.state[1], before[1])
    assert np.all(envs.state[[0, 2]] != before[[0, 2]])
    assert np.all(np.isfinite(rewards))
    assert envs.observation_space.contains(observations)


def test_what_a_step_returns_is_not_changed_by_the_next(mixed):
    envs = vector(disturbance="uniform", autoreset_mode="same_step").unwrapped
    observations, info = envs.reset(seed=SEEDS)
    goals = observations[:, 4:8].astype(float)
    kept = [(observations, info)]
    copies = [(observations.copy(), {name: value.copy() for name, value in info.items()})]
    for _ in range(20):
        observations, rewards, terminated, truncated, info = envs.step(
            mixed.batch(envs.state, goals)
        )
        info = {name: value for name, value in info.items() if "final" not in name}
        info |= {"reward": rewards, "terminated": terminated, "truncated": truncated}
        kept.append((observations, info))
        copies.append((observations.copy(), {name: value.copy() for name, value in info.items()}))
    for (observations, info), (expected, values) in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(observations, expected)
        for name, value in values.items():
            np.testing.assert_array_equal(info[name], value, err_msg=name)


# Autoreset, against Gymnasium's SyncVectorEnv over the single environment.


class Follower(CartPoleEnv):
    """A single environment that starts where, and is pushed as, a world of the vectorised one."""

    def __init__(self, envs, world):
        super().__init__(lambda now: self.push, disturbance_bound=0.5)
        self.envs, self.world, self.push = envs, world, np.zeros(4)

    def reset(self, *, seed=None, options=None):
        if seed is None:
            names = {"initial_state": self.envs.state, "goal": self.envs._goal.T}
            options = {name: values[self.world] for name, values in names.items()}
        return super().reset(seed=seed, options=options)


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
@pytest.mark.parametrize("kind", ["none", "uniform", "gust"])
def test_autoreset_is_that_of_gymnasium(mode, kind, mixed):
    envs = vector(disturbance=kind, disturbance_bound=0.5, autoreset_mode=mode).unwrapped
    sync = SyncVectorEnv(
        [lambda world=world: Follower(envs, world) for world in range(WORLDS)],
        autoreset_mode=AutoresetMode[mode.upper()],
    )
    assert envs.metadata["autoreset_mode"] == sync.metadata["autoreset_mode"]
    expected, _ = sync.reset(seed=SEEDS)
    observations, _ = envs.reset(seed=SEEDS)
    np.testing.assert_array_equal(observations, expected)
    restarts, late_ends = 0, 0
    for step in range(250):
        goals = envs._goal.T.copy()
        theirs = mixed.batch(np.stack([env.state for env in sync.envs]), goals)
        result = envs.step(mixed.batch(envs.state, goals))
        moved = result[4].get("final_info", result[4])["disturbance"]
        for env, push in zip(sync.envs, moved, strict=True):
            env.push = push
        wanted = sync.step(theirs)
        np.testing.assert_allclose(result[0], wanted[0], rtol=1e-6, atol=1e-7)
        for column in (1, 2, 3):
            close(result[column], wanted[column])
        close(envs.state, np.stack([env.state for env in sync.envs]))
        ended = wanted[2] | wanted[3]
        compare_infos(result[4], wanted[4], ended if mode == "same_step" else None)
        if mode == "same_step":
            assert ("final_obs" in result[4]) == ended.any()
        restarts += ended.sum()
        late_ends += ended.sum() if step > 100 else 0
    assert restarts > 10
    assert late_ends > 5


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
@pytest.mark.parametrize("kind", sorted(OPEN_LOOP))
def test_episodes_begun_by_autoreset_repeat_from_one_seed(mode, kind):
    def flight(seed):
        envs = vector(5, disturbance=kind, autoreset_mode=mode)
        rng = np.random.default_rng(0)
        found = [envs.reset(seed=seed)[0]]
        found += [envs.step(rng.uniform(-1.0, 1.0, (5, 1)))[0] for _ in range(40)]
        return np.stack(found)

    first = flight(3)
    np.testing.assert_array_equal(flight(3), first)
    starts = first[first[:, :, 12] == 0.0][5:]
    assert len(starts) > 10
    assert len(np.unique(starts[:, 1])) == len(starts)
    assert not np.intersect1d(starts[:, 1], flight(4)[:, :, 1]).size


def test_what_a_world_meets_does_not_depend_on_when_the_others_end():
    """Two bounds: other ends, other starts, and the same realisation, larger."""

    def pushes(bound, kind):
        envs = vector(8, disturbance=kind, disturbance_bound=bound, autoreset_mode="same_step")
        envs.reset()
        envs.reset(seed=[None] * 8)
        envs.unwrapped.np_random = np.random.default_rng(1)
        envs.reset()
        found, ends = [], []
        for _ in range(30):
            *_, info = envs.step(np.zeros((8, 1)))
            found.append(info.get("final_info", info)["disturbance"])
            ends.append(info.get("_final_info", np.zeros(8, bool)))
        return np.stack(found), np.stack(ends)

    for kind in ("uniform", "sphere"):
        (small, few), (large, many) = pushes(0.3, kind), pushes(2.4, kind)
        assert np.any(few != many)
        np.testing.assert_allclose(8.0 * small, large, rtol=1e-12)


def compare_infos(infos, wanted, ended):
    final = {"final_obs", "_final_obs", "final_info", "_final_info"}
    masks = {name for name in wanted if name.startswith("_")}
    assert infos.keys() - final == wanted.keys() - masks - final
    for name in infos.keys() - final:
        np.testing.assert_allclose(infos[name], wanted[name], rtol=0, atol=1e-10, err_msg=name)
    if ended is None or not ended.any():
        return
    for name in ("_final_obs", "_final_info"):
        np.testing.assert_array_equal(infos[name], wanted[name])
        np.testing.assert_array_equal(infos[name], ended)
    for world in np.flatnonzero(ended):
        np.testing.assert_allclose(
            infos["final_obs"][world], wanted["final_obs"][world], rtol=1e-6, atol=1e-7
        )
        for name, values in infos["final_info"].items():
            np.testing.assert_allclose(
                values[world], wanted["final_info"][name][world], rtol=0, atol=1e-10, err_msg=name
            )


def test_disabled_autoreset_and_masked_resets_are_those_of_gymnasium(mixed):
    change = {"disturbance": "gust", "disturbance_bound": 0.5}
    sync = SyncVectorEnv(
        [lambda: CartPoleEnv(**change) for _ in SEEDS], autoreset_mode=AutoresetMode.DISABLED
    )
    envs = vector(autoreset_mode="disabled", **change).unwrapped
    sync.reset(seed=SEEDS)
    envs.reset(seed=SEEDS)
    fresh = iter(episode_seeds(1, 1000))
    resets = 0
    for _ in range(200):
        states = np.stack([env.state for env in sync.envs])
        goals = np.stack([env.scenario.goal for env in sync.envs])
        wanted = sync.step(mixed.batch(states, goals))
        result = envs.step(mixed.batch(envs.state, goals))
        np.testing.assert_allclose(result[0], wanted[0], rtol=1e-6, atol=1e-7)
        for column in (1, 2, 3):
            close(result[column], wanted[column])
        compare_infos(result[4], wanted[4], None)
        ended = wanted[2] | wanted[3]
        if ended.any():
            resets += 1
            seeds = [next(fresh) for _ in SEEDS]
            wanted, _ = sync.reset(seed=seeds, options={"reset_mask": ended.copy()})
            observations, info = envs.reset(seed=seeds, options={"reset_mask": ended})
            np.testing.assert_allclose(observations, wanted, rtol=1e-6, atol=1e-7)
            assert np.all(info["effort"][ended] == 0.0)
            assert np.all(info["effort"][~ended] > 0.0)
    assert resets > 5


def test_a_masked_reset_leaves_the_other_worlds_alone(hold):
    envs = vector(4, disturbance="uniform", autoreset_mode="disabled").unwrapped
    plain = vector(4, disturbance="uniform", autoreset_mode="disabled").unwrapped
    goals = np.zeros((4, 4))
    for env in (envs, plain):
        env.reset(seed=[1, 2, 3, 4])
        for _ in range(5):
            env.step(hold(env.state, goals))
    mask = np.array([False, True, False, True])
    observations, info = envs.reset(seed=[91, 92, 93, 94], options={"reset_mask": mask})
    np.testing.assert_allclose(observations[:, 12], [0.5, 0.0, 0.5, 0.0])
    np.testing.assert_array_equal(info["effort"] == 0.0, mask)
    for _ in range(5):
        result = envs.step(hold(envs.state, goals))
        expected = plain.step(hold(plain.state, goals))
        for ours, theirs in zip(result[:4], expected[:4], strict=True):
            np.testing.assert_array_equal(ours[~mask], theirs[~mask])
        np.testing.assert_allclose(result[0][:, 12] + 0.5 * mask, expected[0][:, 12], rtol=1e-6)
    single = CartPoleEnv(disturbance="uniform")
    single.reset(seed=94)
    for _ in range(5):
        single.step(hold(single.state, goals[3]))
    close(envs.state[3], single.state)


def test_a_masked_reset_takes_nothing_for_the_other_worlds():
    envs = vector(3, autoreset_mode="disabled").unwrapped
    envs.reset(seed=0)
    mask = np.array([True, False, False])
    nominal = np.ones((3, 91, 4))
    nominal[~mask] = np.nan
    _, info = envs.reset(options={"reset_mask": mask, "nominal": nominal})
    np.testing.assert_array_equal(np.isnan(info["tracking_error"]), ~mask)
    nominal[~mask] = 5.0
    _, info = envs.reset(options={"reset_mask": mask, "nominal": nominal})
    np.testing.assert_array_equal(np.isnan(info["tracking_error"]), ~mask)
    nominal[mask, 4] = np.inf
    with pytest.raises(ValueError, match="must be finite"):
        envs.reset(options={"reset_mask": mask, "nominal": nominal})


def test_the_worst_push_needs_a_nominal_for_every_new_episode():
    envs = vector(2, disturbance="worst", metric=METRIC, autoreset_mode="disabled").unwrapped
    envs.reset(seed=0, options={"nominal": np.zeros((2, 91, 4))})
    with pytest.raises(ValueError, match="nominal"):
        envs.reset(options={"reset_mask": np.array([True, False])})


def test_a_masked_reset_keeps_the_nominals_of_the_other_worlds():
    envs = vector(3, autoreset_mode="disabled").unwrapped
    envs.reset(seed=0, options={"nominal": np.ones((3, 91, 4))})
    mask = np.array([True, False, False])
    envs.reset(options={"reset_mask": mask, "nominal": np.full((3, 91, 4), 2.0)})
    np.testing.assert_array_equal(envs.nominal[:, 0, 0], [2.0, 1.0, 1.0])
    # Nobody has planned the new episode of the second world.
    mask = np.array([False, True, False])
    _, info = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(envs.nominal[:, 0, 0], [2.0, np.nan, 1.0])
    np.testing.assert_array_equal(np.isnan(info["tracking_error"]), mask)
    envs.reset(seed=0)
    assert envs.nominal is None


def test_autoreset_after_a_list_of_seeds_repeats(hold):
    settings = CartPoleSettings(time_limit=0.3)
    seen = []
    for _ in range(2):
        envs = vector(3, settings=settings, disturbance="uniform").unwrapped
        observations = [envs.reset(seed=[4, 5, 6])[0]]
        observations += [envs.step(hold(envs.state, np.zeros(4)))[0] for _ in range(10)]
        seen.append(np.array(observations))
    np.testing.assert_array_equal(seen[0], seen[1])
    # 0.3 s and the restart: four calls an episode, each with a start of its own.
    np.testing.assert_allclose(seen[0][:, 0, 12], [0, 0.1, 0.2, 0.3, 0, 0.1, 0.2, 0.3, 0, 0.1, 0.2])
    assert len(np.unique(seen[0][[0, 4, 8]][:, :, 9])) == 9


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
def test_the_autoreset_mode_may_be_a_name_or_gymnasiums_own(mode):
    expected = AutoresetMode[mode.upper()]
    for given in (mode, expected):
        assert vector(2, autoreset_mode=given).metadata["autoreset_mode"] is expected


# Options.


def test_options_set_starts_goals_and_nominals():
    rng = np.random.default_rng(0)
    starts, goals = rng.uniform(-1.0, 1.0, (2, 3, 4))
    nominals = rng.standard_normal((3, 91, 4))
    envs = vector(3)
    observations, info = envs.reset(
        seed=1, options={"initial_state": starts, "goal": goals, "nominal": nominals}
    )
    np.testing.assert_allclose(observations[:, :4], starts, rtol=1e-6)
    np.testing.assert_allclose(observations[:, 4:8], goals, rtol=1e-6)
    expected = [
        math.dist(start, nominal[0]) for start, nominal in zip(starts, nominals, strict=True)
    ]
    np.testing.assert_allclose(info["tracking_error"], expected)
    observations, _ = envs.reset(seed=1, options={"goal": [1.0, 2.0, 3.0]})
    np.testing.assert_array_equal(observations[:, 4], [1.0, 2.0, 3.0])


# Errors.


def test_step_before_reset_is_refused():
    with pytest.raises(RuntimeError, match="call reset"):
        CartPoleVectorEnv(2).step(np.zeros((2, 1)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 0}, "num_envs=0 must be a whole number"),
        ({"render_mode": "rgb_array"}, "does not draw"),
        ({"autoreset_mode": "later"}, "autoreset_mode='later' must be one of next_step"),
        ({"disturbance": "worst"}, "metric"),
        ({"disturbance_channels": [True]}, "1 entries"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        CartPoleVectorEnv(**settings)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros(3), r"shape \(3,\); it must be numbers of shape \(3, 1\)"),
        (np.zeros((2, 1)), r"shape \(2, 1\)"),
        (np.array([[0.0], [np.nan], [np.inf]]), r"not finite in the rows \[1, 2\]"),
    ],
)
def test_actions_that_make_no_sense_are_refused(actions, message):
    envs = vector(3).unwrapped
    envs.reset(seed=0)
    before = envs.state
    with pytest.raises(ValueError, match=message):
        envs.step(actions)
    np.testing.assert_array_equal(envs.state, before)


@pytest.mark.parametrize(
    ("reset", "message"),
    [
        ({"seed": [1, 2]}, "3 non-negative integers"),
        ({"seed": [1, 2, -3]}, "seed=-3 must be a non-negative integer"),
        ({"options": {"reset_mask": np.ones(2, bool)}}, "must be 3 booleans"),
        ({"options": {"reset_mask": np.ones(3)}}, "must be 3 booleans"),
        ({"options": {"reset_mask": np.array([True, False, True])}}, "first reset"),
        ({"options": {"nominal": np.zeros((91, 4))}}, r"\(3, 91, 4\)"),
        ({"options": {"goal": 1.0}}, r"\(3, 4\) or \(3,\)"),
        ({"options": {"goal": np.zeros((4, 4))}}, r"\(3, 4\) or \(3,\)"),
        ({"options": {"initial_state": np.zeros(4)}}, r"\(3, 4\)"),
        ({"options": {"initial_state": np.full((3, 4), 2.0)}}, "already fallen"),
    ],
)
def test_resets_that_make_no_sense_are_refused(reset, message):
    with pytest.raises(ValueError, match=message):
        CartPoleVectorEnv(3).reset(**reset)


def test_worst_without_nominals_says_what_to_pass():
    envs = CartPoleVectorEnv(2, disturbance="worst", metric=METRIC)
    with pytest.raises(ValueError, match=r"options=\{\"nominal\".*num_envs, steps \+ 1, 4"):
        envs.reset(seed=0)


def test_gymnasiums_wrappers_for_vector_environments_run(hold):
    envs = gym.wrappers.vector.RecordEpisodeStatistics(
        vector(4, settings=CartPoleSettings(time_limit=0.5))
    )
    envs.reset(seed=0)
    total = np.zeros(4)
    for _ in range(5):
        _, rewards, _, truncated, info = envs.step(hold(envs.unwrapped.state, np.zeros(4)))
        total += rewards
    assert truncated.all()
    np.testing.assert_allclose(info["episode"]["r"], total)


def test_an_autoreset_forgets_the_nominal_of_the_last_episode():
    env = CartPoleVectorEnv(num_envs=2, autoreset_mode="next_step")
    nominal = np.zeros((2, env.settings.steps + 1, 4))
    env.reset(seed=[3, 4], options={"nominal": nominal})
    still = np.zeros((2, 1), np.float32)
    ended = np.zeros(2, bool)
    while not ended.any():
        _, _, terminated, truncated, info = env.step(still)
        assert np.all(np.isfinite(info["tracking_error"]))
        ended = terminated | truncated
    _, _, _, _, info = env.step(still)
    assert np.all(np.isnan(info["tracking_error"]) == ended)


def test_worst_says_that_an_autoreset_has_no_nominal():
    env = CartPoleVectorEnv(num_envs=1, disturbance="worst", metric=np.eye(4))
    env.reset(seed=0, options={"nominal": np.zeros((1, env.settings.steps + 1, 4))})
    still = np.zeros((1, 1), np.float32)
    ended = False
    while not ended:
        _, _, terminated, truncated, _ = env.step(still)
        ended = bool(terminated[0] or truncated[0])
    with pytest.raises(ValueError, match="autoreset_mode"):
        env.step(still)


@pytest.mark.filterwarnings("ignore:.*even though this environment has already")
def test_whoever_goes_on_past_the_time_limit_still_has_the_tube():
    """Every world, alone or among others, at any time and each at its own."""
    envs = gym.make_vec("lagros/CartPole-v0", num_envs=2, autoreset_mode="disabled")
    env = gym.make("lagros/CartPole-v0").unwrapped
    start = {"initial_state": np.zeros((2, 4)), "goal": np.zeros(2)}
    envs.reset(seed=0, options=start)
    env.reset(seed=0, options={name: value[0] for name, value in start.items()})
    tube, period = env.settings.tube, env.settings.control_period
    for step in range(1, 95):
        if step == 10:
            envs.reset(options={**start, "reset_mask": np.array([False, True])})
        _, _, _, truncated, info = envs.step(np.zeros((2, 1), np.float32))
        times = period * np.array([step, step if step < 10 else step - 9])
        np.testing.assert_allclose(info["tube_radius"], tube.radius(times), rtol=1e-12)
        np.testing.assert_array_equal(truncated, times > 9.0 - 1e-9)
        _, _, _, _, alone = env.step(np.zeros(1, np.float32))
        assert alone["tube_radius"] == pytest.approx(tube.radius(float(times[0])), rel=1e-12)
