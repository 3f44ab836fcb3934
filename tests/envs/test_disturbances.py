"""Every disturbance stays within its bound, and each kind is what its name says."""

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lagros_envs.disturbances import (
    KINDS,
    OPEN_LOOP,
    Disturbance,
    Situation,
    WorstCase,
    channel_mask,
    into_unit_ball,
    onto_unit_sphere,
)

ALL = (True, True, True, True)
RATES = (False, False, True, True)
METRIC = np.array(
    [
        [2.0, 0.5, 0.3, 0.1],
        [0.5, 9.0, 0.2, 1.5],
        [0.3, 0.2, 1.0, 0.4],
        [0.1, 1.5, 0.4, 3.0],
    ]
)
PERIOD = 0.1

bounds = st.one_of(st.just(0.0), st.floats(1e-6, 1e3))
seeds = st.integers(0, 2**63 - 1)
masks = st.tuples(*[st.booleans()] * 4).filter(any)
# Anything that a careless callable may return.
vectors = hnp.arrays(np.float64, (3, 4), elements=st.floats(-1e6, 1e6))


def realise(kind, bound=1.0, channels=ALL, seed=0, steps=90):
    return Disturbance(kind, bound, channels).realise(np.random.default_rng(seed), steps, PERIOD)


def situation(state, nominal=None, time=0.0, direction=(1.0, 0.0, 0.0, 0.0)):
    state = np.asarray(state, float)
    direction = np.broadcast_to(np.asarray(direction, float), state.shape)
    return Situation(state, nominal, np.full(state.shape[:-1], time), direction)


def norms(vectors):
    # Unlike the root of a sum of squares, hypot neither over- nor underflows.
    return np.hypot.reduce(vectors, axis=-1)


@pytest.mark.parametrize("kind", sorted(OPEN_LOOP))
@given(bound=bounds, channels=masks, seed=seeds, steps=st.integers(1, 120))
def test_no_open_loop_kind_leaves_its_bound_or_its_channels(kind, bound, channels, seed, steps):
    pushes = realise(kind, bound, channels, seed, steps)
    assert pushes.shape == (steps, 4)
    assert np.all(np.isfinite(pushes))
    assert np.all(norms(pushes) <= bound)
    assert np.all(pushes[:, ~np.array(channels)] == 0.0)


@given(vectors, bounds, masks)
@example(np.full((3, 4), 1e200), 0.75, ALL)
@example(np.full((3, 4), 1e-170), 0.75, ALL)
@example(np.full((3, 4), 1.0), 1e-290, ALL)
def test_a_callable_is_projected_onto_ball_and_channels(values, bound, channels):
    disturbance = Disturbance(lambda _: values, bound, channels)
    push = disturbance.respond(situation(np.zeros((3, 4))))
    assert np.all(norms(push) <= bound)
    assert np.all(push[:, ~np.array(channels)] == 0.0)
    masked = np.where(channels, values, 0.0)
    # What fits stays as it is; what does not keeps its direction and reaches the bound.
    for before, after, length in zip(masked, push, norms(masked), strict=True):
        expected = before if length <= bound else before / length * bound
        np.testing.assert_allclose(after, expected, rtol=1e-12, atol=1e-300)


@given(
    hnp.arrays(np.float64, (5, 4), elements=st.floats(-1e3, 1e3)),
    hnp.arrays(np.float64, (5, 4), elements=st.floats(-1e3, 1e3)),
    bounds,
    masks,
    seeds,
)
def test_worst_stays_within_its_bound_and_its_channels(state, nominal, bound, channels, seed):
    disturbance = Disturbance("worst", bound, channels, METRIC)
    direction = disturbance.realise(np.random.default_rng(seed), 5, PERIOD)
    push = disturbance.respond(situation(state, nominal, direction=direction))
    assert np.all(norms(push) <= bound)
    assert np.all(push[:, ~np.array(channels)] == 0.0)


