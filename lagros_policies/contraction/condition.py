"""Theorem 2's condition at samples: its matrices, by how much it fails, and its check."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import (
    System,
    control_matrix,
    state_dependent_coefficient,
    vector_field,
)
from lagros_policies.contraction.metric import ContractionMetric, DualMetric, Verification
from lagros_policies.contraction.systems import check_angle, check_sizes

FloatArray = NDArray[np.float64]
Verified = TypeVar("Verified", bound=ContractionMetric)

# How well A e must give the difference of the motions, of which A is the mean slope.
_SLOPE_ERROR = 1e-6


@dataclass(frozen=True)
class Samples:
    """Triples at which the condition is imposed or checked.

    Attributes:
        state: x, shape (s, n).
        nominal: x_d, shape (s, n).
        nominal_control: u_d, shape (s, m).

    Raises:
        ValueError: The shapes do not fit each other, or a number is not finite.
    """

    state: FloatArray
    nominal: FloatArray
    nominal_control: FloatArray

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        shapes = [np.shape(getattr(self, item.name)) for item in fields(self)]
        if (
            [len(shape) for shape in shapes] != [2, 2, 2]
            or shapes[0] != shapes[1]
            or shapes[0][0] != shapes[2][0]
        ):
            raise ValueError(
                f"state, nominal and nominal_control of shapes {shapes} must be (s, n), (s, n) and "
                "(s, m)"
            )
        for item in fields(self):
            if not np.all(np.isfinite(getattr(self, item.name))):
                raise ValueError(f"{item.name} must be finite: leave such samples out")

    def take(self, index: NDArray[np.intp]) -> Samples:
        """Return the samples with these indices."""
        return Samples(self.state[index], self.nominal[index], self.nominal_control[index])


def condition_terms(system: System, samples: Samples) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A(x, x_d, u_d), B(x) and dx/dt under u_d at samples of a system.

    Args:
        system: The system.
        samples: The samples.

    Returns:
        A, shape (s, n, n), B, shape (s, n, m), and the motion, shape (s, n).

    Raises:
        ValueError: The samples are not of the system, or its motion bends so much between x and x_d
            that A is not known.
    """
    n, m = system.state_dim, system.control_dim
    state, nominal, control = samples.state, samples.nominal, samples.nominal_control
    check_sizes(system, state=(state, (n,)), nominal_control=(control, (m,)))
    slope = state_dependent_coefficient(system, state, nominal, control)
    motion = vector_field(system, state, control)
    error = state - nominal
    moved = motion - vector_field(system, nominal, control)
    missed = np.abs(np.einsum("sij,sj->si", slope, error) - moved)
    size = 1.0 + np.einsum("sij,sj->si", np.abs(slope), np.abs(error))
    if not np.all(missed <= _SLOPE_ERROR * size):
        worst = int(np.argmax((missed / size).max(axis=1)))
        raise ValueError(
            f"the slope of {system!r} changes too often between x={state[worst].tolist()} and "
            f"x_d={nominal[worst].tolist()} for its mean to be known: bring the two nearer"
        )
    return slope, control_matrix(system, state), motion


def condition_left(
    system: System, metric: DualMetric, samples: Samples, share: float = 1.0
) -> FloatArray:
    """Return -dW_bar/dt + 2 sym(A W_bar) - 2 share nu B B' + 2 alpha W_bar at samples, (s, n, n).

    Args:
        system: The system.
        metric: The metric.
        samples: Where.
        share: Of the gain B'M of Theorem 2's proof, whose own is one.

    Raises:
        ValueError: The three are not of one system.
    """
    slope, gain, motion = condition_terms(system, samples)
    if getattr(metric, "depends_on_angle", False):
        check_angle(system, samples.state, motion, gain)
    dual = metric.dual(samples.state)
    check_sizes(system, dual=(dual, slope.shape[-2:]))
    product = slope @ dual
    left: FloatArray = (
        -metric.dual_rate(samples.state)
        + product
        + np.swapaxes(product, -1, -2)
        - 2.0 * share * metric.control_weight * gain @ np.swapaxes(gain, -1, -2)
        + 2.0 * metric.contraction_rate * dual
    )
    return left


def contraction_residual(system: System, metric: DualMetric, samples: Samples) -> FloatArray:
    """Return by how much the condition fails at each sample, relative to W_bar, shape (s,).

    The largest eigenvalue of W_bar^-1/2 (-dW_bar/dt + 2 sym(A W_bar) - 2 nu B B'
    + 2 alpha W_bar) W_bar^-1/2, in 1/s: the condition holds where it is not positive. Infinite
    where W_bar is not positive definite.

    Args:
        system: The system.
        metric: W_bar; one of the angle for a system whose state 1 moves at the rate of state 3.
        samples: Where to look.

    Raises:
        ValueError: The three are not of one system.
    """
    left = condition_left(system, metric, samples)
    values, vectors = np.linalg.eigh(metric.dual(samples.state))
    # Where it is not a metric at all no residual is large enough.
    definite = values[:, 0] > 0.0
    size = np.sqrt(np.where(definite[:, None], values, 1.0))
    root = np.swapaxes(vectors / size[:, None, :], -1, -2)
    relative = root @ left @ np.swapaxes(root, -1, -2)
    return np.where(definite, np.linalg.eigvalsh(relative)[..., -1], np.inf)


def verify_metric(system: System, metric: Verified, samples: Samples, seed: int) -> Verified:
    """Check the condition and I <= W_bar <= chi I on fresh samples and store the outcome.

    Args:
        system: The system.
        metric: The metric.
        samples: States that the design never saw.
        seed: The seed they were drawn with, for the record.

    Returns:
        The metric with its `verification`.

    Raises:
        ValueError: There is no sample, or they or the metric are not those of the system.
    """
    if len(samples.state) == 0:
        raise ValueError("samples are empty: nothing would be verified")
    residual = contraction_residual(system, metric, samples)
    scaled = metric.dual(samples.state) * metric.scaling[:, None] * metric.scaling[None, :]
    eigenvalues = np.linalg.eigvalsh(scaled)
    # The semidefinite solver meets the bounds to about 1e-7 of chi.
    slack = 1e-6 * metric.condition_bound
    bounded = (eigenvalues[:, 0] >= 1.0 - slack) & (
        eigenvalues[:, -1] <= metric.condition_bound + slack
    )
    broken = int(np.sum(~(residual <= 0.0) | ~bounded))
    return metric.verified(Verification(len(residual), broken, float(residual.max()), seed))
