"""Enclosures of a motion's slopes, of the map of a hold and of a metric, as series or intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import comb
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import System
from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.numbers import Dual, Interval, Series, exact, functions
from lagros_policies.contraction.metric import Metric
from lagros_policies.proof.matrices import matmul, transpose

# A derivative below this is that of a function which does not depend on its argument: intervals
# add as much to a zero, and no proof of definiteness is as close.
NOTHING = 1e-200


def constant(value: Any, order: int) -> Series:
    """Return the series of a number that does not change."""
    first = value if isinstance(value, Interval) else exact(value)
    return Series([first, *[exact(np.zeros(first.shape))] * order])


def indexed(one: Series, index: Any) -> Series:
    """Index every coefficient of a series, as an array."""
    return Series([part[index] for part in one.parts])


def product(left: Series, right: Series) -> Series:
    """Enclose the products of two series of matrices."""
    parts = []
    for order in range(len(left.parts)):
        total = matmul(left.parts[0], right.parts[order])
        for index in range(1, order + 1):
            total = total + matmul(left.parts[index], right.parts[order - index])
        parts.append(total)
    return Series(parts)


def transposed(matrix: Series) -> Series:
    """Return the transposes of a series of matrices."""
    return Series([transpose(part) for part in matrix.parts])


def twice_symmetric(matrix: Series) -> Series:
    """Enclose M + M' for a series of matrices."""
    return matrix + transposed(matrix)


def slopes(
    system: System, state: Sequence[Series], control: Sequence[Series]
) -> tuple[Series, Series]:
    """Enclose d(f + Bu)/dx and B, series of shapes (..., n, n) and (..., n, m).

    Args:
        system: The system.
        state: x, n series of shapes that broadcast.
        control: u, m of them.
    """
    n = system.state_dim
    _, gradient = _differentiated(
        lambda x: system.derivative(x[:n], x[n:], functions), [*state, *control]
    )
    return indexed(gradient, (..., slice(n))), indexed(gradient, (..., slice(n, None)))


def held_slopes(
    system: System, state: Sequence[Series], control: Sequence[Series], period: float
) -> tuple[list[Series], Series, Series]:
    """Enclose the Runge-Kutta map of a hold and its slopes.

    Args:
        system: The system.
        state: x, n series of shapes that broadcast.
        control: u, m of them.
        period: Hold [s].

    Returns:
        The state at the end, n series, and dF/dx (..., n, n) and dF/du (..., n, m).
    """
    n = system.state_dim
    ended, gradient = _differentiated(
        lambda x: rk4_hold(system, x[:n], x[n:], [0.0] * n, period, functions),
        [*state, *control],
    )
    return ended, indexed(gradient, (..., slice(n))), indexed(gradient, (..., slice(n, None)))


def _differentiated(
    function: Callable[[Sequence[Any]], Sequence[Any]], places: Sequence[Series]
) -> tuple[list[Series], Series]:
    """Return what a function gives at series, and its derivatives by each, (..., rows, places)."""
    order = len(places[0].parts) - 1
    shape = np.broadcast_shapes(*[place.parts[0].shape for place in places])
    seeds = []
    for index, place in enumerate(places):
        unit = np.zeros((len(places), *[1] * len(shape)))
        unit[index] = 1.0
        seeds.append(Dual(place, constant(unit, order)))
    found = [
        one if isinstance(one, Dual) else Dual(constant(np.asarray(one, float), order), None)
        for one in function(seeds)
    ]
    parts = []
    for k in range(order + 1):
        lower, upper = np.zeros((2, *shape, len(found), len(places)))
        for row, one in enumerate(found):
            if one.gradient is not None:
                part = one.gradient.parts[k]
                lower[..., row, :] = np.moveaxis(_filled(part.lower, len(shape)), 0, -1)
                upper[..., row, :] = np.moveaxis(_filled(part.upper, len(shape)), 0, -1)
        parts.append(Interval(lower, upper))
    return [one.value for one in found], Series(parts)


def _filled(gradient: FloatArray, dimensions: int) -> FloatArray:
    """Return a gradient (p, ...) with a dimension of one for each that it lacks."""
    return gradient.reshape(
        len(gradient), *[1] * (dimensions + 1 - gradient.ndim), *gradient.shape[1:]
    )


def enclosed_metric(metric: Metric, place: Sequence[Any]) -> Any:
    """Enclose W_bar at a place, n series or duals of series, as one of shape (..., n, n).

    The sum is expanded about the middle of each of its factors, itself by intervals: coefficients
    may be large and of both signs, and intervals would not see that they cancel.
    """
    factors = sorted({factor[:2] for term in metric.phi.factors for factor in term})
    weights: dict[tuple[int, ...], Interval] = {}
    for term, coefficient in zip(metric.phi.factors, metric.coefficients, strict=True):
        powers = {factor[:2]: factor[2] for factor in term}
        weights[tuple(powers.get(one, 0) for one in factors)] = exact(coefficient)
    gaps = []
    for index, (name, coordinate) in enumerate(factors):
        value = place[coordinate]
        value = getattr(functions, name)(value) if name else value
        centre = (value.value if isinstance(value, Dual) else value).parts[0].midpoint
        gap = value - centre
        if isinstance(gap, Dual):
            gap = Dual(*(indexed(part, (..., None, None)) for part in (gap.value, gap.gradient)))
        else:
            gap = indexed(gap, (..., None, None))
        gaps.append(gap)
        weights = _shifted(weights, index, centre)
    return _horner(weights, gaps)


def _shifted(
    weights: dict[tuple[int, ...], Interval], index: int, centre: FloatArray
) -> dict[tuple[int, ...], Interval]:
    """Return a polynomial's coefficients by powers of one variable less its centre."""
    degree = max(power[index] for power in weights)
    powers = [exact(np.ones((*centre.shape, 1, 1)))]
    for _ in range(degree):
        powers.append(powers[-1] * centre[..., None, None])
    moved: dict[tuple[int, ...], Interval] = {}
    for power in sorted(weights):
        for order in range(power[index] + 1):
            # The binomial is a small integer; its product with a weight rounds.
            weight = weights[power]
            if order < power[index]:
                weight = weight * float(comb(power[index], order))
            part = powers[power[index] - order] * weight
            key = (*power[:index], order, *power[index + 1 :])
            moved[key] = moved[key] + part if key in moved else part
    return moved


def _horner(weights: dict[tuple[int, ...], Interval], gaps: Sequence[Any]) -> Any:
    """Evaluate a polynomial, variable by variable."""
    if not gaps:
        return weights[()]
    total: Any = None
    for order in reversed(range(1 + max(power[0] for power in weights))):
        inner = {power[1:]: weight for power, weight in weights.items() if power[0] == order}
        one = _horner(inner, gaps[1:]) if inner else None
        total = one if total is None else total * gaps[0]
        if one is not None and total is not one:
            total = total + one
    return total
