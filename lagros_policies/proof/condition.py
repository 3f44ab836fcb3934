"""Proof of the contraction condition on continuous boxes, by interval arithmetic and bisection.

Theorem 2 asks, with A = A(x, x_d, u_d) of `state_dependent_coefficient`, for

    -dW_bar/dt(x) + 2 sym(A W_bar(x)) - 2 nu B(x) B(x)' + 2 alpha W_bar(x) < 0.             (*)

A is the mean of J(y, u_d) = d(f + B u_d)/dx(y) over the segment from x_d to x, and (*) is affine in
A. So it is enough, and this is what is proved, that for every x of the box, every point y of the
box whose angle and rate differ from those of x by the errors allowed, and every force of the box

    -dW_bar/dt(x) + 2 sym(J(y, u_d) W_bar(x)) - 2 nu B(x) B(x)' + 2 alpha W_bar(x) < 0.    (**)

The box is convex, so y runs over the whole segment and (*) follows by averaging, for a W_bar that
depends on the angle too. With `ProofBox.apart` x and x_d lie anywhere in the box. With errors of
zero, y is x and (**) is the differential condition (of infinitesimal displacements); for a W_bar
that depends on x that alone does not imply (*).

Proved is the condition on the derivative, for the coefficients of the motion as the doubles that
the code computes with. It says nothing of the hold of the control between its instants (see
`hold`), nor of the term by which a disturbance moves W_bar.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_at_least, check_positive
from lagros_envs.dynamics import System
from lagros_envs.numbers import Interval, exact, variable
from lagros_envs.tasks.cartpole.physics import ANGLE
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.systems import check_cartpole, check_cartpole_metric
from lagros_policies.proof.box import ProofBox
from lagros_policies.proof.cells import search
from lagros_policies.proof.matrices import interval_jacobian, negative_definite
from lagros_policies.proof.motion import metric_series
from lagros_policies.proof.rates import Violation, rate_condition

__all__ = [
    "ContractionProof",
    "ProofBox",
    "ProvedBounds",
    "Violation",
    "largest_proved",
    "prove_bounds",
    "prove_contraction",
]

FloatArray = NDArray[np.float64]

# Cells of one pass: enough to hide NumPy's cost per call, few enough to stay in the cache.
_BATCH = 300


@dataclass(frozen=True)
class ContractionProof:
    """What the search for a proof came to.

    Attributes:
        box: The set asked about.
        contraction_rate: alpha [1/s].
        proved: Whether (**), and so (*), holds on the whole set.
        boxes: Cells examined.
        seconds: Time taken [s].
        violation: A point where the condition fails, or None.
        undecided: One cell left undecided, ends (2, 3) of the angle of x, of that of y (less that
            of x if the errors are bounded) and the rate of y; None if proved or violated.
    """

    box: ProofBox
    contraction_rate: float
    proved: bool
    boxes: int
    seconds: float
    violation: Violation | None = None
    undecided: FloatArray | None = None


@dataclass(frozen=True)
class ProvedBounds:
    """Bounds that hold for every |theta| <= angle.

    Attributes:
        angle: Largest |theta| [rad].
        least: least I <= S W_bar S.
        largest: S W_bar S <= largest I.
        control_gain: b_bar, bound of ||B(x)||.
        seconds: Time taken [s].
    """

    angle: float
    least: float
    largest: float
    control_gain: float
    seconds: float = 0.0

    @property
    def condition(self) -> float:
        """A bound of chi, the condition number in the units of the scaling S."""
        return math.nextafter(self.largest / self.least, math.inf)


def prove_contraction(
    system: System,
    metric: Metric,
    box: ProofBox,
    contraction_rate: float | None = None,
    *,
    most_boxes: int = 1_000_000,
    most_seconds: float = 60.0,
) -> ContractionProof:
    """Prove the condition of Theorem 2, equation (14), on a box, or find where it fails.

    Args:
        system: A cart-pole.
        metric: The metric.
        box: Where to prove it.
        contraction_rate: alpha [1/s]; None for that of the metric.
        most_boxes: Cells after which the search gives up.
        most_seconds: Processor time after which it gives up [s].

    Returns:
        The proof, or why there is none.

    Raises:
        TypeError: The system is no cart-pole, whose structure the proof uses, or the metric no
            polynomial.
    """
    cartpole = check_cartpole(system, "prove_contraction")
    check_cartpole_metric(metric, "prove_contraction")
    rate = metric.contraction_rate if contraction_rate is None else contraction_rate
    found = search(rate_condition(cartpole, metric, box, rate), _BATCH, most_boxes, most_seconds)
    return ContractionProof(
        box, rate, found.proved, found.cells, found.seconds, found.failure, found.undecided
    )


def largest_proved(
    system: System,
    metric: Metric,
    box: ProofBox,
    contraction_rate: float | None = None,
    *,
    rounds: int = 8,
    most_seconds: float = 60.0,
) -> ContractionProof:
    """Find the largest multiple, at most one, of a box on which the condition can be proved.

    Args:
        system: A cart-pole.
        metric: The metric.
        box: The shape, and the largest size, of the box.
        contraction_rate: alpha [1/s]; None for that of the metric.
        rounds: Halvings of the range of the multiple.
        most_seconds: Processor time for all of it [s]; each attempt gets an equal share.

    Returns:
        The proof for the largest box that was proved; if none was, the last attempt.
    """
    share = most_seconds / (rounds + 1)
    best = prove_contraction(system, metric, box, contraction_rate, most_seconds=share)
    if best.proved:
        return best
    low, high = 0.0, 1.0
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        trial = prove_contraction(
            system, metric, box.scaled(middle), contraction_rate, most_seconds=share
        )
        low, high = (middle, high) if trial.proved else (low, middle)
        if trial.proved or not best.proved:
            best = trial
    return best


def prove_bounds(system: System, metric: Metric, angle: float, cells: int = 2000) -> ProvedBounds:
    """Enclose the eigenvalues of S W_bar S and the norm of B for every |theta| <= angle.

    Args:
        system: A cart-pole.
        metric: The metric.
        angle: Largest |theta| [rad].
        cells: Equal intervals of the angle.

    Returns:
        The bounds.

    Raises:
        TypeError: The system is no cart-pole: B of another may depend on more than the angle.
        ValueError: W_bar cannot be shown to be positive definite with so many cells.
    """
    check_cartpole(system, "prove_bounds")
    check_cartpole_metric(metric, "prove_bounds")
    check_positive("angle", angle)
    check_at_least("cells", cells, 1)
    start = time.monotonic()
    ends = np.linspace(-angle, angle, cells + 1)
    thetas = Interval(ends[:-1], ends[1:])
    scale = metric.scaling[:, None] * metric.scaling[None, :]
    # About the midpoint: W_bar(c) + W_bar'(cell) (theta - c). S_i S_j rounds; as an interval it is
    # enclosed.
    middle = thetas.midpoint
    gap = (thetas - middle)[:, None, None]
    dual = metric_series(metric, variable(exact(middle), 1)).derivative(0)
    dual = dual + metric_series(metric, variable(thetas, 1)).derivative(1) * gap
    scaled = dual * exact(metric.scaling[:, None]) * metric.scaling[None, :]
    values = np.linalg.eigvalsh(scaled.midpoint)
    # Weyl: the eigenvalues move by no more than the largest row sum of the radii.
    slack = float(scaled.radius.sum(axis=-1).max()) + 1e-9 * float(np.abs(scale).max())
    least, largest = float(values.min()) - slack, float(values.max()) + slack
    identity = np.eye(len(metric.scaling))
    proved = negative_definite(scaled - largest * identity) & negative_definite(
        least * identity - scaled
    )
    if least <= 0.0 or not np.all(proved):
        raise ValueError(
            f"W_bar is not shown to be positive definite for |theta| <= {angle} with "
            f"cells={cells}: use more cells, or another metric"
        )
    states = np.zeros((cells, system.state_dim))
    low, high = states.copy(), states.copy()
    low[:, ANGLE], high[:, ANGLE] = thetas.lower, thetas.upper
    gain = interval_jacobian(system, Interval(low, high), exact([0.0] * system.control_dim))[1]
    # The Frobenius norm bounds the spectral norm, and is it for one control.
    squares = np.maximum(np.abs(gain.lower), np.abs(gain.upper)) ** 2
    norm = math.sqrt(float(squares.sum(axis=(-1, -2)).max())) * (1.0 + 1e-12)
    return ProvedBounds(angle, least, largest, norm, time.monotonic() - start)
