"""A contraction metric: what it is, and where it was verified."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_at_least, check_positive, check_whole
from lagros_envs.dynamics.cartpole import ANGLE, ANGULAR_RATE

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_STATES = 4  # of a metric of the angle: [p, theta, dp/dt, dtheta/dt]
# Far beyond any design, and far below where binomials overflow.
_MOST_DEGREE = 40
# Angles at which W_bar must be positive definite, and its least eigenvalue, of W_bar scaled to a
# unit diagonal: far above rounding, far below any design.
_ANGLES = 101
_LEAST = 1e-13
# Rounding of W_ij against W_ji, as a share of the largest entry.
_ASYMMETRY = 1e-9


@dataclass(frozen=True)
class Region:
    """The states and errors for which a cart-pole metric was designed and checked.

    The check draws triples (x, x_d, u_d) around plans and keeps those that lie within these bounds.
    On a plan the force goes with the angle, so that this covers a part of the bounds only: taken as
    a box of independent numbers they hold states at which the shipped metric fails. `prove` says
    what holds on a whole box. Neither the metric nor its condition depends on the position, and
    that of x_d's speed is bounded by the plans alone.

    Attributes:
        angle: Largest |theta| of x and of x_d [rad].
        angular_rate: Largest |dtheta/dt| of x and of x_d [rad/s].
        angle_error: Largest |theta - theta_d| [rad].
        angular_rate_error: Largest error of the rate [rad/s].
        force: Largest |u_d| [N].

    Raises:
        ValueError: A bound is not positive, or the angle reaches pi/2.
    """

    angle: float = 1.15
    angular_rate: float = 4.0
    angle_error: float = 0.35
    angular_rate_error: float = 2.0
    force: float = 40.0

    def __post_init__(self) -> None:
        """Check the bounds."""
        for item in fields(self):
            check_positive(item.name, getattr(self, item.name))
        if self.angle >= math.pi / 2:
            raise ValueError(
                f"angle={self.angle!r} must be below pi/2, where the force loses its authority"
            )

    def contains(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> BoolArray:
        """Return which triples (x, x_d, u_d) of a batch (..., 4), (..., 4), (..., 1) lie inside.

        Raises:
            ValueError: They are not of the cart-pole's four states and one control.
        """
        shapes = [np.shape(part)[-1:] for part in (state, nominal, nominal_control)]
        if shapes != [(_STATES,), (_STATES,), (1,)]:
            raise ValueError(
                f"states and control end in {shapes}: a Region bounds the cart-pole's four states "
                "[p, theta, dp/dt, dtheta/dt] and one force"
            )
        error = np.abs(state - nominal)
        inside = np.abs(nominal_control[..., 0]) <= self.force
        for point in (state, nominal):
            inside &= np.abs(point[..., ANGLE]) <= self.angle
            inside &= np.abs(point[..., ANGULAR_RATE]) <= self.angular_rate
        inside &= error[..., ANGLE] <= self.angle_error
        inside &= error[..., ANGULAR_RATE] <= self.angular_rate_error
        return inside


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
    """W_bar(x) and its rate: what the condition of Theorem 2 asks of a metric."""

    @property
    def contraction_rate(self) -> float:
        """The contraction rate alpha [1/s]."""

    @property
    def control_weight(self) -> float:
        """nu, the weight of B B' in the condition."""

    def dual(self, state: FloatArray) -> FloatArray:
        """Return W_bar(x), shape (..., n, n), for states (..., n)."""

    def dual_rate(self, state: FloatArray) -> FloatArray:
        """Return dW_bar/dt along dtheta/dt of the state, shape (..., n, n)."""


class ContractionMetric(DualMetric, Protocol):
    """A metric of the angle that laws and tubes take: `Metric`, `NeuralMetric` or your own."""

    @property
    def condition_bound(self) -> float:
        """chi, with I <= S W_bar S <= chi I up to a common factor."""

    @property
    def scaling(self) -> FloatArray:
        """Diagonal of S, the units in which chi is measured, shape (n,)."""

    @property
    def region(self) -> Region:
        """Where the metric was designed."""

    @property
    def verification(self) -> Verification | None:
        """The independent check, or None."""

    def matrix(self, state: FloatArray) -> FloatArray:
        """Return M(x), shape (..., n, n), for states (..., n)."""

    def matrix_rate(self, state: FloatArray) -> FloatArray:
        """Return dM/dt along dtheta/dt of the state, shape (..., n, n)."""

    def verified(self, check: Verification) -> Self:
        """Return the metric with the outcome of a check."""