@pytest.mark.parametrize("scale", [1e-170, 1e-162, 1e-155, 1.0, 1e150, 1e200])
def test_projections_keep_the_bound_at_the_ends_of_the_number_range(scale):
    vectors = scale * np.random.default_rng(0).uniform(-1.0, 1.0, (200, 4))
    fallback = np.array([1.0, 0.0, 0.0, 0.0])
    lengths = norms(onto_unit_sphere(vectors, fallback))
    assert np.all(lengths <= 1.0)
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-12)
    assert np.all(norms(into_unit_ball(vectors)) <= 1.0)


@pytest.mark.parametrize("channels", [ALL, RATES, (False, True, False, False)])
@pytest.mark.parametrize("kind", ["sphere", "constant"])
def test_sphere_and_constant_have_exactly_the_norm_of_the_bound(kind, channels):
    for seed in range(20):
        lengths = norms(realise(kind, 0.75, channels, seed))
        np.testing.assert_allclose(lengths, 0.75, rtol=0.0, atol=1e-12)


def test_worst_has_exactly_the_norm_of_the_bound():
    rng = np.random.default_rng(0)
    state, nominal = rng.standard_normal((2, 50, 4))
    push = Disturbance("worst", 0.75, ALL, METRIC).respond(situation(state, nominal))
    np.testing.assert_allclose(norms(push), 0.75, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("channels", [ALL, RATES, (True, False, False, False)])
def test_uniform_fills_the_ball_evenly(channels):
    dimension, bound = sum(channels), 0.75
    pushes = realise("uniform", bound, channels, seed=1, steps=4000)
    # A share q^k of the ball of k dimensions lies within q of its radius.
    shares = (norms(pushes) / bound) ** dimension
    assert scipy.stats.kstest(shares, "uniform").pvalue > 0.01


@pytest.mark.parametrize("kind", ["uniform", "sphere"])
def test_directions_are_isotropic(kind):
    pushes = realise(kind, 1.0, ALL, seed=2, steps=4000)
    directions = pushes / norms(pushes)[:, None]
    # Of a point on the unit sphere in 4 dimensions, the square of any coordinate is beta(1/2, 3/2).
    turned = scipy.stats.special_ortho_group.rvs(4, random_state=3)
    for axis in [*np.eye(4), *turned]:
        along = directions @ axis
        assert scipy.stats.kstest(along**2, scipy.stats.beta(0.5, 1.5).cdf).pvalue > 0.001
        assert scipy.stats.binomtest(int(np.sum(along > 0)), 4000).pvalue > 0.001


@pytest.mark.parametrize("kind", ["uniform", "sphere"])
def test_steps_are_independent(kind):
    pushes = realise(kind, 1.0, ALL, seed=4, steps=4000)
    correlation = np.corrcoef(pushes[:-1].T, pushes[1:].T)[:4, 4:]
    assert np.max(np.abs(correlation)) < 5.0 / math.sqrt(4000)


def test_none_is_zero():
    assert not np.any(realise("none", 0.75))


def test_constant_keeps_one_direction_and_episodes_differ():
    first, second = (realise("constant", 1.0, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(first, np.broadcast_to(first[0], first.shape))
    assert np.linalg.norm(first[0] - second[0]) > 1e-3


@given(seeds)
def test_sinusoid_is_one_wave_along_one_direction(seed):
    pushes = realise("sinusoid", 1.0, seed=seed, steps=200)
    # One direction: rank one. One frequency: a wave obeys s[k+1] + s[k-1] = 2 cos(w h) s[k].
    direction = np.linalg.svd(pushes)[2][0]
    wave = pushes @ direction
    np.testing.assert_allclose(np.outer(wave, direction), pushes, atol=1e-12)
    ratio = np.dot(wave[2:] + wave[:-2], wave[1:-1]) / np.dot(wave[1:-1], wave[1:-1])
    np.testing.assert_allclose(wave[2:] + wave[:-2], ratio * wave[1:-1], atol=1e-9)
    rate = math.acos(ratio / 2.0) / PERIOD
    assert 0.5 - 1e-6 <= rate <= 5.0 + 1e-6
    # 20 s at 0.5 rad/s or faster pass through a crest, which reaches the bound.
    assert 0.95 < np.max(np.abs(wave)) <= 1.0


def test_gust_decorrelates_in_a_second_and_is_stationary():
    # Without the clipping it would be normal; three quarters of a ball of radius 1/0.6 is enough
    # room for the correlation to be that of the process.
    episodes = np.stack([realise("gust", 1.0, seed=seed, steps=60) for seed in range(800)])
    spread = np.sqrt(np.mean(episodes**2, axis=(0, 2)))
    np.testing.assert_allclose(spread, spread.mean(), rtol=0.06)
    assert 0.25 < spread.mean() < 0.30  # 0.6 / sqrt(4), less what is clipped
    for lag in (5, 10, 20):
        correlation = np.mean(episodes[:, lag:] * episodes[:, :-lag]) / spread.mean() ** 2
        assert correlation == pytest.approx(math.exp(-lag * PERIOD / 1.0), abs=0.04)


def test_switching_keeps_a_direction_of_full_length_for_a_second_and_a_half():
    pushes = np.stack([realise("switching", 0.5, seed=seed, steps=90) for seed in range(300)])
    np.testing.assert_allclose(norms(pushes), 0.5, rtol=1e-9)
    changed = np.any(np.diff(pushes, axis=1) != 0.0, axis=-1)
    np.testing.assert_array_equal(
        changed, np.broadcast_to(np.arange(1, 90) % 15 == 0, changed.shape)
    )
    # One direction says nothing of the next.
    turns = np.sum(pushes[:, 14] * pushes[:, 15], axis=-1) / 0.25
    assert abs(turns.mean()) < 4.0 * 0.5 / math.sqrt(300)
    # A coarser control period keeps them as long.
    rng = np.random.default_rng(0)
    coarse = Disturbance("switching", 0.5, ALL).realise(rng, 12, 0.5)
    np.testing.assert_array_equal(coarse[:3], np.repeat(coarse[:1], 3, axis=0))
    assert np.any(coarse[3] != coarse[2])


@pytest.mark.parametrize("kind", sorted(OPEN_LOOP))
@given(seed=seeds, bound=st.floats(1e-3, 10.0), factor=st.floats(1.0, 100.0))
def test_a_larger_bound_scales_the_same_realisation(kind, seed, bound, factor):
    small, large = realise(kind, bound, seed=seed), realise(kind, bound * factor, seed=seed)
    np.testing.assert_allclose(large, factor * small, rtol=1e-12)


@pytest.mark.parametrize("kind", sorted(set(OPEN_LOOP) - {"none"}))
def test_seeds_decide(kind):
    np.testing.assert_array_equal(realise(kind, seed=5), realise(kind, seed=5))
    assert np.any(realise(kind, seed=5) != realise(kind, seed=6))


@pytest.mark.parametrize("channels", [ALL, RATES])
def test_worst_pushes_up_the_gradient_of_the_error_energy(channels):
    rng = np.random.default_rng(0)
    state, nominal = rng.standard_normal((2, 4))
    push = Disturbance("worst", 0.75, channels, METRIC).respond(situation(state, nominal))

    def energy(x):
        return (x - nominal) @ METRIC @ (x - nominal)

    width = 1e-6
    gradient = np.array(
        [
            (energy(state + width * axis) - energy(state - width * axis)) / (2.0 * width)
            for axis in np.eye(4)
        ]
    )
    gradient = np.where(channels, gradient, 0.0)
    np.testing.assert_allclose(push, 0.75 * gradient / np.linalg.norm(gradient), atol=1e-7)
    # No other push of that norm and those channels makes the energy grow faster.
    others = np.where(channels, rng.standard_normal((500, 4)), 0.0)
    others *= 0.75 / norms(others)[:, None]
    assert np.all(others @ gradient <= push @ gradient + 1e-9)


def test_worst_takes_a_metric_that_depends_on_the_state():
    def metric(state):
        return METRIC * (1.0 + state[..., 1, None, None] ** 2) + np.diag([state[0, 0], 0, 0, 0])

    state = np.array([[0.5, 0.2, 0.0, 0.1], [-0.2, 0.4, 1.0, 0.0]])
    push = Disturbance("worst", 2.0, ALL, metric).respond(situation(state, np.zeros((2, 4))))
    for row, x in zip(push, state, strict=True):
        gradient = (METRIC * (1.0 + x[1] ** 2) + np.diag([0.5, 0, 0, 0])) @ x
        np.testing.assert_allclose(row, 2.0 * gradient / np.linalg.norm(gradient), rtol=1e-12)


def test_worst_without_an_error_takes_the_direction_of_the_episode():
    state, direction = np.ones((1, 4)), np.array([0.0, 0.6, 0.0, 0.8])
    push = Disturbance("worst", 0.5, ALL, METRIC).respond(
        situation(state, state.copy(), direction=direction)
    )
    np.testing.assert_allclose(push[0], 0.5 * direction, rtol=1e-12)


def test_worst_needs_a_metric():
    with pytest.raises(ValueError, match="needs a contraction metric: pass metric=M"):
        Disturbance("worst", 0.5, ALL)


def test_worst_needs_a_nominal():
    with pytest.raises(ValueError, match=r"nominal trajectory.*options"):
        Disturbance("worst", 0.5, ALL, METRIC).respond(situation(np.ones(4)))
    with pytest.raises(ValueError, match="nominal trajectory"):
        WorstCase(METRIC)(situation(np.ones(4)))


def test_an_unknown_kind_is_refused_with_the_list_of_kinds():
    with pytest.raises(ValueError, match="disturbance='wind' is not known") as caught:
        Disturbance("wind", 0.5, ALL)
    for kind in ("none", "uniform", "sphere", "constant", "sinusoid", "gust", "worst", "callable"):
        assert kind in str(caught.value)
    assert set(KINDS) == {*OPEN_LOOP, "worst"}


@pytest.mark.parametrize("kind", OPEN_LOOP)
def test_an_open_loop_kind_is_drawn_and_answers_no_state(kind):
    disturbance = Disturbance(kind, 0.5, ALL)
    assert disturbance.feedback is None
    with pytest.raises(ValueError, match=f"disturbance='{kind}' does not respond to states"):
        disturbance.respond(situation(np.zeros(4)))


@pytest.mark.parametrize("bound", [-0.1, math.inf, math.nan])
def test_a_bound_that_bounds_nothing_is_refused(bound):
    with pytest.raises(ValueError, match="disturbance_bound="):
        Disturbance("uniform", bound, ALL)


def test_an_empty_mask_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        Disturbance("uniform", 0.5, (False,) * 4)


@pytest.mark.parametrize(
    "value",
    [
        np.zeros(3),
        np.zeros((1, 4)),
        0.0,
        np.array([0.0, np.nan, 0.0, 0.0]),
        None,
        ["0", "0", "0", "1"],
        np.ones(4) * 1j,
        np.ones(4, bool),
        np.ones(4, object),
        np.ma.masked_array(np.ones(4), mask=True),
    ],
)
def test_a_callable_that_returns_nonsense_is_refused(value):
    disturbance = Disturbance(lambda _: value, 0.5, ALL)
    with pytest.raises(ValueError, match="must return finite numbers of the state's shape"):
        disturbance.respond(situation(np.zeros(4)))


@pytest.mark.parametrize(
    "value",
    [None, "M", 1.0, np.eye(3), np.eye(4) * 1j, np.full((4, 4), np.nan), np.ones((2, 4, 4))],
)
def test_a_metric_that_returns_nonsense_is_refused_by_name(value):
    disturbance = Disturbance("worst", 0.5, ALL, lambda _: value)
    with pytest.raises(ValueError, match=r"metric returned .* must return .* shape \(4, 4\)"):
        disturbance.respond(situation(np.ones(4), np.zeros(4)))


def test_a_metric_may_be_the_same_for_all_states_but_not_too_large():
    now = situation(np.ones((3, 4)), np.zeros((3, 4)))
    constant = Disturbance("worst", 0.5, ALL, METRIC).respond(now)
    function = Disturbance("worst", 0.5, ALL, lambda _: METRIC).respond(now)
    np.testing.assert_array_equal(function, constant)
    with pytest.raises(ValueError, match=r"metric=.* is too large"), np.errstate(over="ignore"):
        Disturbance("worst", 0.5, ALL, 1e308 * np.eye(4)).respond(
            situation(np.full(4, 1e9), np.zeros(4))
        )


@pytest.mark.parametrize("kind", ["callable", "worst"])
def test_a_function_may_write_to_what_it_is_shown(kind):
    def spoil(now):
        parts = (now.state, now.nominal, now.time, now.direction) if kind == "callable" else (now,)
        for part in parts:
            part[...] = 7.0
        return parts[0] if kind == "callable" else METRIC

    shown = situation(np.ones(4), np.zeros(4), np.array(0.3))
    before = [np.array(part) for part in (shown.state, shown.nominal, shown.time, shown.direction)]
    disturbance = Disturbance(spoil if kind == "callable" else "worst", 0.5, ALL, spoil)
    disturbance.respond(shown)
    after = shown.state, shown.nominal, shown.time, shown.direction
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_callable_sees_state_nominal_time_and_direction():
    seen = []
    disturbance = Disturbance(lambda now: seen.append(now) or now.state, 10.0, ALL)
    state, nominal = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.5, 0.0, 0.0, 0.0])
    push = disturbance.respond(situation(state, nominal, time=0.3))
    np.testing.assert_allclose(push, state, rtol=1e-12)
    np.testing.assert_array_equal(seen[0].nominal, nominal)
    assert seen[0].time == 0.3
    np.testing.assert_array_equal(seen[0].direction, [1.0, 0.0, 0.0, 0.0])


@given(st.lists(st.booleans(), min_size=1, max_size=8))
def test_a_mask_must_have_one_entry_per_state(flags):
    if len(flags) == 4:
        assert channel_mask(flags, RATES) == tuple(flags)
        return
    with pytest.raises(ValueError, match=f"has {len(flags)} entries; the state has 4"):
        channel_mask(flags, RATES)


def test_masks_by_name():
    assert channel_mask("all", RATES) == ALL
    assert channel_mask("rates", RATES) == RATES
    with pytest.raises(ValueError, match="disturbance_channels='speed'"):
        channel_mask("speed", RATES)


@given(hnp.arrays(np.float64, (4,), elements=st.floats(-1e3, 1e3)))
def test_unit_ball_projection_is_the_nearest_point(vector):
    assume(norms(vector) > 0)
    projected = into_unit_ball(vector)
    nearest = vector / max(1.0, norms(vector))
    np.testing.assert_allclose(projected, nearest, rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize("kind", [*sorted(OPEN_LOOP), "worst"])
@pytest.mark.parametrize("channels", [(True,) * 4, (False, True, False, True)])
def test_disturbances_of_many_episodes_are_those_of_each(kind, channels):
    disturbance = Disturbance(kind, 0.7, channels, metric=np.eye(4))
    many = np.full((70, 9, 4), np.nan)  # more than are worked on at once
    disturbance.realise_all(map(np.random.default_rng, range(70)), many, PERIOD)
    for seed, found in enumerate(many):
        expected = disturbance.realise(np.random.default_rng(seed), 9, PERIOD)
        np.testing.assert_array_equal(found, expected)
