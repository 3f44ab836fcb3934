"""Did a conformal bound hold: fresh episodes below it, and random splits of all of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_policies.contraction.conformal import ConformalBound, conformal_bound

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CoverageCheck:
    """Fresh episodes against a bound.

    Attributes:
        covered: Fresh episodes whose score is at most the bound.
        episodes: Fresh episodes.
        expected: Share expected, k / (n + 1).
        standard_error: Standard deviation of the share covered, over calibration sets *and* fresh
            episodes together: the count has a Beta-binomial law.
    """

    covered: int
    episodes: int
    expected: float
    standard_error: float

    @property
    def share(self) -> float:
        """Share of fresh episodes covered."""
        return self.covered / self.episodes

    @property
    def deviation(self) -> float:
        """How far the share is from the expected one, in standard errors."""
        return (self.share - self.expected) / self.standard_error

    @property
    def within_two(self) -> bool:
        """Whether that is at most two."""
        return abs(self.deviation) <= 2.0


def check_coverage(bound: ConformalBound, scores: FloatArray) -> CoverageCheck:
    """Count fresh episodes below a bound.

    Args:
        bound: The bound, from other episodes.
        scores: Scores of the fresh episodes, shape (m,).

    Raises:
        ValueError: There are none, or a score is not a number.
    """
    values = np.asarray(scores, np.float64)
    if values.ndim != 1 or len(values) == 0 or np.any(np.isnan(values)):
        raise ValueError(f"scores of shape {values.shape} must be one number per fresh episode")
    m, n, share = len(values), bound.count, bound.expected_coverage
    # Variance of a Beta(k, n + 1 - k) share, and of counting m episodes given the share.
    between = share * (1.0 - share) / (n + 2)
    error = math.sqrt(between + (share * (1.0 - share) - between) / m)
    return CoverageCheck(int(np.count_nonzero(values <= bound.value)), m, share, error)


def split_coverage(
    scores: FloatArray, calibration: int, level: float, splits: int, rng: np.random.Generator
) -> float:
    """Return the coverage averaged over random splits of one set of episodes.

    Averaging takes out most of what one calibration set adds by chance; what the set itself has by
    chance stays.

    Args:
        scores: One score per episode, shape (n,).
        calibration: Episodes of each split that calibrate; the others are fresh.
        level: c.
        splits: Splits.
        rng: Random generator.

    Raises:
        ValueError: No episode would be fresh, or too few calibrate.
    """
    values = np.asarray(scores, np.float64)
    if not 0 < calibration < len(values) or splits < 1:
        raise ValueError(
            f"calibration={calibration} must leave some of {len(values)} episodes, and splits="
            f"{splits} be at least 1"
        )
    shares = []
    for _ in range(splits):
        mixed = rng.permutation(values)
        bound = conformal_bound(mixed[:calibration], level)
        shares.append(float(np.mean(mixed[calibration:] <= bound.value)))
    return float(np.mean(shares))
