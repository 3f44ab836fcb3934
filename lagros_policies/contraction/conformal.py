"""Split conformal bounds: what holds for a fresh episode with a stated probability.

The scores of n calibration episodes and of one fresh episode, drawn in the same way, are
exchangeable. So the k-th smallest of the n, k = ceil((n + 1) c), bounds the fresh score with a
probability of at least c, whatever the law of the scores (Vovk, Gammerman & Shafer 2005). That is
one score per *episode*: the instants of one episode are not exchangeable.

The probability is over calibration set and fresh episode together. Given the calibration set, the
share of fresh episodes below the bound is itself random, with the law Beta(k, n + 1 - k) where no
two scores are equal; `coverage_interval` says between what it lies, and `confident_rank` asks for a
bound whose share is c with a stated confidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.contraction.statement import Statement


@dataclass(frozen=True, slots=True)
class ConformalBound:
    """A bound of the score of a fresh episode.

    Attributes:
        value: The bound, in units of the score; infinite where too many calibration episodes had no
            finite score.
        level: Probability c with which it was asked to hold.
        rank: k, which of the sorted calibration scores it is, from 1.
        count: n, calibration episodes.
    """

    value: float
    level: float
    rank: int
    count: int

    @property
    def expected_coverage(self) -> float:
        """Return k / (n + 1), the mean share of fresh episodes below the bound."""
        return self.rank / (self.count + 1)


def rank_for(count: int, level: float) -> int:
    """Return k = ceil((n + 1) c), the rank with the finite-sample correction.

    Args:
        count: n, calibration episodes.
        level: c in (0, 1).

    Raises:
        ValueError: The level is not in (0, 1), or n is too small for it: k would exceed n.
    """
    _check_level(level)
    # Rounding must not lift (n + 1) c = 95 over 95.
    rank = math.ceil((count + 1) * level - 1e-9)
    if rank > count:
        # The least n with (n + 1) c <= n.
        needed = math.ceil(level / (1.0 - level) - 1e-9)
        raise ValueError(
            f"{count} calibration episodes are too few for level={level!r}: use at least {needed}, "
            "or a lower level"
        )
    return max(rank, 1)


def confident_rank(count: int, level: float, confidence: float) -> int:
    """Return the least k whose bound covers a share c of fresh episodes with a confidence.

    Given the calibration set the share has the law Beta(k, n + 1 - k), so the k asked for is the
    least with P(Beta(k, n + 1 - k) >= c) >= confidence (a one-sided tolerance limit, Wilks 1941).

    Args:
        count: n, calibration episodes.
        level: c in (0, 1).
        confidence: In (0, 1), over the calibration set.

    Raises:
        ValueError: A number is out of range, or n is too small.
    """
    from scipy.stats import beta

    _check_level(level)
    _check_level(confidence, "confidence")
    ranks = np.arange(1, count + 1)
    enough = beta.sf(level, ranks, count + 1 - ranks) >= confidence
    if not enough.any():
        needed = math.ceil(math.log(1.0 - confidence) / math.log(level))
        raise ValueError(
            f"{count} calibration episodes are too few for level={level!r} with confidence="
            f"{confidence!r}: use at least {needed}, or lower either"
        )
    return int(ranks[np.argmax(enough)])


def conformal_bound(
    scores: FloatArray, level: float, confidence: float | None = None
) -> ConformalBound:
    """Return the split-conformal bound of a fresh score.

    Args:
        scores: One score per calibration episode, shape (n,); inf for an episode that came to no
            finite one (it fell, it raised), so that none is dropped.
        level: c, probability with which the bound is to hold for a fresh episode.
        confidence: None for c on average over calibration sets; otherwise the confidence, over
            calibration sets, with which the share of fresh episodes below the bound is at least c.

    Raises:
        ValueError: A score is not a number, or there are too few for the level.
    """
    values = np.asarray(scores, np.float64)
    if values.ndim != 1 or np.any(np.isnan(values)):
        raise ValueError(
            f"scores of shape {values.shape} must be one number per episode, inf where it failed"
        )
    count = len(values)
    if confidence is None:
        rank = rank_for(count, level)
    else:
        rank = confident_rank(count, level, confidence)
    return ConformalBound(float(np.sort(values)[rank - 1]), level, rank, count)


def coverage_interval(bound: ConformalBound, confidence: float = 0.95) -> tuple[float, float]:
    """Return between what the share of fresh episodes below the bound lies, by the Beta law.

    Args:
        bound: The bound.
        confidence: Probability of the interval, over calibration sets.
    """
    from scipy.stats import beta

    _check_level(confidence, "confidence")
    low, high = beta.interval(confidence, bound.rank, bound.count + 1 - bound.rank)
    return float(low), float(high)


def bound_statement(
    what: str, unit: str, bound: ConformalBound, where: str, seconds: float
) -> Statement:
    """Return a bound as a line of a certificate.

    Args:
        what: What is bounded, as in "the largest ||u_L - u*|| of an episode".
        unit: Its unit; "" for none.
        bound: The bound. One that is infinite bounds nothing, and does not hold.
        where: The law of the episodes, as in "uniform disturbance, d_bar = 0.75".
        seconds: Time that the episodes took [s].
    """
    low, _ = coverage_interval(bound)
    shown = f"{bound.value:.4g} {unit}".strip() if math.isfinite(bound.value) else "not bounded"
    text = (
        f"{what} is at most {shown} in a fresh episode with probability {bound.level:g} "
        f"({where}; split conformal, {bound.count} episodes; given these, at least "
        f"{100.0 * low:.1f} % of fresh episodes with confidence 0.975)"
    )
    return Statement(text, "calibrated", math.isfinite(bound.value), seconds)


def _check_level(value: float, name: str = "level") -> None:
    if not 0.0 < value < 1.0:
        raise ValueError(f"{name}={value!r} must lie between 0 and 1")