@dataclass(frozen=True)
class Metric:
    """W_bar(theta) = sum_i W_i cos(theta)^i, with M = nu W_bar^-1 (Theorem 2).

    Every use of M here is invariant to its scale, so M is given without the factor nu.

    Attributes:
        coefficients: W_i, shape (degree + 1, n, n), symmetric.
        contraction_rate: alpha [1/s].
        condition_bound: chi, with I <= S W_bar S <= chi I for the scaling S.
        control_weight: nu, the weight of B B' in the condition.
        scaling: Diagonal of S, the units in which chi is measured, shape (n,).
        region: Where the metric was designed.
        verification: The independent check, or None.

    Raises:
        ValueError: The arrays do not fit each other or are not symmetric, W_bar depends on the
            angle of other than four states or is not positive definite at the angles of the region,
            or a number is out of range.
    """

    coefficients: FloatArray
    contraction_rate: float
    condition_bound: float
    control_weight: float
    scaling: FloatArray
    region: Region
    verification: Verification | None = None

    def __post_init__(self) -> None:
        """Check the arrays."""
        shape = self.coefficients.shape
        fits = len(shape) == 3 and shape[1] == shape[2] and self.scaling.shape == shape[1:2]
        if not fits or 0 in shape:
            raise ValueError(
                f"coefficients of shape {shape} and scaling of shape {self.scaling.shape} "
                "must be (degree + 1, n, n) and (n,)"
            )
        if self.degree > 0 and shape[1] != _STATES:
            raise ValueError(
                f"coefficients of shape {shape}: a W_bar of the angle is of the four states "
                "[p, theta, dp/dt, dtheta/dt]; one of other states is constant, with degree 0"
            )
        if self.degree > _MOST_DEGREE:
            raise ValueError(f"coefficients: degree {self.degree} must be at most {_MOST_DEGREE}")
        if not np.all(np.isfinite(self.coefficients)):
            raise ValueError("coefficients must be finite: there is an infinity or no number")
        for name in ("contraction_rate", "condition_bound", "control_weight"):
            check_positive(name, getattr(self, name))
        for entry in self.scaling:
            check_positive("scaling", float(entry))
        check_at_least("condition_bound", self.condition_bound, 1)
        self._check_definite()

    def _check_definite(self) -> None:
        crossed = np.swapaxes(self.coefficients, 1, 2)
        largest = np.abs(self.coefficients).max(axis=(1, 2), keepdims=True)
        if np.any(np.abs(self.coefficients - crossed) > _ASYMMETRY * largest):
            raise ValueError("coefficients: every W_i must be symmetric; average it with W_i'")
        angles = np.linspace(0.0, self.region.angle, _ANGLES) if self.degree else np.zeros(1)
        dual = self.dual(at_angles(angles, len(self.scaling)))
        sizes = np.einsum("sii->si", dual)
        worst = int(np.argmin(sizes.min(axis=1)))
        least = float(sizes[worst].min())
        if least > 0.0:
            root = np.sqrt(sizes)
            values = np.linalg.eigvalsh(dual / (root[:, :, None] * root[:, None, :]))[:, 0]
            worst = int(np.argmin(values))
            least = float(values[worst])
        if not least > _LEAST:
            where = f" at the angle {angles[worst]:.4g} rad of the region" if self.degree else ""
            raise ValueError(
                f"coefficients: W_bar is not positive definite{where} (least eigenvalue about "
                f"{least:.3g}), so that e'W_bar^-1 e measures no distance: check their signs"
            )

    @property
    def degree(self) -> int:
        """Degree of W_bar in cos(theta)."""
        return len(self.coefficients) - 1

    @property
    def depends_on_angle(self) -> bool:
        """Whether W_bar depends on state 1, whose rate is taken to be state 3."""
        return self.degree > 0

    def dual(self, state: FloatArray) -> FloatArray:
        """Return W_bar(x), shape (..., n, n), for states (..., n)."""
        self._check_width(state)
        if self.degree == 0:
            return np.tile(self.coefficients[0], (*np.shape(state)[:-1], 1, 1))
        powers = basis(state[..., ANGLE], self.degree)
        value: FloatArray = np.einsum("...i,ijk->...jk", powers, self.coefficients)
        return value

    def dual_rate(self, state: FloatArray) -> FloatArray:
        """Return dW_bar/dt along dtheta/dt of the state, shape (..., n, n)."""
        self._check_width(state)
        if self.degree == 0:
            return np.zeros((*np.shape(state), len(self.scaling)))
        value: FloatArray = np.einsum(
            "...i,ijk->...jk",
            basis_rate(state[..., ANGLE], state[..., ANGULAR_RATE], self.degree),
            self.coefficients,
        )
        return value

    def matrix(self, state: FloatArray) -> FloatArray:
        """Return M(x) = W_bar(x)^-1, shape (..., n, n), for states (..., n)."""
        return np.asarray(np.linalg.inv(self.dual(state)), dtype=np.float64)

    def matrix_rate(self, state: FloatArray) -> FloatArray:
        """Return dM/dt = -M (dW_bar/dt) M, shape (..., n, n)."""
        matrix = self.matrix(state)
        return -matrix @ self.dual_rate(state) @ matrix

    def _check_width(self, state: FloatArray) -> None:
        if np.shape(state)[-1:] != self.scaling.shape:
            raise ValueError(
                f"states of shape {np.shape(state)} must be (..., {len(self.scaling)}): the metric "
                f"is of {len(self.scaling)} states"
            )

    def verified(self, check: Verification) -> Self:
        """Return the metric with the outcome of a check."""
        return replace(self, verification=check)


