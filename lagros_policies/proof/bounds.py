"""Bounds of a metric, of its slope and of B over continuous boxes, by intervals."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_at_least
from lagros_envs.dynamics import System
from lagros_envs.numbers import Interval, Series, exact, variable
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.systems import check_polynomial, check_sizes
from lagros_policies.proof.cells import grid
from lagros_policies.proof.enclosures import NOTHING, constant, enclosed_metric, slopes
from lagros_policies.proof.matrices import negative_definite

# Above what sampling finds by this share, so that the intervals can show it.
_ROOM = 1.01


@dataclass(frozen=True)
class ProvedBounds:
    """Bounds that hold on a whole box of states.

    Attributes:
        least: least I <= S W_bar S.
        largest: S W_bar S <= largest I.
        control_gain: b_bar, bound of ||B(x)||.
        seconds: Time taken [s].
    """

    least: float
    largest: float
    control_gain: float
    seconds: float = 0.0

    @property
    def condition(self) -> float:
        """A bound of chi, the condition number in the units of the scaling S."""
        return math.nextafter(self.largest / self.least, math.inf)


def prove_bounds(
    system: System,
    metric: Metric,
    low: ArrayLike,
    high: ArrayLike,
    cells: int = 2000,
) -> ProvedBounds:
    """Enclose the eigenvalues of S W_bar S and the norm of B over a box of states.

    Args:
        system: The system.
        metric: The metric.
        low: Least x, and x_d, shape (n,); infinite where neither W_bar nor B depends on it.
        high: Largest, likewise.
        cells: Cells of the box, in the coordinates that matter.

    Raises:
        TypeError: The metric is no polynomial.
        ValueError: W_bar cannot be shown to be positive definite with so many cells, or what
            matters is not bounded.
    """
    check_polynomial(metric, "prove_bounds")
    box = np.array([low, high], dtype=np.float64)
    check_sizes(system, low=(box[0], (system.state_dim,)), high=(box[1], (system.state_dim,)))
    start = time.monotonic()
    least, largest = metric_bounds(metric, low, high, cells)
    gain = _control_gain(system, box, cells)
    return ProvedBounds(least, largest, gain, time.monotonic() - start)


def metric_bounds(
    metric: Metric, low: ArrayLike, high: ArrayLike, cells: int = 2000
) -> tuple[float, float]:
    """Return bounds of the eigenvalues of S W_bar S on a box of states; see `prove_bounds`."""
    check_at_least("cells", cells, 1)
    box = np.array([low, high], dtype=np.float64)
    places = _cut(box, metric.coordinates, cells)
    dual = _near_middle(metric, places)
    # S_i S_j rounds; as an interval it is enclosed.
    scaled = dual * exact(metric.scaling[:, None]) * metric.scaling[None, :]
    values = np.linalg.eigvalsh(scaled.midpoint)
    # Weyl: the eigenvalues move by no more than the largest row sum of the radii.
    scale = metric.scaling[:, None] * metric.scaling[None, :]
    slack = float(scaled.radius.sum(axis=-1).max()) + 1e-9 * float(np.abs(scale).max())
    least, largest = float(values.min()) - slack, float(values.max()) + slack
    identity = np.eye(len(metric.scaling))
    proved = negative_definite(scaled - largest * identity) & negative_definite(
        least * identity - scaled
    )
    if least <= 0.0 or not np.all(proved):
        raise ValueError(
            f"W_bar is not shown to be positive definite on {_named(box, metric.coordinates)} with "
            f"cells={cells}: use more cells, or another metric"
        )
    return least, largest


def metric_drift(metric: Metric, low: float, high: float, cells: int = 2000) -> float:
    """Return a proved kappa with -kappa W <= dW/dx_i <= kappa W, of a metric of one coordinate x_i.

    Args:
        metric: The metric; for a constant one kappa is zero.
        low: Least x_i.
        high: Largest x_i.
        cells: Equal intervals of x_i.

    Raises:
        TypeError: The metric is no polynomial.
        ValueError: It is of several coordinates, or kappa cannot be shown with so many cells.
    """
    check_polynomial(metric, "metric_drift")
    check_at_least("cells", cells, 1)
    if len(metric.coordinates) > 1:
        raise ValueError(
            f"the metric is of the coordinates {metric.coordinates}: metric_drift is for one of a "
            "single coordinate"
        )
    if metric.degree == 0:
        return 0.0
    box = np.zeros((2, len(metric.scaling)))
    box[:, metric.coordinates[0]] = low, high
    places = _cut(box, metric.coordinates, cells)
    dual, slope = (_near_middle(metric, places, order) for order in (0, 1))
    values, vectors = np.linalg.eigh(dual.midpoint)
    if values.min() <= 0.0:
        where = _named(box, metric.coordinates)
        raise ValueError(f"W_bar is not positive definite on {where}")
    root = vectors / np.sqrt(values)[:, None, :]
    relative = np.swapaxes(root, -1, -2) @ slope.midpoint @ root
    found = float(np.abs(np.linalg.eigvalsh(relative)).max())
    for room in (_ROOM, _ROOM**5, _ROOM**20):
        bound = dual * (found * room)
        if np.all(negative_definite(slope - bound) & negative_definite(-slope - bound)):
            return found * room
    raise ValueError(f"kappa={found:.3g} is not shown with cells={cells}: use more cells")


def _cut(box: FloatArray, coordinates: Sequence[int], cells: int) -> Interval:
    """Cut a box (2, n) along some coordinates; shape (k, n), the others at their middle or zero."""
    if not np.all(np.isfinite(box[:, list(coordinates)])):
        raise ValueError(f"{_named(box, coordinates)} is not bounded: give it bounds")
    count = math.ceil(cells ** (1.0 / max(len(coordinates), 1)))
    bounded = np.where(np.isfinite(box).all(axis=0), box, 0.0)
    middle = 0.5 * (bounded[0] + bounded[1])
    low, high = middle.copy(), middle.copy()
    low[list(coordinates)], high[list(coordinates)] = box[:, list(coordinates)]
    counts = [count if index in coordinates else 1 for index in range(box.shape[1])]
    return grid(low, high, tuple(counts))


def _near_middle(metric: Metric, cells: Interval, order: int = 0) -> Interval:
    """Enclose W_bar over cells (k, n), or its slope along its one coordinate, about the middle."""
    middle = cells.midpoint
    here = [variable(exact(middle[:, index]), order + 1) for index in range(cells.shape[1])]
    dual = _derivative(enclosed_metric(metric, here), order)
    for index in metric.coordinates:
        near = [
            variable(cells[:, place], order + 1)
            if place == index
            else constant(cells[:, place], order + 1)
            for place in range(cells.shape[1])
        ]
        gap = (cells[:, index] - middle[:, index])[:, None, None]
        dual = dual + _derivative(enclosed_metric(metric, near), order + 1) * gap
    return dual


def _derivative(dual: Series | Interval, order: int) -> Interval:
    return dual if isinstance(dual, Interval) else dual.derivative(order)


def _control_gain(system: System, box: FloatArray, cells: int) -> float:
    """Bound ||B|| over a box (2, n)."""
    n = system.state_dim

    def gain(cells: Interval, moving: int | None) -> Series:
        places = [
            variable(cells[:, index], 1) if index == moving else constant(cells[:, index], 1)
            for index in range(n)
        ]
        return slopes(system, places, [constant(0.0, 1)] * system.control_dim)[1]

    # Where it is not bounded B must not depend on it: there any interval will do to see that.
    some = np.where(np.isfinite(box), box, [[-1.0], [1.0]])
    matters = []
    for index in range(n):
        try:
            slope = gain(Interval(*some[:, None, :]), index).parts[1]
            largest = max(np.abs(slope.lower).max(), np.abs(slope.upper).max())
        except ZeroDivisionError:
            largest = math.inf
        if largest > NOTHING:
            matters.append(index)
    found = gain(_cut(box, matters, cells), None).parts[0]
    size = np.maximum(np.abs(found.lower), np.abs(found.upper))
    frobenius = np.sqrt(np.sum(size**2, axis=(-1, -2)))
    spectral = np.linalg.norm(found.midpoint, ord=2, axis=(-1, -2))
    spectral = spectral + np.linalg.norm(found.radius, axis=(-1, -2))
    return float(np.minimum(frobenius, spectral).max()) * (1.0 + 1e-12)


def _named(box: FloatArray, coordinates: Sequence[int]) -> str:
    """Return the bounds of some coordinates in words."""
    if not len(coordinates):
        return "any box"
    return ", ".join(f"{box[0, i]:.6g} <= x[{i}] <= {box[1, i]:.6g}" for i in coordinates)
