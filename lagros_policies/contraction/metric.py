"""A contraction metric: what it is, and where it was verified."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self, get_args

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_at_least, check_name, check_positive, check_whole
from lagros_policies.contraction.basis import CONSTANT, MOST_DEGREE, Basis, cosines
from lagros_policies.contraction.places import (
    Point,
    along,
    extreme_places,
    places_of,
)
from lagros_policies.contraction.regions import MetricRegion, even_coordinate

# Points of a grid, or states of the region, at which W_bar must be positive definite, and its least
# eigenvalue, of W_bar scaled to a unit diagonal: far above rounding, far below any design.
_POINTS = 101
_PLACES = 1000
_LEAST = 1e-13
# Rounding of W_ij against W_ji, as a share of the largest entry.
_ASYMMETRY = 1e-9


@dataclass(frozen=True)
class Verification:
    """An independent check of the metric on states that the design never saw (observed).

    Attributes:
        samples: States checked.
        violations: How many of them break the contraction condition.
        worst: Largest eigenvalue of the condition's left side, relative to W_bar; negative holds.
        seed: Seed of the states.
    """

    samples: int
    violations: int
    worst: float
    seed: int

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: A count is none, or the worst is not a number.
        """
        check_whole("samples", self.samples)
        check_whole("violations", self.violations, 0)
        check_whole("seed", self.seed, 0)
        if self.violations > self.samples or math.isnan(self.worst):
            raise ValueError(
                f"violations={self.violations!r} of samples={self.samples!r}, worst="
                f"{self.worst!r}: there cannot be more than samples, and the worst is a number"
            )


class DualMetric(Protocol):
    """W_bar(x) and its rate: what the condition of Theorem 2 asks of a metric.

    One with an attribute `point` of "nominal" is a function of x_d, and is given x_d and its
    motion; all others are given x. `coordinates`, where there is one, says which entries of that
    state the metric depends on.
    """

    @property
    def contraction_rate(self) -> float:
        """The contraction rate alpha [1/s]."""

    @property
    def control_weight(self) -> float:
        """nu, the weight of B B' in the condition."""

    def dual(self, state: FloatArray) -> FloatArray:
        """Return W_bar(x), shape (..., n, n), for states (..., n)."""

    def dual_rate(self, state: FloatArray, motion: FloatArray) -> FloatArray:
        """Return dW_bar/dt where the state moves at dx/dt, both (..., n), shape (..., n, n)."""


class ContractionMetric(DualMetric, Protocol):
    """A metric that laws and tubes take: `Metric`, `NeuralMetric` or your own."""

    @property
    def condition_bound(self) -> float:
        """chi, with I <= S W_bar S <= chi I up to a common factor."""

    @property
    def scaling(self) -> FloatArray:
        """Diagonal of S, the units in which chi is measured, shape (n,)."""

    @property
    def region(self) -> MetricRegion:
        """Where the metric was designed."""

    @property
    def verification(self) -> Verification | None:
        """The independent check, or None."""

    def matrix(self, state: FloatArray) -> FloatArray:
        """Return M(x), shape (..., n, n), for states (..., n)."""

    def matrix_rate(self, state: FloatArray, motion: FloatArray) -> FloatArray:
        """Return dM/dt where the state moves at dx/dt, both (..., n), shape (..., n, n)."""

    def verified(self, check: Verification) -> Self:
        """Return the metric with the outcome of a check."""


