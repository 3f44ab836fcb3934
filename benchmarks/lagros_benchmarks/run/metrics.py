"""Rates, means, paired comparisons, each with a 95 % interval.

Episodes are paired: episode k of every policy has the same start, goal and disturbance. What two
policies differ by is therefore measured on pairs, which takes the luck of the draw out of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from lagros_envs.arrays import FloatArray

CONFIDENCE = 0.95
RESAMPLES = 2000
# Resampling has its own fixed seed: the same episodes give the same interval.
_BOOTSTRAP_SEED = 20210226


class Interval(NamedTuple):
    """A confidence interval."""

    low: float
    high: float


class PairedDifference(NamedTuple):
    """Success rate of one policy minus that of another, on the same episodes."""

    difference: float
    interval: Interval


class EffortRatio(NamedTuple):
    """Mean effort of one policy over that of another, on the episodes that both solve."""

    ratio: float
    interval: Interval | None
    episodes: int


class MedianRatio(NamedTuple):
    """Median over paired episodes of what one policy has over what another has."""

    ratio: float
    interval: Interval | None
    episodes: int


def wilson_interval(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Return Wilson's score interval of a rate.

    Raises:
        ValueError: There are no trials, or more successes than trials.
    """
    from scipy.stats import binomtest

    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes of {trials} trials is no rate")
    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return Interval(float(interval.low), float(interval.high))


def mean_interval(values: Sequence[float] | FloatArray) -> Interval | None:
    """Return the percentile bootstrap interval of a mean.

    The bootstrap and not Student's t: efforts are positive and skewed by the episodes that go
    wrong, where t reaches below zero.

    Returns:
        The interval, or None for fewer than two values or if one is not finite.
    """
    data = np.asarray(values, dtype=np.float64)
    if data.size < 2 or not np.all(np.isfinite(data)):
        return None
    return _bootstrap((data,), np.mean)


def paired_success_difference(
    first: Sequence[bool], second: Sequence[bool], confidence: float = CONFIDENCE
) -> PairedDifference:
    """Return the difference of two success rates on the same episodes.

    The interval is Newcombe's hybrid score interval for paired proportions (Statistics in Medicine
    17, 1998, method 10). It is right where rates are near 100 % and where no pair differs, where
    the textbook interval has width zero.

    Raises:
        ValueError: The two differ in length or are empty.
    """
    ours, theirs = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if ours.shape != theirs.shape or ours.size == 0:
        raise ValueError(f"{ours.size} episodes cannot be paired with {theirs.size}")
    trials = int(ours.size)
    both, neither = int(np.sum(ours & theirs)), int(np.sum(~ours & ~theirs))
    only_ours, only_theirs = int(np.sum(ours & ~theirs)), int(np.sum(~ours & theirs))
    difference = (only_ours - only_theirs) / trials
    margins = []
    for successes in (both + only_ours, both + only_theirs):
        rate = successes / trials
        low, high = wilson_interval(successes, trials, confidence)
        margins.append((rate - low, high - rate))
    (down_1, up_1), (down_2, up_2) = margins
    phi = _corrected_phi(both, only_ours, only_theirs, neither)
    below = math.sqrt(max(down_1**2 - 2 * phi * down_1 * up_2 + up_2**2, 0.0))
    above = math.sqrt(max(up_1**2 - 2 * phi * up_1 * down_2 + down_2**2, 0.0))
    return PairedDifference(difference, Interval(difference - below, difference + above))


def _corrected_phi(both: int, only_first: int, only_second: int, neither: int) -> float:
    """Return the correlation of the pairs, with Newcombe's continuity correction."""
    product = (
        (both + only_first)
        * (only_second + neither)
        * (both + only_second)
        * (only_first + neither)
    )
    if product == 0:
        return 0.0
    covariance: float = both * neither - only_first * only_second
    if covariance > 0:
        covariance = max(covariance - (both + only_first + only_second + neither) / 2, 0.0)
    return covariance / math.sqrt(product)


def effort_ratio(
    efforts: Sequence[float] | FloatArray,
    solved: Sequence[bool],
    other_efforts: Sequence[float] | FloatArray,
    other_solved: Sequence[bool],
) -> EffortRatio | None:
    """Return the ratio of mean efforts over the episodes that both solve.

    Returns:
        The ratio with a paired bootstrap interval (None for fewer than two episodes), or None if
        no episode is solved by both or the other spends nothing.
    """
    both = np.asarray(solved, dtype=bool) & np.asarray(other_solved, dtype=bool)
    ours = np.asarray(efforts, dtype=np.float64)[both]
    theirs = np.asarray(other_efforts, dtype=np.float64)[both]
    if ours.size == 0 or not theirs.mean() > 0.0:
        return None
    interval = _bootstrap((ours, theirs), _ratio_of_means) if ours.size > 1 else None
    return EffortRatio(float(ours.mean() / theirs.mean()), interval, int(ours.size))