def extreme_eigenvalues(metric: ContractionMetric, points: int = 401) -> tuple[float, float]:
    """Return the extreme eigenvalues of M over a grid of the region's angles (observed).

    Args:
        metric: A metric that is constant, or of the angle alone.
        points: Angles from 0 to the region's largest, each with both signs.

    Raises:
        ValueError: The metric depends on more than the angle, or is not positive definite.
    """
    check_at_least("points", points, 2)
    angles = np.linspace(0.0, metric.region.angle, points)
    values = np.linalg.eigvalsh(
        np.concatenate([matrices_at(metric, angles), matrices_at(metric, -angles)])
    )
    if not values.min() > 0.0:
        raise ValueError(f"{metric!r} is not positive definite on its region: it is no metric")
    return float(values.min()), float(values.max())


def at_angles(angles: FloatArray, size: int) -> FloatArray:
    """Return states (..., size) at angles (...), zero but for the angle where there is one."""
    states = np.zeros((*np.shape(angles), size))
    if size > ANGLE:
        states[..., ANGLE] = angles
    return states


def matrices_at(metric: ContractionMetric, angles: FloatArray) -> FloatArray:
    """Return M at angles (s,), shape (s, n, n), for a metric of nothing but the angle.

    Raises:
        ValueError: At other states with these angles M is another.
    """
    size = len(metric.scaling)
    states = at_angles(angles, size)
    matrix = metric.matrix(states)
    elsewhere = np.random.default_rng(0).uniform(-1.0, 1.0, states.shape)
    if size > ANGLE:
        elsewhere[:, ANGLE] = states[:, ANGLE]
    if not np.allclose(metric.matrix(elsewhere), matrix, rtol=1e-9, atol=0.0):
        raise ValueError(
            f"{metric!r} depends on more of the state than the angle x[{ANGLE}]: the angles of its "
            "region say nothing of its other values"
        )
    return matrix


def basis(angle: FloatArray, degree: int) -> FloatArray:
    """Return cos(theta)^i for i = 0 ... degree, shape (..., degree + 1)."""
    powers: FloatArray = np.cos(angle)[..., None] ** np.arange(degree + 1)
    return powers


def basis_rate(angle: FloatArray, angular_rate: FloatArray, degree: int) -> FloatArray:
    """Return the time derivative of the basis, shape (..., degree + 1)."""
    exponents = np.arange(degree + 1)
    lower = np.cos(angle)[..., None] ** np.maximum(exponents - 1, 0)
    rates: FloatArray = -exponents * lower * (np.sin(angle) * angular_rate)[..., None]
    return rates