@dataclass(frozen=True)
class Metric:
    """W_bar = sum_i W_i phi_i, with M = nu W_bar^-1 (Theorem 2).

    Every use of M here is invariant to its scale, so M is given without the factor nu.

    Attributes:
        coefficients: W_i, shape (k, n, n), symmetric.
        contraction_rate: alpha [1/s].
        condition_bound: chi, with I <= S W_bar S <= chi I for the scaling S.
        control_weight: nu, the weight of B B' in the condition.
        scaling: Diagonal of S, the units in which chi is measured, shape (n,).
        region: Where the metric was designed.
        verification: The independent check, or None.
        basis: phi_i; None for a constant metric, and for 1, cos(x_i), ... cos(x_i)^(k-1) of the
            even coordinate of the region, where it has one.
        point: "state", where the phi_i are functions of x, or "nominal", where they are of x_d.

    Raises:
        ValueError: The arrays do not fit each other or are not symmetric, W_bar has another basis
            or region than its states or is not positive definite on the region, or a number is out
            of range.
    """

    coefficients: FloatArray
    contraction_rate: float
    condition_bound: float
    control_weight: float
    scaling: FloatArray
    region: MetricRegion
    verification: Verification | None = None
    basis: Basis | None = None
    point: Point = "state"

    def __post_init__(self) -> None:
        shape = self.coefficients.shape
        fits = len(shape) == 3 and shape[1] == shape[2] and self.scaling.shape == shape[1:2]
        if not fits or 0 in shape:
            raise ValueError(
                f"coefficients of shape {shape} and scaling of shape {self.scaling.shape} "
                "must be (k, n, n) and (n,)"
            )
        self._check_basis(shape)
        if not np.all(np.isfinite(self.coefficients)):
            raise ValueError("coefficients must be finite: there is an infinity or no number")
        for name in ("contraction_rate", "condition_bound", "control_weight"):
            check_positive(name, getattr(self, name))
        for entry in self.scaling:
            check_positive("scaling", float(entry))
        check_at_least("condition_bound", self.condition_bound, 1)
        self._check_definite()

    def _check_basis(self, shape: tuple[int, ...]) -> None:
        count, size = shape[:2]
        check_name("point", self.point, get_args(Point))
        if self.basis is None:
            if count > 1 and even_coordinate(self.region) is None:
                raise ValueError(
                    f"coefficients of shape {shape}: without a basis W_bar is constant, or of the "
                    f"even coordinate of a region, and a {type(self.region).__name__} has none: "
                    "name the basis, or give one coefficient"
                )
            if count > MOST_DEGREE + 1:
                raise ValueError(f"coefficients: degree {count - 1} must be at most {MOST_DEGREE}")
        if self.phi.size != count:
            raise ValueError(
                f"coefficients of shape {shape} are {count}, and the basis has {self.phi.size} "
                "functions"
            )
        if self.phi.degree and max(self.coordinates) >= size:
            raise ValueError(
                f"basis: x[{max(self.coordinates)}] is none of the {size} states of "
                f"coefficients of shape {shape}"
            )

    def _check_definite(self) -> None:
        crossed = np.swapaxes(self.coefficients, 1, 2)
        largest = np.abs(self.coefficients).max(axis=(1, 2), keepdims=True)
        if np.any(np.abs(self.coefficients - crossed) > _ASYMMETRY * largest):
            raise ValueError("coefficients: every W_i must be symmetric; average it with W_i'")
        places = places_of(self.region, self.phi, self.point, len(self.scaling), _POINTS, _PLACES)
        dual = self.dual(places)
        sizes = np.einsum("sii->si", dual)
        worst = int(np.argmin(sizes.min(axis=1)))
        least = float(sizes[worst].min())
        if least > 0.0:
            root = np.sqrt(sizes)
            values = np.linalg.eigvalsh(dual / (root[:, :, None] * root[:, None, :]))[:, 0]
            worst = int(np.argmin(values))
            least = float(values[worst])
        if not least > _LEAST:
            raise ValueError(
                f"coefficients: W_bar is not positive definite{self._where(places[worst])} (least "
                f"eigenvalue about {least:.3g}), so that e'W_bar^-1 e measures no distance: check "
                "their signs"
            )

    def _where(self, place: FloatArray) -> str:
        if self.phi == CONSTANT:
            return ""
        named = ", ".join(f"x[{index}]={place[index]:.4g}" for index in self.coordinates)
        return f" at {named} of the region"

    @cached_property
    def phi(self) -> Basis:
        """The functions phi_i."""
        return self.basis or default_basis(self.region, len(self.coefficients) - 1)

    @property
    def degree(self) -> int:
        """Largest sum of the powers in one phi_i; zero of a constant metric."""
        return self.phi.degree

    @property
    def coordinates(self) -> tuple[int, ...]:
        """Which entries of x, or of x_d, W_bar depends on."""
        return self.phi.coordinates

    def dual(self, state: FloatArray) -> FloatArray:
        """Return W_bar at x, or x_d, of shape (..., n), shape (..., n, n)."""
        self._check_width(state)
        if self.degree == 0:
            return np.tile(self.coefficients[0], (*np.shape(state)[:-1], 1, 1))
        value: FloatArray = np.einsum("...i,ijk->...jk", self.phi.at(state), self.coefficients)
        return value

    def dual_rate(self, state: FloatArray, motion: FloatArray) -> FloatArray:
        """Return dW_bar/dt where the state moves at dx/dt, both (..., n), shape (..., n, n)."""
        self._check_width(state)
        self._check_width(motion)
        if self.degree == 0:
            return np.zeros((*np.shape(state), len(self.scaling)))
        value: FloatArray = np.einsum(
            "...i,ijk->...jk", self.phi.rate(state, motion), self.coefficients
        )
        return value

    def matrix(self, state: FloatArray) -> FloatArray:
        """Return M = W_bar^-1 at x, or x_d, of shape (..., n), shape (..., n, n)."""
        return np.asarray(np.linalg.inv(self.dual(state)), dtype=np.float64)

    def matrix_rate(self, state: FloatArray, motion: FloatArray) -> FloatArray:
        """Return dM/dt = -M (dW_bar/dt) M where the state moves at dx/dt, shape (..., n, n)."""
        matrix = self.matrix(state)
        return -matrix @ self.dual_rate(state, motion) @ matrix

    def _check_width(self, state: FloatArray) -> None:
        if np.shape(state)[-1:] != self.scaling.shape:
            raise ValueError(
                f"states of shape {np.shape(state)} must be (..., {len(self.scaling)}): the metric "
                f"is of {len(self.scaling)} states"
            )

    def verified(self, check: Verification) -> Self:
        """Return the metric with the outcome of a check."""
        return replace(self, verification=check)