def median_ratio(
    ours: Sequence[float] | FloatArray, theirs: Sequence[float] | FloatArray
) -> MedianRatio | None:
    """Return the median of the ratios of two policies on the same episodes.

    The median and not the mean: one episode that diverges would decide a mean, in our favour or in
    theirs. Its interval is that of two order statistics, which assumes nothing of the distribution.

    Args:
        ours: Of each episode, nan where it was not measured.
        theirs: Of the same episodes.

    Returns:
        The ratio with its interval (None for fewer than six episodes), or None if no episode was
        measured for both.
    """
    above, below = np.asarray(ours, dtype=np.float64), np.asarray(theirs, dtype=np.float64)
    paired = np.isfinite(above) & np.isfinite(below) & (below > 0.0)
    ratios = np.sort(above[paired] / below[paired])
    if ratios.size == 0:
        return None
    from scipy.stats import binom

    count = int(ratios.size)
    rank = int(binom.ppf((1.0 - CONFIDENCE) / 2.0, count, 0.5))
    interval = None
    if rank:
        interval = Interval(float(ratios[rank - 1]), float(ratios[count - rank]))
    return MedianRatio(float(np.median(ratios)), interval, count)


def _ratio_of_means(ours: FloatArray, theirs: FloatArray, axis: int = -1) -> Any:
    return np.mean(ours, axis=axis) / np.mean(theirs, axis=axis)


def _bootstrap(data: tuple[FloatArray, ...], statistic: Any) -> Interval:
    from scipy.stats import bootstrap

    result = bootstrap(
        data,
        statistic,
        paired=len(data) > 1,
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=200,  # bounds the memory of a run of many episodes
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(_BOOTSTRAP_SEED),
    ).confidence_interval
    return Interval(float(result.low), float(result.high))


def cluster_interval(
    numerators: Sequence[float] | FloatArray, denominators: Sequence[float] | FloatArray
) -> Interval | None:
    """Return the percentile bootstrap interval, over clusters, of the ratio of two sums.

    Whole clusters are resampled, so that what happens to the agents of one world may depend on each
    other as it likes. A rate is successes over agents, a mean is totals over counts, a ratio of
    means is totals over totals. A cluster whose denominator is zero has nothing to say and is left
    out; none is negative. There is no interval for fewer than two clusters, or if a number is not
    finite.
    """
    above = np.asarray(numerators, dtype=np.float64)
    below = np.asarray(denominators, dtype=np.float64)
    above, below = above[below != 0.0], below[below != 0.0]
    if above.size < 2 or not (np.all(np.isfinite(above)) and np.all(np.isfinite(below))):
        return None
    weights = _resampled(above.size)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile((weights @ above) / (weights @ below), [tail, 100.0 - tail])
    return Interval(float(low), float(high))


def cluster_rate_interval(successes: Sequence[int], trials: Sequence[int]) -> Interval:
    """Return an interval of a rate whose trials come in clusters: agents in worlds.

    Where all trials agree, resampling has no spread; the interval is then Wilson's with the
    clusters as trials, which is right however much the trials of a cluster depend on each other.

    Raises:
        ValueError: There are no trials, or more successes than trials.
    """
    total, most = int(np.sum(successes)), int(np.sum(trials))
    over_trials = wilson_interval(total, most)
    interval = None
    if 0 < total < most:
        interval = cluster_interval(np.asarray(successes), np.asarray(trials))
    if interval is not None:
        return interval
    if total not in (0, most):
        return over_trials  # one cluster: there is nothing to resample
    clusters = int(np.count_nonzero(trials))
    return wilson_interval(clusters if total else 0, clusters)


@lru_cache(maxsize=8)
def _resampled(clusters: int) -> FloatArray:
    """Return how often each resample holds each cluster, shape (resamples, clusters)."""
    generator = np.random.default_rng(_BOOTSTRAP_SEED)
    shares = np.full(clusters, 1.0 / clusters)
    return generator.multinomial(clusters, shares, RESAMPLES).astype(np.float64)


class StepTimes(NamedTuple):
    """Times of calls [s] and the share of them over the deadline; nan if there were none."""

    median: float
    p99: float
    maximum: float
    deadline_misses: float


def step_time_statistics(times: FloatArray, misses: int) -> StepTimes:
    """Return the statistics of the times of calls [s], `misses` of them over the deadline."""
    if times.size == 0:
        return StepTimes(math.nan, math.nan, math.nan, math.nan)
    median, p99 = np.percentile(times, [50.0, 99.0])
    return StepTimes(float(median), float(p99), float(times.max()), misses / times.size)


def carry_forward(curves: FloatArray) -> FloatArray:
    """Fill the end of curves (episodes, instants) that end early, which are nan there.

    An episode that ended early counts from then on with its largest value so far, so that a fall
    never improves a mean.
    """
    largest = np.fmax.accumulate(curves, axis=1)
    return np.where(np.isnan(curves), largest, curves)
