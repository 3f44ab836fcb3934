"""Stochastic disturbances: how far from the target in the mean square (NSCM).

The state obeys dx = (f + B u) dt + G dw with a Wiener process w and G = diag(g), g the intensity of
each channel [unit of the state / sqrt(s)]. No bound holds for every path, but for V = e'M(x)e Ito's
formula adds to dV/dt <= -2 alpha V the power that the noise feeds in. For a metric of one x_i

    L V <= -2 alpha V + tr(G'MG) + g_i^2 (2 (M_i e)_i + e'M_ii e / 2),    M_i = dM/dx_i,

and with ||column i of M_i|| <= mu_1 in the norm of M^-1, e'M_ii e <= mu_2 V and
2 mu_1 sqrt(V) <= mu_1^2 / eps + eps V, for any eps > 0,

    E V(t) <= e^(-2 a t) V(0) + C / (2 a) (1 - e^(-2 a t)),    E||e||^2 <= E V / lambda_min(M),
    a = alpha - g_i^2 (eps + mu_2 / 2) / 2,    C = sup tr(G'MG) + g_i^2 mu_1^2 / eps.

This is the theorem of Tsukamoto, Chung and Slotine (NSCM, 2021) in the norm of the metric itself.
Noise that enters as accelerations (g_i = 0) needs no correction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_at_least, check_not_negative, check_positive
from lagros_envs.dynamics import System, hold_step
from lagros_policies.contraction.double_integrator import AxisMetric
from lagros_policies.contraction.metric import (
    ContractionMetric,
    drawn_places,
    even_region,
    matrices_along,
    metric_is_still,
)
from lagros_policies.contraction.places import along

_GRID = 401
# Shares of alpha that eps may take; the best of them is used.
_SHARES = np.geomspace(1e-3, 1.9, 200)
_STEP = 1e-4  # of the second derivative of M


@dataclass(frozen=True, slots=True)
class MeanSquareBound:
    """The bound of E V and of E||e||^2 over time.

    Attributes:
        rate: a [1/s].
        power: C, in units of V per second.
        least_eigenvalue: lambda_min(M) over the region.
        initial_energy: V(0).

    Raises:
        ValueError: A number is out of range.
    """

    rate: float
    power: float
    least_eigenvalue: float
    initial_energy: float = 0.0

    def __post_init__(self) -> None:
        for name in ("rate", "least_eigenvalue"):
            check_positive(name, getattr(self, name))
        for name in ("power", "initial_energy"):
            check_not_negative(name, getattr(self, name))

    def energy(self, time: Any) -> FloatArray:
        """Return the bound of E V at times [s], an array of their shape."""
        decay = np.exp(-2.0 * self.rate * np.asarray(time, dtype=np.float64))
        steady = self.power / (2.0 * self.rate)
        return np.asarray(self.initial_energy * decay + steady * (1.0 - decay))

    def mean_square(self, time: Any) -> FloatArray:
        """Return the bound of E||e||^2 at times [s], an array of their shape."""
        return self.energy(time) / self.least_eigenvalue


def checked_intensity(intensity: Any, size: int) -> FloatArray:
    """Return g as an array (n,).

    Raises:
        ValueError: It has another length, is negative or not finite.
    """
    values = np.asarray(intensity, dtype=np.float64)
    if values.shape != (size,) or not (np.all(np.isfinite(values)) and np.all(values >= 0.0)):
        raise ValueError(f"intensity={intensity!r} must be {size} finite numbers >= 0")
    return values


def mean_square_bound(
    metric: ContractionMetric, intensity: Any, initial_energy: float = 0.0
) -> MeanSquareBound:
    """Return the bound for a metric that noise moves by one coordinate, for a control at will.

    The suprema are taken over a grid of that coordinate, or over states drawn from it
    (observed), and the bound holds while the state stays in the region: noise leaves any region at
    some time, if rarely.

    Args:
        metric: A metric that is constant, of x_d, or of the even coordinate of its region alone.
        intensity: g, shape (n,) [unit of the state / sqrt(s)].
        initial_energy: V(0).

    Returns:
        The bound, with the eps that makes the steady value least.

    Raises:
        ValueError: The noise of the coordinate is too strong for the metric's rate, the metric
            depends on more than the coordinate, or a number is out of range.
    """
    size = len(metric.scaling)
    squares = checked_intensity(intensity, size) ** 2
    check_not_negative("initial_energy", initial_energy)
    still = metric_is_still(metric)
    coordinate = 0
    if still:
        matrix = metric.matrix(drawn_places(metric))
    else:
        coordinate, reach = even_region(metric)
        values = np.linspace(-reach, reach, _GRID)
        matrix = matrices_along(metric, values)
    power = float(np.max(np.einsum("sii,i->s", matrix, squares)))
    least = float(np.linalg.eigvalsh(matrix)[:, 0].min())
    moving = 0.0 if still else float(squares[coordinate])
    if moving == 0.0:
        return MeanSquareBound(metric.contraction_rate, power, least, initial_energy)
    first, second = _variation(metric, values, matrix)
    eps = _SHARES * metric.contraction_rate / moving
    rates = metric.contraction_rate - 0.5 * moving * (eps + 0.5 * second)
    powers = power + moving * first**2 / eps
    steady = np.where(rates > 0.0, powers / np.where(rates > 0.0, rates, 1.0), np.inf)
    best = int(np.argmin(steady))
    if not np.isfinite(steady[best]):
        raise ValueError(
            f"intensity={intensity!r}: the noise of x[{coordinate}] takes more than the whole rate "
            f"alpha={metric.contraction_rate!r}; the mean square has no bound by this metric"
        )
    return MeanSquareBound(float(rates[best]), float(powers[best]), least, initial_energy)


def _variation(
    metric: ContractionMetric, values: FloatArray, matrix: FloatArray
) -> tuple[float, float]:
    """Return mu_1 and mu_2 over a grid of the coordinate that the metric depends on."""
    (coordinate, _), size = even_region(metric), len(metric.scaling)
    states = along(values, coordinate, size)
    turn = along(np.ones(len(values)), coordinate, size)  # at one unit per second
    slope = metric.matrix_rate(states, turn)
    ahead, behind = states.copy(), states.copy()
    ahead[:, coordinate] += _STEP
    behind[:, coordinate] -= _STEP
    curvature = (metric.matrix_rate(ahead, turn) - metric.matrix_rate(behind, turn)) / (2.0 * _STEP)
    inverse = np.linalg.inv(matrix)
    column = slope[:, :, coordinate]
    first = np.sqrt(np.einsum("si,sij,sj->s", column, inverse, column))
    second = np.linalg.eigvals(inverse @ curvature).real.max()
    return float(first.max()), max(float(second), 0.0)


@dataclass(frozen=True, slots=True)
class HeldMeanSquare:
    """Bounds at the control instants 0 ... N of double integrators under u* (proved; see below).

    Attributes:
        energy: Of E V, shape (N + 1,).
        position: Of E||position error||^2, shape (N + 1,) [m^2].
        state: Of E||(position, velocity) error||^2, shape (N + 1,).
    """

    energy: FloatArray
    position: FloatArray
    state: FloatArray


def held_mean_square(
    metric: AxisMetric,
    position_intensity: float,
    velocity_intensity: float,
    steps: int,
    axes: int = 2,
) -> HeldMeanSquare:
    """Bound the mean square under a held u*, from zero error.

    From instant to instant u* shrinks V by rho^2 = exp(-2 alpha h) whatever the state is, and what
    the noise adds to the error is independent of it, with mean zero and covariance

        Q = int_0^h F(s) diag(g_p^2, g_v^2) F(s)' ds:    E V[k + 1] <= rho^2 E V[k] + axes tr(M Q)

    with no approximation: the double integrator is linear and the metric constant. That the wrench
    is held in the body's axes, which turn within a step, is left out.

    Args:
        metric: The metric of each axis, with its period h.
        position_intensity: g_p [m / sqrt(s)].
        velocity_intensity: g_v [m/s / sqrt(s)].
        steps: N.
        axes: Axes that share the metric: x and y.

    Raises:
        ValueError: The metric has no period, or a number is negative.
    """
    h = metric.period
    if h == 0.0:
        raise ValueError("a held control needs a metric with a period; see MeanSquareBound")
    place, speed = checked_intensity((position_intensity, velocity_intensity), 2) ** 2
    covariance = np.array(
        [[place * h + speed * h**3 / 3.0, speed * h**2 / 2.0], [speed * h**2 / 2.0, speed * h]]
    )
    fed = axes * float(np.trace(metric.matrix @ covariance))
    shrink = math.exp(-2.0 * metric.rate * h)
    energy: FloatArray = (
        fed * (1.0 - shrink ** np.arange(steps + 1, dtype=np.float64)) / (1.0 - shrink)
    )
    dual = metric.dual
    largest = float(np.linalg.eigvalsh(dual)[-1])
    return HeldMeanSquare(energy, float(dual[0, 0]) * energy, largest * energy)


def noisy_hold_step(
    system: System,
    state: FloatArray,
    control: FloatArray,
    duration: float,
    intensity: FloatArray,
    rng: np.random.Generator,
    substeps: int = 4,
) -> FloatArray:
    """Advance states by one control step of dx = (f + B u) dt + G dw.

    Each substep is half a Runge-Kutta step, the noise, and the other half (Strang splitting: second
    order in the mean square).

    Args:
        system: The system.
        state: x, shape (..., n).
        control: u, held, shape (..., m).
        duration: Control step [s].
        intensity: g, shape (n,).
        rng: Source of the increments.
        substeps: Increments in the step.

    Returns:
        The states at its end, shape (..., n).
    """
    check_at_least("substeps", substeps, 1)
    half = 0.5 * duration / substeps
    spread = checked_intensity(intensity, system.state_dim) * math.sqrt(2.0 * half)
    for _ in range(substeps):
        state = hold_step(system, state, control, half, substeps=1)
        state = state + spread * rng.standard_normal(state.shape)
        state = hold_step(system, state, control, half, substeps=1)
    return state
