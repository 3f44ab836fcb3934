"""Proof of the condition over a hold: V falls from one control instant to the next."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lagros_envs.dynamics import System
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.regions import BoxRegion
from lagros_policies.contraction.systems import check_polynomial, check_sizes
from lagros_policies.proof.bounds import metric_bounds
from lagros_policies.proof.cells import Search, search
from lagros_policies.proof.families import BoxCondition, Violation, held_ends, hold_matrices
from lagros_policies.proof.sets import Provable, held_triples

# Cells of one pass, and that enclose where a hold ends, about.
_HELD_BATCH = 400
_CELLS = 4096


@dataclass(frozen=True)
class HoldProof:
    """What the search for a proof over a hold came to.

    Attributes:
        search: Of the condition on the set.
        ends: Between what coordinates of x lie at the end of a hold: those of the metric, and those
            that were asked for.
        definite: Whether W_bar is positive definite wherever it ends.
        seconds: Time taken [s].
    """

    search: Search[Violation]
    ends: Mapping[int, tuple[float, float]]
    definite: bool
    seconds: float

    @property
    def proved(self) -> bool:
        """Whether the sampled loop contracts, for infinitesimal errors."""
        return self.search.proved and self.definite


def prove_hold(
    system: System,
    metric: Metric,
    box: BoxRegion | Provable,
    contraction_rate: float | None = None,
    period: float = 0.1,
    *,
    counts: Sequence[int] = (),
    also: Sequence[int] = (),
    most_seconds: float = 60.0,
) -> HoldProof:
    """Prove the condition over a hold of the control, see `families.hold_matrices`.

    Args:
        system: The system.
        metric: The metric.
        box: Where x = x_d and u_d lie; its errors are not used.
        contraction_rate: alpha [1/s]; None for that of the metric.
        period: Hold [s].
        counts: Cells along each coordinate of the set, for where a hold ends; () for some.
        also: Coordinates whose ends are asked for besides those of the metric.
        most_seconds: Processor time after which the search gives up [s].

    Raises:
        TypeError: The metric is no polynomial, or the box of another system.
        ValueError: Metric, box and system do not fit each other, or what matters is not bounded.
    """
    check_polynomial(metric, "prove_hold")
    start = time.monotonic()
    rate = metric.contraction_rate if contraction_rate is None else contraction_rate
    where = held_triples(box, system)
    check_sizes(system, scaling=(metric.scaling, (system.state_dim,)))
    condition = BoxCondition(where, hold_matrices(system, metric, rate, period, where))
    found = search(condition, _HELD_BATCH, 1_000_000, most_seconds)
    bounded = np.isfinite(where.lower) & (where.lower < where.upper)
    some = max(int(_CELLS ** (1.0 / max(bounded.sum(), 1))), 1)
    counts = counts or np.where(bounded, some, 1).tolist()
    begun, ended = held_ends(system, where, period, counts)
    low, high = np.full((2, system.state_dim), [[-np.inf], [np.inf]])
    for index in metric.coordinates:
        both = begun[index], ended[index]
        low[index] = min(part.lower.min() for part in both)
        high[index] = max(part.upper.max() for part in both)
    try:
        metric_bounds(metric, low, high)
        definite = True
    except ValueError:
        definite = False
    reached = {
        index: (float(ended[index].lower.min()), float(ended[index].upper.max()))
        for index in sorted({*metric.coordinates, *also})
    }
    return HoldProof(found, reached, definite, time.monotonic() - start)
