"""One seed decides an episode: everywhere, whatever the policy does, and as one of many."""

import os

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.seeding import (
    EVALUATION,
    Streams,
    episode_seeds,
    episode_streams,
    seeded_streams,
)
from lagros_envs.tasks.cartpole.env import CartPoleEnv

seeds = st.integers(0, 2**63 - 1)

EPISODES = """
import gymnasium, hashlib, lagros_envs, numpy as np
from lagros_envs.seeding import EVALUATION, episode_seeds
digest = hashlib.sha256()
for kind in ("uniform", "sphere", "constant", "sinusoid", "gust"):
    env = gymnasium.make("lagros/CartPole-v0", disturbance=kind).unwrapped
    for seed in [0, 7, *episode_seeds(3, 4, EVALUATION)]:
        digest.update(env.reset(seed=seed)[0].tobytes())
        for step in range(12):
            observation, _, fallen, _, _ = env.step(np.array([0.1 * (-1) ** step]))
            digest.update(observation.tobytes() + env.state.tobytes())
            if fallen:
                break
    digest.update(env.reset()[0].tobytes())
envs = gymnasium.make_vec("lagros/CartPole-v0", num_envs=5, disturbance="gust").unwrapped
digest.update(envs.reset(seed=9)[0].tobytes())
for step in range(120):
    digest.update(envs.step(np.full((5, 1), 0.3))[0].tobytes())
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


def test_the_digest_above_tells_episodes_apart():
    changed = EPISODES.replace("[0, 7, *", "[0, 8, *")
    assert changed != EPISODES
    first, second = {}, {}
    exec(EPISODES, first)
    exec(changed, second)
    assert first["digest"].hexdigest() != second["digest"].hexdigest()


@given(seeds)
def test_the_streams_of_a_seed_repeat_and_differ(seed):
    first, second = episode_streams(seed), episode_streams(seed)
    assert isinstance(first, Streams)
    draws = [generator.random(8) for generator in first]
    for ours, theirs in zip(draws, second, strict=True):
        np.testing.assert_array_equal(ours, theirs.random(8))
    assert len(np.unique(np.concatenate(draws))) == 24


@pytest.mark.parametrize(("place", "stream"), [(0, "scenario"), (1, "disturbance"), (2, "policy")])
@given(st.lists(st.integers(0, 2**66), max_size=5), st.integers(0, 2**64 - 1))
def test_streams_of_many_episodes_are_those_of_each(place, stream, many, last):
    # Against NumPy's own way of splitting a seed, which the batch does not take.
    chosen = [*many, 0, 2**32, last]
    for seed, found in zip(chosen, seeded_streams(chosen, stream), strict=True):
        child = np.random.SeedSequence(seed).spawn(3)[place]
        expected = np.random.default_rng(child)
        assert found.bit_generator.state == expected.bit_generator.state
        np.testing.assert_array_equal(found.standard_normal(3), expected.standard_normal(3))
    assert list(seeded_streams([], stream)) == []


def test_what_one_stream_draws_does_not_move_another():
    untouched = episode_streams(4)
    used = episode_streams(4)
    used.policy.random(1000)
    used.scenario.random(17)
    np.testing.assert_array_equal(used.disturbance.random(5), untouched.disturbance.random(5))


# The episode goes on after a fall: what matters is what it meets.
@pytest.mark.filterwarnings("ignore:.*even though this environment has already")
@pytest.mark.parametrize("kind", sorted(OPEN_LOOP))
def test_no_policy_changes_what_an_episode_meets(kind):
    """Nor does any draw from the generators that a policy can reach."""
    met = []
    for policy in ("still", "wild"):
        env = CartPoleEnv(disturbance=kind)
        env.action_space.seed(0)
        observation, _ = env.reset(seed=21)
        pushes = []
        for _ in range(15):
            action = np.zeros(1)
            if policy == "wild":
                action = 0.1 * env.action_space.sample()
                env.np_random.random(3)
                np.random.default_rng().random()
            pushes.append(env.step(action)[4]["disturbance"].copy())
        met.append((observation, np.array(pushes)))
    np.testing.assert_array_equal(met[0][0], met[1][0])
    np.testing.assert_array_equal(met[0][1], met[1][1])


def test_the_kind_and_the_bound_do_not_change_the_scenario():
    scenarios = set()
    for kind in sorted(OPEN_LOOP):
        for bound in (0.0, 0.1, 0.75):
            env = CartPoleEnv(disturbance=kind, disturbance_bound=bound)
            scenarios.add(env.reset(seed=3)[0].tobytes())
    assert len(scenarios) == 1


def test_neighbouring_seeds_are_unrelated():
    draws = np.array([[stream.random() for stream in episode_streams(k)] for k in range(2000)])
    # Uniform, uncorrelated between streams and from one seed to the next.
    for column in draws.T:
        assert scipy.stats.kstest(column, "uniform").pvalue > 0.001
    together = np.hstack([draws[:-1], draws[1:]])
    correlation = np.corrcoef(together.T) - np.eye(6)
    assert np.max(np.abs(correlation)) < 4.5 / np.sqrt(2000)


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="seed=-1 must be a non-negative integer"):
        episode_streams(-1)


@given(seeds, st.integers(0, 50), st.integers(0, 50), st.sampled_from([None, EVALUATION]))
def test_a_longer_run_begins_with_a_shorter(seed, short, more, namespace):
    longer = episode_seeds(seed, short + more, namespace)
    assert episode_seeds(seed, short, namespace) == longer[:short]
    assert len(longer) == short + more
    assert all(isinstance(word, int) and 0 <= word < 2**63 for word in longer)


def test_runs_and_namespaces_share_no_episode():
    drawn = [
        word
        for seed in range(40)
        for namespace in (None, EVALUATION, 1)
        for word in episode_seeds(seed, 200, namespace)
    ]
    assert len(set(drawn)) == len(drawn)


def test_a_namespace_is_not_another_seed():
    """Entropy (seed, namespace) would be the seed + namespace * 2**32 of another run."""
    other = 5 + EVALUATION * 2**32
    assert not set(episode_seeds(5, 50, EVALUATION)) & set(episode_seeds(other, 50))
