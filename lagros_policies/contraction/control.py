"""The robust tracking control u* of Theorem 2: the least deviation that makes e'Me contract."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_positive
from lagros_envs.dynamics import (
    System,
    control_matrix,
    hold_control_slope,
    hold_step,
    linearise_hold,
    vector_field,
)
from lagros_policies.contraction.metric import ContractionMetric, metric_place
from lagros_policies.contraction.systems import check_sizes, check_unmoved

# Eigenvalues below this share of the largest are zero but for rounding.
_UNSEEN = 1e-13
_NEWTON_STEPS = 60
_STEP_TOLERANCE = 1e-14


def error_energy(matrix: FloatArray, error: FloatArray) -> FloatArray:
    """Return V = e'Me, shape (...), for M (..., n, n) and e (..., n)."""
    energy: FloatArray = np.einsum("...i,...ij,...j->...", error, matrix, error)
    return energy


def contraction_terms(
    system: System,
    metric: ContractionMetric,
    rate: float,
    state: FloatArray,
    nominal: FloatArray,
    nominal_control: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return phi_0 and phi_1: the condition (18) at K e = v reads phi_0 + phi_1'v <= 0.

    phi_0 = 2e'M(f(x) + B(x)u_d - f(x_d) - B(x_d)u_d) + e'(dM/dt + 2 alpha M)e, phi_1 = 2B(x)'Me.

    Args:
        system: The system.
        metric: The metric.
        rate: alpha of the control law, at most the metric's own [1/s].
        state: x, shape (..., n).
        nominal: x_d, shape (..., n).
        nominal_control: u_d, shape (..., m).

    Returns:
        phi_0, shape (...), and phi_1, shape (..., m).

    Raises:
        ValueError: Metric, states and control are not of one system.
    """
    n, m = system.state_dim, system.control_dim
    check_sizes(
        system,
        state=(state, (n,)),
        nominal=(nominal, (n,)),
        nominal_control=(nominal_control, (m,)),
    )
    error = state - nominal
    place = metric_place(metric, state, nominal)
    matrix, gain = metric.matrix(place), control_matrix(system, state)
    check_sizes(system, metric=(matrix, (n, n)))
    check_unmoved(system, metric, state, gain)
    pull = np.einsum("...ij,...j->...i", matrix, error)
    motion = vector_field(system, state, nominal_control)
    planned = vector_field(system, nominal, nominal_control)
    drift = motion - planned
    phi_0 = 2.0 * np.einsum("...i,...i->...", pull, drift + rate * error)
    phi_0 = phi_0 + error_energy(
        metric.matrix_rate(place, planned if place is nominal else motion), error
    )
    phi_1 = 2.0 * np.einsum("...ij,...i->...j", gain, pull)
    return phi_0, phi_1


def robust_control(
    system: System,
    metric: ContractionMetric,
    rate: float,
    state: FloatArray,
    nominal: FloatArray,
    nominal_control: FloatArray,
) -> FloatArray:
    """Return u* of Theorem 2 in closed form: u_d - max(phi_0, 0) phi_1 / ||phi_1||^2.

    Where phi_1 vanishes the control cannot change the energy; phi_0 <= 0 holds there inside the
    metric's region, and u_d is returned.

    Args:
        system: The system.
        metric: The metric.
        rate: alpha of the control law [1/s].
        state: x, shape (..., n).
        nominal: x_d, shape (..., n).
        nominal_control: u_d, shape (..., m).

    Returns:
        u*, shape (..., m).
    """
    phi_0, phi_1 = contraction_terms(system, metric, rate, state, nominal, nominal_control)
    size = np.einsum("...i,...i->...", phi_1, phi_1)
    acts = (phi_0 > 0.0) & (size > 0.0)
    gain = np.where(acts, phi_0 / np.where(size > 0.0, size, 1.0), 0.0)
    control: FloatArray = nominal_control - gain[..., None] * phi_1
    return control


@dataclass(frozen=True)
class HeldControl:
    """u* for a control that is held: V must fall by exp(-2 alpha dt) from one instant to the next.

    The continuous law asks for dV/dt <= -2 alpha V at the instant only; over a hold of 0.1 s the
    energy then overshoots. Here the next error is predicted by the Runge-Kutta map F, linear in
    the deviation v = u - u_d, and v must satisfy

        (e' + G v)' M(x') (e' + G v) <= exp(-2 alpha dt) e'Me,  e' = F(x, u_d) - F(x_d, u_d),

    G = dF/du(x, u_d), x' = F(x, u_d); a metric of x_d is taken at x_d and at F(x_d, u_d). That is
    an ellipsoid of v, with one control an interval, whose point nearest to the preferred v is
    taken: for a preferred v of zero the least deviation, as in (17). Where it is empty, outside the
    metric's region, the v of least energy is taken.

    Attributes:
        system: The system.
        metric: The metric.
        rate: alpha of the control law [1/s].
        period: Control period dt [s].

    Raises:
        ValueError: The system has other states than the metric, or the rate exceeds the metric's.
    """

    system: System
    metric: ContractionMetric
    rate: float
    period: float

    def __post_init__(self) -> None:
        size = len(self.metric.scaling)
        if size != self.system.state_dim:
            raise ValueError(
                f"the metric is of {size} states and {self.system!r} has {self.system.state_dim}: "
                "give a metric of this system"
            )
        check_positive("period", self.period)
        if not 0.0 < self.rate <= self.metric.contraction_rate:
            raise ValueError(
                f"rate={self.rate!r} must be positive and at most the metric's own "
                f"{self.metric.contraction_rate!r}: a faster law is not feasible everywhere"
            )

    def quadratic(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return a, b, c of the condition v'a v + 2 b'v + c <= 0.

        Args:
            state: x, shape (..., n).
            nominal: x_d, shape (..., n).
            nominal_control: u_d, shape (..., m).

        Returns:
            a (..., m, m), b (..., m) and c (...); with one control each of them (...).
        """

        def ahead(following: FloatArray, planned: FloatArray) -> FloatArray:
            return self.metric.matrix(metric_place(self.metric, following, planned))

        return contracting_set(
            self.system,
            self.period,
            self.rate,
            (state, nominal, nominal_control),
            self.metric.matrix(metric_place(self.metric, state, nominal)),
            ahead,
        )

    def interval(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the least and the largest v that contract, each (...), of a single control.

        Args:
            state: x, shape (..., n).
            nominal: x_d, shape (..., n).
            nominal_control: u_d, shape (..., 1).

        Returns:
            Both ends; where nothing contracts, both are the v of least energy.

        Raises:
            ValueError: The system has more than one control.
        """
        if self.system.control_dim != 1:
            raise ValueError(
                f"{self.system!r} has {self.system.control_dim} controls: what contracts is an "
                "ellipsoid, see quadratic()"
            )
        return _ends(*self.quadratic(state, nominal, nominal_control))

    def __call__(
        self,
        state: FloatArray,
        nominal: FloatArray,
        nominal_control: FloatArray,
        preferred: FloatArray | float = 0.0,
    ) -> FloatArray:
        """Return u*, shape (..., m).

        Args:
            state: x, shape (..., n).
            nominal: x_d, shape (..., n).
            nominal_control: u_d, shape (..., m).
            preferred: v that is taken where it contracts, shape (..., m); (...) of one control.

        Returns:
            u_d plus the contracting v nearest to the preferred one.
        """
        condition = self.quadratic(state, nominal, nominal_control)
        control: FloatArray = nominal_control + nearest_contracting(*condition, preferred)
        return control


def contracting_set(
    system: System,
    period: float,
    rate: float,
    place: tuple[FloatArray, FloatArray, FloatArray],
    here: FloatArray,
    ahead: Callable[[FloatArray, FloatArray], FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a, b, c of v'a v + 2 b'v + c <= 0: the v = u - u_d that make V contract over a hold.

    Args:
        system: The system.
        period: Control period h [s].
        rate: alpha: V is to fall by exp(-2 alpha h) [1/s].
        place: x (..., n), x_d (..., n) and u_d (..., m).
        here: M of V at the instant, shape (..., n, n).
        ahead: Gives M at the next instant from F(x, u_d) and F(x_d, u_d).

    Returns:
        a (..., m, m), b (..., m) and c (...); with one control each of them (...).
    """
    state, nominal, nominal_control = place
    if system.control_dim == 1:
        following, slope = hold_control_slope(system, state, nominal_control, period)
        gain = slope[..., None]
    else:
        following, _, gain = linearise_hold(system, state, nominal_control, period)
    planned = hold_step(system, nominal, nominal_control, period)
    error, matrix = following - planned, ahead(following, planned)
    pull = np.einsum("...ij,...jk->...ik", matrix, gain)
    a = np.einsum("...ij,...ik->...jk", gain, pull)
    b = np.einsum("...i,...ij->...j", error, pull)
    before = error_energy(here, state - nominal)
    c = error_energy(matrix, error) - np.exp(-2.0 * rate * period) * before
    return (a[..., 0, 0], b[..., 0], c) if system.control_dim == 1 else (a, b, c)


def nearest_contracting(
    a: FloatArray, b: FloatArray, c: FloatArray, preferred: FloatArray | float
) -> FloatArray:
    """Return the point of a `contracting_set` that is nearest to a preferred one, shape (..., m).

    Args:
        a: As there.
        b: As there.
        c: As there.
        preferred: v, shape (..., m); (...) of one control.
    """
    if np.ndim(a) == np.ndim(c):
        low, high = _ends(a, b, c)
        return np.clip(preferred, low, high)[..., None]
    return nearest_in_ellipsoid(a, b, c, np.asarray(preferred))


def _ends(a: FloatArray, b: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the interval of one control; where it is empty, its centre twice."""
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    return (-b - root) / a, (-b + root) / a


def nearest_in_ellipsoid(
    a: FloatArray, b: FloatArray, c: FloatArray, point: FloatArray
) -> FloatArray:
    """Return the v nearest to a point with v'a v + 2 b'v + c <= 0.

    In the eigenvectors of a the condition is sum_i a_i y_i^2 <= r^2 with y the distance from the
    centre -b / a. The nearest y is y_i = p_i / (1 + lambda a_i), and lambda >= 0 is the one root of
    1 / |y|_a = 1 / r, a concave function on which Newton's method rises from zero.

    Args:
        a: Positive semidefinite, shape (..., m, m).
        b: In the range of a, shape (..., m).
        c: Shape (...).
        point: The point, shape (..., m).

    Returns:
        v, shape (..., m): the point itself where it is inside, the centre where nothing is.
    """
    values, vectors = np.linalg.eigh(a)
    # A direction that a does not see is left alone.
    seen = values > _UNSEEN * values[..., -1:]
    size = np.where(seen, values, 1.0)
    centre = np.where(seen, -np.einsum("...ji,...j->...i", vectors, b) / size, 0.0)
    offset = np.einsum("...ji,...j->...i", vectors, np.broadcast_to(point, b.shape)) - centre
    weight = np.where(seen, values, 0.0)
    square = np.einsum("...i,...i->...", weight * centre, centre) - c
    radius = np.sqrt(np.maximum(square, 0.0))
    outside = np.einsum("...i,...i->...", weight * offset, offset) > radius * radius
    possible = outside & (radius > 0.0)
    # The others take part with a problem that is solved.
    target = np.where(possible, radius, 1.0)
    begin = np.where(possible[..., None], offset, 0.0)
    multiplier = np.zeros(radius.shape)
    for _ in range(_NEWTON_STEPS):
        scaled = begin / (1.0 + multiplier[..., None] * weight)
        energy = np.einsum("...i,...i->...", weight * scaled, scaled)
        reached = np.sqrt(energy)
        slope = np.einsum(
            "...i,...i->...",
            weight * weight * scaled * scaled,
            1.0 / (1.0 + multiplier[..., None] * weight),
        )
        step = np.where(possible, (reached / target - 1.0) * energy, 0.0)
        step = np.divide(step, slope, out=np.zeros_like(step), where=slope > 0.0)
        multiplier = multiplier + np.maximum(step, 0.0)
        if np.all(step <= _STEP_TOLERANCE * multiplier):
            break
    nearest = begin / (1.0 + multiplier[..., None] * weight)
    # Onto the surface, where rounding and the last step have left a little.
    reached = np.sqrt(np.einsum("...i,...i->...", weight * nearest, nearest))
    shrink = np.where(possible, target / np.where(reached > 0.0, reached, 1.0), 1.0)
    nearest = nearest * np.where(seen, np.minimum(shrink, 1.0)[..., None], 1.0)
    chosen = np.where(outside[..., None], np.where(possible[..., None], nearest, 0.0), offset)
    # Where nothing contracts the seen directions go to the centre, the others stay.
    chosen = np.where(seen, chosen, offset)
    found: FloatArray = np.einsum("...ij,...j->...i", vectors, centre + chosen)
    return found
