"""A contraction metric: what it is, where it was verified, and how it is stored."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_at_least, check_positive
from lagros_envs.dynamics.cartpole import ANGLE, ANGULAR_RATE
from lagros_envs.files import write_atomic

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_FORMAT = "lagros-metric-1"
_NETWORK = ".safetensors"


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
        """Return which triples (x, x_d, u_d) of a batch (..., 4), (..., 4), (..., 1) lie inside."""
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
        ValueError: The arrays do not fit each other or are not symmetric, or a number is out of
            range.
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
        if len(shape) != 3 or shape[1] != shape[2] or self.scaling.shape != shape[1:2]:
            raise ValueError(
                f"coefficients of shape {shape} and scaling of shape {self.scaling.shape} "
                "must be (degree + 1, n, n) and (n,)"
            )
        if not np.allclose(self.coefficients, np.swapaxes(self.coefficients, 1, 2)):
            raise ValueError("every coefficient of W_bar must be symmetric")
        numbers = (self.contraction_rate, self.condition_bound, self.control_weight, *self.scaling)
        if not (
            np.all(np.isfinite(self.coefficients)) and all(0.0 < n < math.inf for n in numbers)
        ):
            raise ValueError("W_bar must be finite; alpha, chi, nu and scaling finite and positive")
        check_at_least("condition_bound", self.condition_bound, 1)

    @property
    def degree(self) -> int:
        """Degree of W_bar in cos(theta)."""
        return len(self.coefficients) - 1

    def dual(self, state: FloatArray) -> FloatArray:
        """Return W_bar(x), shape (..., n, n), for states (..., n)."""
        powers = basis(state[..., ANGLE], self.degree)
        value: FloatArray = np.einsum("...i,ijk->...jk", powers, self.coefficients)
        return value

    def dual_rate(self, state: FloatArray) -> FloatArray:
        """Return dW_bar/dt along dtheta/dt of the state, shape (..., n, n)."""
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

    def verified(self, check: Verification) -> Self:
        """Return the metric with the outcome of a check."""
        return replace(self, verification=check)


def extreme_eigenvalues(metric: ContractionMetric, points: int = 401) -> tuple[float, float]:
    """Return the extreme eigenvalues of M over a grid of the region's angles (observed).

    Args:
        metric: A metric that is even in the angle.
        points: Angles from 0 to the region's largest.
    """
    states = np.zeros((points, len(metric.scaling)))
    states[:, ANGLE] = np.linspace(0.0, metric.region.angle, points)
    values = np.linalg.eigvalsh(metric.matrix(states))
    return float(values.min()), float(values.max())


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


def metric_record(metric: Metric) -> dict[str, Any]:
    """Return a metric as the JSON object that `load_metric` reads; numbers keep every bit."""
    return {
        "format": _FORMAT,
        "basis": "cos(theta)^i",
        "coefficients": metric.coefficients.tolist(),
        **design_record(metric),
    }


def design_record(metric: ContractionMetric) -> dict[str, Any]:
    """Return what the file of any metric says of its design; numbers keep every bit."""
    return {
        "alpha": metric.contraction_rate,
        "chi": metric.condition_bound,
        "nu": metric.control_weight,
        "scaling": metric.scaling.tolist(),
        "region": asdict(metric.region),
        "verification": None if metric.verification is None else asdict(metric.verification),
    }


def design_arguments(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a metric from what `design_record` made.

    Args:
        record: The record, with any other entries.

    Raises:
        KeyError: An entry is missing.
        TypeError: An entry has a wrong type.
        ValueError: A number is out of range, or is text or true or false.
    """
    check = record["verification"]
    only_numbers(record["region"], "region")
    if check is not None:
        only_numbers(check, "verification")
    return {
        "contraction_rate": number(record, "alpha"),
        "condition_bound": number(record, "chi"),
        "control_weight": number(record, "nu"),
        "scaling": numbers(record, "scaling"),
        "region": Region(**record["region"]),
        "verification": None if check is None else Verification(**check),
    }


def number(record: Mapping[str, Any], name: str) -> float:
    """Return a number of a JSON object; text and true, which Python takes for one, are refused.

    Args:
        record: The object.
        name: Key of the number.

    Raises:
        KeyError: There is no such key.
        ValueError: It is no number.
    """
    value = record[name]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}={value!r} must be a number: write it without quotes")
    return float(value)


def numbers(record: Mapping[str, Any], name: str) -> FloatArray:
    """Return nested lists of numbers of a JSON object as an array; see `number`.

    Raises:
        KeyError: There is no such key.
        ValueError: An entry is no number, or the lists are of different lengths.
    """
    only_numbers(record[name], name)
    return np.array(record[name], dtype=np.float64)


def only_numbers(value: Any, name: str) -> None:
    """Refuse text, true, false and null anywhere inside lists and objects of JSON.

    Args:
        value: What JSON was read to.
        name: What it is called in the message.

    Raises:
        ValueError: There is one.
    """
    if isinstance(value, Mapping | list):
        for item in value.values() if isinstance(value, Mapping) else value:
            only_numbers(item, name)
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} holds {value!r}, which must be a number: write it without quotes")


def read_text(path: Path | str) -> str:
    """Return the text of a metric's file, which is JSON; a network is refused by name.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is a network, or no text.
    """
    data = Path(path).read_bytes()
    try:
        text = data.decode()
    except UnicodeDecodeError:
        text = ""
    if Path(path).suffix == _NETWORK or (data and not text):
        raise ValueError(
            f"{path} is no JSON: a network is neither read nor proved here, only a polynomial is. "
            "Give a file of save_metric, as `python -m lagros_policies.contraction.proof.design "
            "--out FILE` writes; for networks there is load_neural_metric, and their condition is "
            "checked on samples"
        )
    return text


def save_metric(metric: Metric, path: Path | str) -> None:
    """Write a metric as JSON, atomically; numbers keep every bit."""
    write_atomic(path, json.dumps(metric_record(metric), indent=1) + "\n")


def load_metric(path: Path | str | None = None) -> Metric:
    """Read a metric.

    Args:
        path: A file written by `save_metric`; None for the shipped cart-pole metric.

    Returns:
        The metric.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not a metric, is a network, or is damaged.
    """
    if path is None:
        path = Path(__file__).parents[1] / "pretrained" / "cartpole_metric.json"
    text = read_text(path)
    try:
        record = json.loads(text)
        if record["format"] != _FORMAT:
            raise ValueError(f"format {record['format']!r} is not {_FORMAT!r}")
        return Metric(numbers(record, "coefficients"), **design_arguments(record))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"{path} is not a metric written by save_metric: {reason}") from error
