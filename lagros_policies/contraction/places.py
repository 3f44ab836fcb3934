"""The states that stand for what a metric depends on: on a grid, or drawn from a region."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.contraction.basis import CONSTANT, Basis
from lagros_policies.contraction.regions import (
    MetricRegion,
    Samples,
    even_coordinate,
    search_region,
)

# Whether W_bar is a function of x or of x_d.
Point = Literal["state", "nominal"]


def places_of(
    region: MetricRegion, basis: Basis, point: Point, size: int, points: int, count: int
) -> FloatArray:
    """Return states that cover what W_bar depends on in a region, shape (s, size).

    Args:
        region: The region.
        basis: phi_i of W_bar.
        point: What they are functions of.
        size: Number n of states.
        points: States for a metric that is even in the even coordinate of the region: from 0 on.
        count: States for any other that is not constant, drawn from the region.

    Raises:
        ValueError: The region is of other states.
    """
    if basis == CONSTANT:
        return np.zeros((1, size))
    reach = even_reach(region, basis)
    drawn = region.sample(np.random.default_rng(0), count if reach is None else 1)
    if drawn.state.shape[1] != size:
        raise ValueError(
            f"region: it is of {drawn.state.shape[1]} states, and the metric is of {size}: give a "
            "BoxRegion or PlanRegion of these"
        )
    if reach is not None:
        return along(np.linspace(0.0, reach, points), basis.coordinates[0], size)
    return drawn.nominal if point == "nominal" else drawn.state


def extreme_places(
    region: MetricRegion, dual: Callable[[FloatArray], FloatArray], point: Point
) -> list[FloatArray]:
    """Return where W_bar has its least and its largest eigenvalues on a region (observed).

    Args:
        region: The region.
        dual: From states (s, n) to W_bar (s, n, n).
        point: What W_bar is a function of.

    Returns:
        States (s, n) that the search for each of the two ended at, the most extreme first.
    """

    def spectrum(drawn: Samples) -> FloatArray:
        place = drawn.nominal if point == "nominal" else drawn.state
        return np.asarray(np.linalg.eigvalsh(dual(place)), dtype=np.float64)

    found = []
    for score in (lambda drawn: -spectrum(drawn)[:, 0], lambda drawn: spectrum(drawn)[:, -1]):
        ended, _ = search_region(region, score, np.random.default_rng(0))
        found.append(ended.nominal if point == "nominal" else ended.state)
    return found


def along(values: FloatArray, coordinate: int, size: int) -> FloatArray:
    """Return states (..., size) that are zero but for the values (...) of one coordinate."""
    states = np.zeros((*np.shape(values), size))
    states[..., coordinate] = values
    return states


def is_on_grid(region: MetricRegion, basis: Basis) -> bool:
    """Return whether `places_of` covers a region without drawing from it."""
    return basis == CONSTANT or even_reach(region, basis) is not None


def even_reach(region: MetricRegion, basis: Basis) -> float | None:
    """Return how far the even coordinate reaches of which W_bar is a polynomial of the cosine."""
    even = even_coordinate(region)
    return None if even is None or basis.cosine != even[0] else even[1]
