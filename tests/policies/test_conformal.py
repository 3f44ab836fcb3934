"""Split conformal bounds against counting, simulation and the binomial law."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from studies.coverage import check_coverage, split_coverage

from lagros_policies.contraction.conformal import (
    ConformalBound,
    bound_statement,
    confident_rank,
    conformal_bound,
    coverage_interval,
    rank_for,
)


@given(count=st.integers(1, 400), percent=st.integers(1, 99))
def test_rank_is_the_least_that_covers_enough(count: int, percent: int) -> None:
    # A fresh score takes each of the n + 1 ranks with equal probability.
    level = Fraction(percent, 100)
    enough = [k for k in range(1, count + 1) if Fraction(k, count + 1) >= level]
    if enough:
        assert rank_for(count, percent / 100) == enough[0]
    else:
        with pytest.raises(ValueError, match=r"too few .* use at least"):
            rank_for(count, percent / 100)


def test_the_number_in_the_message_is_the_least_that_is_enough() -> None:
    with pytest.raises(ValueError, match="use at least 19,"):
        rank_for(18, 0.95)
    assert rank_for(19, 0.95) == 19


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1, math.nan])
def test_levels_outside_the_open_interval_are_refused(level: float) -> None:
    with pytest.raises(ValueError, match="level="):
        rank_for(100, level)


def test_bound_is_a_sorted_score() -> None:
    scores = np.random.default_rng(0).permutation(np.arange(1.0, 100.0))
    bound = conformal_bound(scores, 0.9)
    assert bound == ConformalBound(90.0, 0.9, 90, 99)
    assert bound.expected_coverage == pytest.approx(0.9)


def test_failed_episodes_count_as_infinite_scores() -> None:
    scores = np.arange(1.0, 100.0)
    scores[-15:] = np.inf
    assert math.isinf(conformal_bound(scores, 0.9).value)
    assert conformal_bound(scores, 0.8).value == 80.0
    with pytest.raises(ValueError, match="inf where it failed"):
        conformal_bound(np.array([1.0, np.nan]), 0.5)


def test_coverage_over_many_calibration_sets_has_the_stated_mean_and_error() -> None:
    rng = np.random.default_rng(1)
    n, m, repeats = 39, 60, 4000
    calibration = np.sort(rng.standard_exponential((repeats, n)), axis=1)
    fresh = rng.standard_exponential((repeats, m))
    rank = rank_for(n, 0.9)
    shares = np.mean(fresh <= calibration[:, rank - 1 : rank], axis=1)
    check = check_coverage(conformal_bound(calibration[0], 0.9), fresh[0])
    assert check.expected == pytest.approx(rank / (n + 1))
    assert shares.mean() == pytest.approx(check.expected, abs=4.0 * shares.std() / repeats**0.5)
    assert shares.std() == pytest.approx(check.standard_error, rel=0.05)
    inside = np.abs(shares - check.expected) <= 2.0 * check.standard_error
    assert 0.92 < inside.mean() < 0.98


def test_check_counts() -> None:
    check = check_coverage(ConformalBound(2.0, 0.5, 5, 9), np.array([1.0, 2.0, 3.0, np.inf]))
    assert (check.covered, check.episodes, check.share) == (2, 4, 0.5)
    assert check.deviation == pytest.approx(0.0)
    assert check.within_two
    with pytest.raises(ValueError, match="one number per fresh episode"):
        check_coverage(ConformalBound(2.0, 0.5, 5, 9), np.empty(0))


def test_confident_rank_by_the_binomial_law() -> None:
    # The k-th smallest covers less than c exactly if k or more scores lie below the c-quantile.
    count, level, confidence = 60, 0.9, 0.95
    below = [math.comb(count, j) * level**j * (1 - level) ** (count - j) for j in range(count + 1)]
    ranks = [k for k in range(1, count + 1) if sum(below[:k]) >= confidence]
    assert confident_rank(count, level, confidence) == ranks[0]
    with pytest.raises(ValueError, match="use at least 29,"):
        confident_rank(28, level, confidence)
    assert confident_rank(29, level, confidence) == 29
    bound = conformal_bound(np.arange(60.0), level, confidence)
    assert bound.rank == ranks[0]
    assert bound.rank > rank_for(60, level)


def test_interval_of_the_coverage_by_simulation() -> None:
    rng = np.random.default_rng(2)
    bound = conformal_bound(rng.random(99), 0.9)
    # Of uniform scores the bound itself is the share that it covers.
    values = np.sort(rng.random((20_000, 99)), axis=1)[:, bound.rank - 1]
    assert coverage_interval(bound) == pytest.approx(
        tuple(np.quantile(values, [0.025, 0.975])), abs=0.004
    )


def test_split_coverage_is_near_the_level_and_reproducible() -> None:
    scores = np.random.default_rng(3).gamma(2.0, size=900)
    shares = [split_coverage(scores, 300, 0.9, 200, np.random.default_rng(4)) for _ in range(2)]
    assert shares[0] == shares[1]
    assert shares[0] == pytest.approx(0.9, abs=0.01)
    # With one fresh episode of ten it is not covered where it is the largest: one time in ten.
    few = np.random.default_rng(5).permutation(np.arange(10.0))
    assert split_coverage(few, 9, 0.9, 4000, np.random.default_rng(6)) == pytest.approx(
        0.9, abs=0.02
    )
    with pytest.raises(ValueError, match="calibration=900"):
        split_coverage(scores, 900, 0.9, 10, np.random.default_rng(0))


def test_statement_says_level_and_law_and_holds_only_if_it_bounds() -> None:
    bound = conformal_bound(np.arange(99.0), 0.9)
    line = bound_statement("the error", "m", bound, "uniform, d_bar = 1", 2.0)
    assert (line.kind, line.holds, line.seconds) == ("calibrated", True, 2.0)
    for part in ("the error is at most 89 m", "probability 0.9", "uniform, d_bar = 1", "99 episo"):
        assert part in line.text
    # The bound is the 90th of 99: the share that it covers has the law Beta(90, 10).
    covered = np.sort(np.random.default_rng(7).random((20_000, 99)), axis=1)[:, 89]
    said = float(line.text.split("at least ")[1].split(" %")[0]) / 100.0
    assert said == pytest.approx(float(np.quantile(covered, 0.025)), abs=0.005)
    nothing = conformal_bound(np.full(99, np.inf), 0.9)
    assert not bound_statement("the error", "m", nothing, "", 0.0).holds
