"""Disturbances drawn step by step have the laws of those drawn in advance."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import ks_2samp

import lagros_envs  # noqa: F401 - registers the ids
from lagros_envs.disturbances import OPEN_LOOP, Disturbance
from lagros_envs.stepwise import StepwiseDisturbance

PERIOD = 0.1
STEPS = 30
RATES = (False, False, True, True)
MASKS = {"all": (True,) * 4, "rates": RATES, "three": (True, True, True, False), "one": RATES[1:3]}


def in_advance(disturbance, worlds, seed=1):
    """Realisations (steps, n, worlds), as episodes with seeds have them."""
    pushes = np.empty((worlds, STEPS, len(disturbance.channels)))
    disturbance.realise_all(map(np.random.default_rng, range(seed, seed + worlds)), pushes, PERIOD)
    return np.moveaxis(pushes, 0, -1)


def stepwise(disturbance, worlds, seed=0):
    rng = np.random.default_rng(seed)
    drawn = StepwiseDisturbance(disturbance, worlds, PERIOD)
    drawn.begin(np.arange(worlds), rng)
    return np.stack([drawn.step(np.full(worlds, step), rng) for step in range(STEPS)])


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("kind", sorted(set(OPEN_LOOP) - {"none"}))
def test_the_law_is_that_of_a_realisation(kind, mask):
    """Norms, single coordinates, their products, and what lies some steps apart."""
    disturbance = Disturbance(kind, 0.75, MASKS[mask])
    ours, theirs = stepwise(disturbance, 3000), in_advance(disturbance, 3000)
    last = int(np.flatnonzero(MASKS[mask])[-1])
    first = int(np.flatnonzero(MASKS[mask])[0])
    looks = {
        "norm": lambda d: np.linalg.norm(d[7], axis=0),
        "coordinate": lambda d: d[7, last],
        "at the start": lambda d: d[0, first],
        "product": lambda d: d[7, first] * d[7, last],
        "one step apart": lambda d: np.sum(d[7] * d[8], axis=0),
        "far apart": lambda d: np.sum(d[2] * d[25], axis=0),
        "difference": lambda d: np.linalg.norm(d[20] - d[19], axis=0),
    }
    for name, look in looks.items():
        # Rounding must not tell apart what takes few values.
        one, other = look(ours).round(9), look(theirs).round(9)
        if np.ptp(other) < 1e-9:
            # The norm of a direction.
            np.testing.assert_allclose(one, other, atol=1e-12, err_msg=name)
        else:
            assert ks_2samp(one, other, method="asymp").pvalue > 1e-4, name
    assert not np.any(ours[:, ~np.array(MASKS[mask])])


@pytest.mark.parametrize("worlds", [1, 3, 200])
@pytest.mark.parametrize("kind", sorted(set(OPEN_LOOP) - {"none"}))
def test_no_push_exceeds_the_bound_and_a_larger_bound_scales_it(kind, worlds):
    small, large = (
        stepwise(Disturbance(kind, bound, MASKS["all"]), worlds) for bound in (0.3, 1.2)
    )
    assert np.all(np.linalg.norm(small, axis=1) <= 0.3)
    np.testing.assert_allclose(4.0 * small, large, rtol=1e-12)
    other = stepwise(Disturbance(kind, 0.3, MASKS["all"]), worlds, seed=1)
    assert not np.array_equal(small, other)
    if worlds > 1:
        assert not np.array_equal(small[..., 0], small[..., 1])


def test_a_feedback_kind_draws_one_direction_an_episode():
    found = stepwise(Disturbance(lambda now: now.state, 0.3, MASKS["all"]), 50)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-12)
    assert np.ptp(found, axis=0).max() == 0.0


def test_another_generator_starts_anew_and_what_was_begun_stays():
    disturbance = Disturbance("uniform", 0.3, MASKS["all"])
    drawn = StepwiseDisturbance(disturbance, 2, PERIOD)
    rngs = [np.random.default_rng(seed) for seed in (1, 2, 1)]
    first, second, third = (drawn.step(0, rng) for rng in rngs)
    np.testing.assert_array_equal(first, third)
    assert not np.array_equal(first, second)
    constant = StepwiseDisturbance(Disturbance("constant", 0.3, MASKS["all"]), 2, PERIOD)
    constant.begin(np.arange(2), rngs[0])
    np.testing.assert_array_equal(constant.step(0, rngs[0]), constant.step(1, rngs[1]))


@pytest.mark.parametrize("kind", sorted(OPEN_LOOP))
def test_copies_go_on_alike_after_episodes_without_a_seed(kind):
    envs = gym.make_vec("lagros/CartPole-v0", num_envs=5, disturbance=kind, compiled=False)
    one = gym.make("lagros/CartPole-v0", disturbance=kind)
    rng = np.random.default_rng(0)
    for env, rows in ((envs.unwrapped, (5, 1)), (one.unwrapped, (1,))):
        env.reset(seed=0)
        env.reset()
        env.step(rng.uniform(-1.0, 1.0, rows).astype(np.float32))
        copies = [env, copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
        for _ in range(4):
            actions = rng.uniform(-1.0, 1.0, rows).astype(np.float32)
            first, *others = [
                (each.step(actions)[0], each.reset()[0], each.step(actions)[4]["disturbance"])
                for each in copies
            ]
            for other in others:
                for found, expected in zip(other, first, strict=True):
                    np.testing.assert_array_equal(found, expected)
