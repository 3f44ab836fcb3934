"""Intervals and comparisons against formulas and counts that owe nothing to the code."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from lagros_benchmarks.run.metrics import (
    carry_forward,
    cluster_interval,
    cluster_rate_interval,
    effort_ratio,
    mean_interval,
    paired_success_difference,
    step_time_statistics,
    wilson_interval,
)


def wilson_by_roots(successes, trials, z=1.959963984540054):
    """The rates p for which |rate - p| = z sqrt(p (1 - p) / n): a quadratic in p."""
    rate = successes / trials
    roots = np.roots([1 + z**2 / trials, -(2 * rate + z**2 / trials), rate**2])
    return sorted(roots.real)


@pytest.mark.parametrize(("successes", "trials"), [(0, 50), (1, 7), (25, 50), (999, 1000), (5, 5)])
def test_wilson_interval_solves_its_quadratic(successes, trials):
    interval = wilson_interval(successes, trials)
    assert interval == pytest.approx(wilson_by_roots(successes, trials), abs=1e-9)


def test_wilson_interval_as_published():
    # Newcombe 1998 (Statistics in Medicine 17, 857-872), table I: 81 of 263 and 15 of 148.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson_interval(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (3, 2), (-1, 4)])
def test_wilson_interval_refuses_what_is_no_rate(successes, trials):
    with pytest.raises(ValueError, match="no rate"):
        wilson_interval(successes, trials)


def pairs(both, only_first, only_second, neither):
    counts = (both, only_first, only_second, neither)
    kinds = ((True, True), (True, False), (False, True), (False, False))
    outcomes = [kind for kind, count in zip(kinds, counts, strict=True) for _ in range(count)]
    return [first for first, _ in outcomes], [second for _, second in outcomes]


def test_paired_difference_of_identical_policies_still_has_a_width():
    result = paired_success_difference([True] * 50, [True] * 50)
    assert result.difference == 0.0
    assert result.interval.low < 0.0 < result.interval.high
    assert result.interval.high < 0.11


def test_paired_difference_changes_sign_with_the_order():
    first, second = pairs(30, 12, 2, 6)
    forward = paired_success_difference(first, second)
    backward = paired_success_difference(second, first)
    assert forward.difference == pytest.approx(10 / 50)
    assert forward.difference == -backward.difference
    assert forward.interval == pytest.approx((-backward.interval.high, -backward.interval.low))


def test_paired_difference_covers_the_truth():
    # The exact coverage over all tables of 15 pairs, from multinomial probabilities.
    shares = np.array([0.6, 0.25, 0.05, 0.1])
    trials, truth, covered = 15, 0.2, 0.0
    for counts in itertools.product(range(trials + 1), repeat=4):
        if sum(counts) != trials:
            continue
        low, high = paired_success_difference(*pairs(*counts)).interval
        if low <= truth <= high:
            ways = math.factorial(trials) / math.prod(map(math.factorial, counts))
            covered += ways * float(np.prod(shares ** np.array(counts)))
    assert 0.93 < covered < 0.99


def test_paired_difference_refuses_unpaired_episodes():
    with pytest.raises(ValueError, match="cannot be paired"):
        paired_success_difference([True], [True, False])


def test_mean_interval_agrees_with_the_normal_law_for_many_values():
    values = np.random.default_rng(0).exponential(3.0, 4000)
    half = 1.96 * values.std(ddof=1) / math.sqrt(values.size)
    expected = (values.mean() - half, values.mean() + half)
    assert mean_interval(values) == pytest.approx(expected, abs=0.15 * half)


def test_mean_interval_is_the_same_every_time():
    values = list(range(20))
    assert mean_interval(values) == mean_interval(values)


@pytest.mark.parametrize("values", [[], [1.0], [1.0, math.inf]])
def test_mean_interval_is_none_where_there_is_none(values):
    assert mean_interval(values) is None


def test_effort_ratio_uses_the_episodes_that_both_solve():
    ours, theirs = [2.0, 4.0, 100.0, 6.0], [1.0, 2.0, 1.0, 3.0]
    result = effort_ratio(ours, [True, True, True, True], theirs, [True, True, False, True])
    assert result.episodes == 3
    assert result.ratio == pytest.approx(2.0)
    # The pairs have one ratio throughout: resampling pairs cannot move it.
    assert result.interval == pytest.approx((2.0, 2.0))


def test_effort_ratio_is_none_where_nothing_is_solved_by_both():
    assert effort_ratio([1.0], [True], [1.0], [False]) is None
    single = effort_ratio([1.0, 3.0], [True, False], [2.0, 2.0], [True, True])
    assert (single.ratio, single.interval, single.episodes) == (0.5, None, 1)


def test_step_times():
    times = np.array([1.0, 2.0, 3.0, 10.0])
    statistics = step_time_statistics(times, misses=1)
    assert statistics.median == 2.5
    assert statistics.maximum == 10.0
    assert statistics.deadline_misses == 0.25
    assert math.isnan(step_time_statistics(np.array([]), 0).median)


def test_a_curve_that_ends_early_keeps_its_largest_value():
    curves = np.array([[0.0, 3.0, 2.0, np.nan, np.nan], [0.0, 1.0, 2.0, 1.0, 1.0]])
    assert carry_forward(curves).tolist() == [[0.0, 3.0, 2.0, 3.0, 3.0], [0.0, 1.0, 2.0, 1.0, 1.0]]


def test_trials_of_a_cluster_that_are_alike_count_once():
    rng = np.random.default_rng(1)
    alike = rng.random(100) < 0.7
    interval = cluster_rate_interval((6 * alike).tolist(), [6] * 100)
    # As if each cluster were one trial, whose interval of a mean is the textbook's.
    rate = alike.mean()
    wide = 1.96 * math.sqrt(rate * (1 - rate) / 100)
    assert interval == pytest.approx((rate - wide, rate + wide), abs=0.015)


def test_independent_trials_may_as_well_not_come_in_clusters():
    successes = np.random.default_rng(2).binomial(6, 0.7, 400)
    interval = cluster_rate_interval(successes.tolist(), [6] * 400)
    assert interval == pytest.approx(wilson_interval(int(successes.sum()), 2400), abs=0.006)


def test_the_interval_of_a_rate_covers_it_as_often_as_it_says():
    """Worlds whose agents share their fate: 95 % of intervals, give or take, hold the truth."""
    rng = np.random.default_rng(3)
    rates = rng.beta(1.0, 0.5, (300, 60))
    counts = rng.binomial(6, rates)
    intervals = [cluster_rate_interval(row.tolist(), [6] * 60) for row in counts]
    covered = np.mean([low <= 4 / 6 <= high for low, high in intervals])
    assert 0.91 <= covered <= 0.985
    over_trials = [wilson_interval(int(row.sum()), 360) for row in counts]
    # Wilson's over all agents, which takes them for independent, does not.
    assert np.mean([low <= 4 / 6 <= high for low, high in over_trials]) < 0.85


def test_where_all_agree_every_cluster_is_one_trial():
    assert cluster_rate_interval([6] * 50, [6] * 50) == wilson_interval(50, 50)
    assert cluster_rate_interval([0] * 50, [6] * 50) == wilson_interval(0, 50)
    assert cluster_rate_interval([2], [6]) == wilson_interval(2, 6)


def test_the_interval_of_a_ratio_is_exact_where_all_clusters_agree():
    weights = [1.0, 5.0, 2.0, 9.0]
    assert cluster_interval(2.5 * np.array(weights), weights) == pytest.approx((2.5, 2.5))


def test_empty_clusters_change_no_interval():
    rng = np.random.default_rng(4)
    above, below = rng.random(30), rng.random(30)
    interval = cluster_interval(above, below)
    padded = cluster_interval([*above, 0.0, 0.0], [*below, 0.0, 0.0])
    assert padded == interval


def test_no_interval_without_two_finite_clusters():
    assert cluster_interval([1.0], [1.0]) is None
    assert cluster_interval([1.0, 2.0], [1.0, 0.0]) is None
    assert cluster_interval([1.0, math.inf], [1.0, 1.0]) is None
