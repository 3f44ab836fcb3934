"""The paper's theorems as functions, where no other module has them, with what they leave out.

`tube.Tube` is Theorem 1, `tube.diverging_bound` Lemma 1, `control.robust_control` the u* of
Theorem 2, `tube.tighten` Theorem 3 and `learning.dataset` has the way of sampling of
Theorem 4 that the networks were trained with.

**Theorem 1 and a metric that depends on the state.** With V = e'M(x)e the disturbance moves x and
so M: dV/dt has the term sum_i d_i e'(dM/dx_i)e, which the proof leaves out. For a metric of
one coordinate |e'(dM/dx_i)e| <= kappa V with -kappa W <= dW/dx_i <= kappa W, so that the tube holds
with alpha - kappa d_i / 2 in place of alpha. A learning error enters through B, which moves no
coordinate of a metric of x, and adds nothing to it.

**Theorem 2, -nu or -2 nu.** For K = -s R^-1 B'M (s = 1 in the proof)

    dM/dt + 2 sym(M A + M B K) + 2 alpha M                          times W on both sides, then nu:
    -dW_bar/dt + 2 sym(A W_bar) - 2 s nu B R^-1 B' + 2 alpha W_bar

for 2 sym(M B K) = -2 s M B R^-1 B'M. So the gain of the proof gives the -2 nu of equation (14), and
the display in the proof, with -nu, belongs to half that gain. It is the stronger condition: where
it holds (14) does, and not the reverse.
"""

from __future__ import annotations

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_not_negative
from lagros_envs.dynamics import System, control_matrix
from lagros_policies.contraction.condition import Samples
from lagros_policies.contraction.control import contraction_terms
from lagros_policies.contraction.metric import Metric, metric_place

moved_names(__name__)


def disturbed_rate(metric: Metric, drift: float, disturbance: float) -> float:
    """Return alpha - kappa d_i / 2, the rate of Theorem 1 with the disturbance in dM/dt [1/s].

    Args:
        metric: The metric.
        drift: kappa of `metric_drift` [1/rad].
        disturbance: Bound of the disturbance of the metric's one coordinate, per second; d_bar, if
            it is not known to be less, and zero if it is not disturbed.
    """
    check_not_negative("drift", drift)
    check_not_negative("disturbance", disturbance)
    return metric.contraction_rate - 0.5 * drift * disturbance


def feasibility_residual(system: System, metric: Metric, samples: Samples) -> FloatArray:
    """Return by how much u_d - nu B'W_bar^-1 e misses the condition (18), over V, shape (s,) [1/s].

    It is the control that the proof of Theorem 2 names; where the figure is not positive the
    program for u* is feasible.

    Args:
        system: The system.
        metric: The metric.
        samples: x, x_d and u_d; e = x - x_d must not be zero.
    """
    error = samples.state - samples.nominal
    phi_0, phi_1 = contraction_terms(
        system,
        metric,
        metric.contraction_rate,
        samples.state,
        samples.nominal,
        samples.nominal_control,
    )
    matrix = metric.matrix(metric_place(metric, samples.state, samples.nominal))
    pull = np.einsum("...ij,...j->...i", matrix, error)
    gain = control_matrix(system, samples.state)
    deviation = -metric.control_weight * np.einsum("...ij,...i->...j", gain, pull)
    energy = np.sum(pull * error, axis=-1)
    missing: FloatArray = (phi_0 + np.sum(phi_1 * deviation, axis=-1)) / energy
    return missing


def contraction_distance(
    system: System, metric: Metric, samples: Samples, control: FloatArray
) -> FloatArray:
    """Return how far controls are from the nearest one that contracts, shape (s,).

    Theorem 1 needs of eps_l no more than this: any control that meets (18) may stand for u*. Where
    no control has an effect and u_d does not contract, it is infinite.

    Args:
        system: The system.
        metric: The metric.
        samples: x, x_d and u_d.
        control: u, shape (s, m).
    """
    phi_0, phi_1 = contraction_terms(
        system,
        metric,
        metric.contraction_rate,
        samples.state,
        samples.nominal,
        samples.nominal_control,
    )
    missing = phi_0 + np.sum(phi_1 * (control - samples.nominal_control), axis=-1)
    size = np.linalg.norm(phi_1, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance: FloatArray = np.where(missing > 0.0, missing / size, 0.0)
    return distance


def tube_ball(rng: np.random.Generator, nominal: FloatArray, radius: FloatArray) -> FloatArray:
    """Draw x uniformly from S(x_d), the ball of radius r_l(t) around x_d (Theorem 4).

    Args:
        rng: Random generator.
        nominal: x_d(t), shape (..., n).
        radius: r_l(t), shape (...).

    Returns:
        One state for each, shape (..., n).

    Raises:
        ValueError: A radius is negative.
    """
    if not np.all(np.isfinite(radius) & (np.asarray(radius) >= 0.0)):
        raise ValueError(f"radius={np.asarray(radius).tolist()!r} must be finite and >= 0")
    direction = rng.standard_normal(nominal.shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    size = radius * rng.random(nominal.shape[:-1]) ** (1.0 / nominal.shape[-1])
    states: FloatArray = nominal + size[..., None] * direction
    return states


def tube_ellipsoid(
    rng: np.random.Generator, nominal: FloatArray, dual: FloatArray, energy: FloatArray
) -> FloatArray:
    """Draw x uniformly from the tube in its own shape, e'W^-1 e <= energy.

    Args:
        rng: Random generator.
        nominal: x_d(t), shape (..., n).
        dual: W, shape (n, n).
        energy: Bound of e'W^-1 e, shape (...).

    Returns:
        One state for each, shape (..., n).

    Raises:
        numpy.linalg.LinAlgError: W is not positive definite.
    """
    zero = np.zeros_like(nominal)
    ball = tube_ball(rng, zero, np.sqrt(energy))
    states: FloatArray = nominal + ball @ np.linalg.cholesky(dual).T
    return states
