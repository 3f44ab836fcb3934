"""Theorem 2's condition at samples: its matrices, by how much it fails, and its check."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import (
    System,
    control_matrix,
    state_dependent_coefficient,
    vector_field,
)
from lagros_policies.contraction.metric import (
    ContractionMetric,
    DualMetric,
    Verification,
    metric_place,
)
from lagros_policies.contraction.regions import Samples, search_region
from lagros_policies.contraction.systems import check_sizes, check_unmoved

__all__ = [
    "Samples",
    "condition_left",
    "condition_terms",
    "contraction_residual",
    "search_violation",
    "verify_metric",
]

Verified = TypeVar("Verified", bound=ContractionMetric)

# How well A e must give the difference of the motions, of which A is the mean slope.
_SLOPE_ERROR = 1e-6


def condition_terms(system: System, samples: Samples) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A(x, x_d, u_d), B(x) and dx/dt under u_d at samples of a system.

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
            f"x_d={nominal[worst].tolist()} for its mean to be known: bring the two nearer, "
            "or round the bends of its equation, abs(v) as functions.sqrt(v*v + 1e-4)"
        )
    return slope, control_matrix(system, state), motion


def condition_left(system: System, metric: DualMetric, samples: Samples) -> FloatArray:
    """Return -dW_bar/dt + 2 sym(A W_bar) - 2 nu B B' + 2 alpha W_bar at samples, (s, n, n).

    Raises:
        ValueError: The three are not of one system.
    """
    slope, gain, motion = condition_terms(system, samples)
    place = _place(metric, samples)
    dual = metric.dual(place)
    check_sizes(system, dual=(dual, slope.shape[-2:]))
    check_unmoved(system, metric, samples.state, gain)
    if place is samples.nominal:
        motion = vector_field(system, place, samples.nominal_control)
    product = slope @ dual
    left: FloatArray = (
        -metric.dual_rate(place, motion)
        + product
        + np.swapaxes(product, -1, -2)
        - 2.0 * metric.control_weight * gain @ np.swapaxes(gain, -1, -2)
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
        metric: W_bar; one of x only where no control of the system moves it.
        samples: Where to look.

    Raises:
        ValueError: The three are not of one system.
    """
    left = condition_left(system, metric, samples)
    values, vectors = np.linalg.eigh(metric.dual(_place(metric, samples)))
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

    Raises:
        ValueError: There is no sample, or they or the metric are not those of the system.
    """
    if len(samples.state) == 0:
        raise ValueError("samples are empty: nothing would be verified")
    residual = contraction_residual(system, metric, samples)
    scaled = (
        metric.dual(_place(metric, samples)) * metric.scaling[:, None] * metric.scaling[None, :]
    )
    eigenvalues = np.linalg.eigvalsh(scaled)
    # The semidefinite solver meets the bounds to about 1e-7 of chi.
    slack = 1e-6 * metric.condition_bound
    bounded = (eigenvalues[:, 0] >= 1.0 - slack) & (
        eigenvalues[:, -1] <= metric.condition_bound + slack
    )
    broken = int(np.sum(~(residual <= 0.0) | ~bounded))
    return metric.verified(Verification(len(residual), broken, float(residual.max()), seed))


def search_violation(system: System, metric: ContractionMetric, seed: int) -> tuple[Samples, float]:
    """Look for where the condition fails most on a metric's own region (observed).

    Unlike `verify_metric` it follows the worst triples that it drew to where they are worse. Where
    control and state are bounded each for itself there are triples of which no plan is near.

    Returns:
        The triples that the search ended at, the worst first, and the `contraction_residual` of
        that one [1/s]: where it is positive the metric does not contract.
    """
    found, figures = search_region(
        metric.region,
        lambda drawn: contraction_residual(system, metric, drawn),
        np.random.default_rng(seed),
    )
    return found, float(figures[0])


def _place(metric: DualMetric, samples: Samples) -> FloatArray:
    return metric_place(metric, samples.state, samples.nominal)