def default_basis(region: MetricRegion, degree: int) -> Basis:
    """Return the basis of a metric that names none: powers of the cosine of the even coordinate."""
    even = even_coordinate(region)
    return CONSTANT if even is None or degree == 0 else cosines(even[0], degree)


def metric_place(metric: Any, state: FloatArray, nominal: FloatArray) -> FloatArray:
    """Return what a metric is a function of: x_d where its `point` is "nominal", else x."""
    return nominal if getattr(metric, "point", "state") == "nominal" else state


def metric_is_still(metric: ContractionMetric) -> bool:
    """Return whether M is known not to answer to x: it is constant, or a function of x_d."""
    nominal: bool = getattr(metric, "point", "state") == "nominal"
    return nominal or getattr(metric, "coordinates", None) == ()


def drawn_places(metric: ContractionMetric) -> FloatArray:
    """Return states that cover what a metric depends on in its region, shape (s, n)."""
    size = len(metric.scaling)
    if getattr(metric, "coordinates", None) == ():
        return np.zeros((1, size))
    drawn = metric.region.sample(np.random.default_rng(0), _PLACES)
    return metric_place(metric, drawn.state, drawn.nominal)


def extreme_eigenvalues(metric: ContractionMetric, points: int = 401) -> tuple[float, float]:
    """Return the extreme eigenvalues of M over its region (observed).

    Of a metric of the even coordinate of its region by a grid, of every other by a search that
    begins with random states.

    Args:
        metric: The metric; on a region that is even in a coordinate a constant one, or one of that
            coordinate alone.
        points: Values of that coordinate from 0 to the largest, each with both signs.

    Raises:
        ValueError: The metric depends on more than that, or is not positive definite.
    """
    check_at_least("points", points, 2)
    region, even = metric.region, even_coordinate(metric.region)
    places = getattr(metric, "coordinates", ())
    if even is not None and set(places) <= {even[0]}:
        half = np.linspace(0.0, even[1], points)
        values = np.linalg.eigvalsh(
            np.concatenate([matrices_along(metric, half), matrices_along(metric, -half)])
        )
    else:
        ends = extreme_places(region, metric.dual, getattr(metric, "point", "state"))
        values = np.concatenate([np.linalg.eigvalsh(metric.matrix(place)) for place in ends])
    if not values.min() > 0.0:
        raise ValueError(f"{metric!r} is not positive definite on its region: it is no metric")
    return float(values.min()), float(values.max())


def matrices_along(metric: ContractionMetric, values: FloatArray) -> FloatArray:
    """Return M at values (s,) of the even coordinate of its region, shape (s, n, n).

    Raises:
        ValueError: The region has none, or at other states with these values M is another.
    """
    size = len(metric.scaling)
    if getattr(metric, "coordinates", None) == ():
        return metric.matrix(np.zeros((len(values), size)))
    coordinate, _ = even_region(metric)
    states = along(values, coordinate, size)
    matrix = metric.matrix(states)
    elsewhere = np.random.default_rng(0).uniform(-1.0, 1.0, states.shape)
    elsewhere[:, coordinate] = states[:, coordinate]
    if not np.allclose(metric.matrix(elsewhere), matrix, rtol=1e-9, atol=0.0):
        raise ValueError(
            f"{metric!r} depends on more of the state than x[{coordinate}], in which its region is "
            "even: values of that one say nothing of it elsewhere"
        )
    return matrix


def even_region(metric: ContractionMetric) -> tuple[int, float]:
    """Return in which coordinate a metric's region is symmetric, and how far that reaches.

    Raises:
        ValueError: It is in none.
    """
    even = even_coordinate(metric.region)
    if even is None:
        raise ValueError(
            f"the metric's region, a {type(metric.region).__name__}, is even in no coordinate: "
            "this is for metrics of that one alone"
        )
    return even
