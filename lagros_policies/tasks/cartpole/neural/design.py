"""Making a neural contraction metric: CV-STEM at sampled angles, a network, its condition.

1. `solve_at_angles`: the CV-STEM program of Theorem 2 over one free matrix W_bar(theta_j) for each
   of a few angles, with one (nu, chi) for all and the condition imposed at sampled triples
   (x, x_d, u_d). Between two angles W_bar is linear in cos(theta), so that dW_bar/dt is exact.
   `solve_on_pool` adds the triples of a pool that the solution violates most, a few times.
2. `training.fit_network`: the network learns the Cholesky factors of M = W_bar^-1 there;
   then the condition itself, at all triples of the pool, is pushed below -margin by gradient
   descent (the largest eigenvalue, through dM/dtheta).
3. `cvstem.verify_metric` checks the outcome on fresh triples, like any other metric.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_at_least
from lagros_envs.dynamics import System
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE
from lagros_policies.contraction.condition import Samples, condition_terms, contraction_residual
from lagros_policies.contraction.cvstem import CvStemSettings, InfeasibleError
from lagros_policies.contraction.systems import check_sizes
from lagros_policies.tasks.cartpole.neural.metric import SIZE
from lagros_policies.tasks.cartpole.region import Region
from lagros_policies.tasks.cartpole.systems import check_cartpole


@dataclass(frozen=True)
class AngleSolution:
    """What CV-STEM found at each angle; a `DualMetric` that `contraction_residual` takes.

    Attributes:
        angles: theta_j, ascending from 0, shape (j,) [rad].
        duals: W_bar(theta_j), shape (j, 4, 4).
        contraction_rate: alpha [1/s].
        control_weight: nu.
        condition_bound: chi, with I <= S W_bar S <= chi I.
        scaling: Diagonal of S, shape (4,).
    """

    angles: FloatArray
    duals: FloatArray
    contraction_rate: float
    control_weight: float
    condition_bound: float
    scaling: FloatArray

    @property
    def coordinates(self) -> tuple[int, ...]:
        """The angle: W_bar depends on nothing else."""
        return (ANGLE,)

    def dual(self, state: FloatArray) -> FloatArray:
        """Return W_bar(x), shape (..., 4, 4), linear in cos(theta) between the angles."""
        shares, _ = hats(state[..., ANGLE], self.angles)
        value: FloatArray = np.einsum("...j,jab->...ab", shares, self.duals)
        return value

    def dual_rate(self, state: FloatArray, motion: FloatArray) -> FloatArray:
        """Return dW_bar/dt where the state moves at dx/dt, both (..., 4), shape (..., 4, 4)."""
        _, slopes = hats(state[..., ANGLE], self.angles)
        change = slopes * motion[..., ANGLE, None]
        value: FloatArray = np.einsum("...j,jab->...ab", change, self.duals)
        return value


def hats(angle: FloatArray, nodes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the share of each node at angles (...) and its derivative by the angle, (..., j).

    Shares are linear in cos(theta) from node to node; beyond the last node its own is 1.
    """
    places = np.cos(nodes)[::-1]
    value = np.clip(np.cos(angle), places[0], places[-1])
    right = np.clip(np.searchsorted(places, value, side="right"), 1, len(nodes) - 1)
    width = places[right] - places[right - 1]
    share = (value - places[right - 1]) / width
    shape = (*np.shape(angle), len(nodes))
    shares, slopes = np.zeros(shape), np.zeros(shape)
    slope = np.where(np.abs(angle) <= nodes[-1], -np.sin(angle) / width, 0.0)
    for index, weight, change in ((right, share, slope), (right - 1, 1.0 - share, -slope)):
        np.put_along_axis(shares, index[..., None], weight[..., None], axis=-1)
        np.put_along_axis(slopes, index[..., None], change[..., None], axis=-1)
    return shares[..., ::-1], slopes[..., ::-1]


def solve_at_angles(
    system: System, samples: Samples, region: Region, settings: CvStemSettings, angles: int
) -> AngleSolution:
    """Solve CV-STEM with a free matrix at each of a few angles (Theorem 2, equations 14 to 16).

    Args:
        system: The cart-pole.
        samples: Triples at which the condition is imposed.
        region: The region that they cover.
        settings: Rate, margin, weight of nu and scaling; the degree is not used.
        angles: Number of angles, from 0 to the region's largest.

    Raises:
        TypeError: The system is no cart-pole.
        InfeasibleError: There is none.
        ValueError: The samples are not of the system, or there is no second angle.
    """
    import cvxpy as cp

    check_cartpole(system, "solve_at_angles")
    check_at_least("angles", angles, 2)
    nodes = np.linspace(0.0, region.angle, angles)
    scale = np.asarray(settings.scaling or region.scaling)
    check_sizes(system, scaling=(scale, (SIZE,)))
    slope, gain, _ = condition_terms(system, samples)
    slope = slope * scale[:, None] / scale[None, :]
    gain = gain * scale[:, None]
    shares, share_slopes = hats(samples.state[:, ANGLE], nodes)
    rate = settings.contraction_rate + settings.margin
    duals = [cp.Variable((SIZE, SIZE), symmetric=True) for _ in nodes]
    weight, bound = cp.Variable(nonneg=True), cp.Variable()
    constraints: list[Any] = []
    for dual in duals:
        constraints += [dual >> np.eye(SIZE), dual << bound * np.eye(SIZE)]
    for index in range(len(samples.state)):
        used = np.flatnonzero(shares[index] + np.abs(share_slopes[index]))
        here = sum(shares[index, j] * duals[j] for j in used)
        speed = samples.state[index, ANGULAR_RATE]
        change = sum(speed * share_slopes[index, j] * duals[j] for j in used)
        product = slope[index] @ here
        left = product + product.T + 2.0 * rate * here - change
        constraints.append(left - 2.0 * weight * (gain[index] @ gain[index].T) << 0)
    problem: Any = cp.Problem(cp.Minimize(bound + settings.control_penalty * weight), constraints)
    with warnings.catch_warnings():
        # An inaccurate solution is taken too: every metric is checked afterwards.
        warnings.filterwarnings("ignore", message="Solution may be inaccurate")
        problem.solve(solver=cp.CLARABEL)
    if problem.status not in ("optimal", "optimal_inaccurate"):
        raise InfeasibleError(
            f"no metric at {angles} angles with alpha={settings.contraction_rate} exists on "
            f"{region} ({problem.status}): lower alpha or shrink the region"
        )
    found: Any = [dual.value for dual in duals]
    numbers: Any = weight.value, bound.value
    return AngleSolution(
        nodes,
        np.stack(found) / (scale[:, None] * scale[None, :]),
        settings.contraction_rate,
        float(numbers[0]),
        float(numbers[1]),
        scale,
    )


def solve_on_pool(
    system: System,
    pool: Samples,
    region: Region,
    settings: CvStemSettings,
    angles: int = 7,
    first: int = 80,
    rounds: int = 4,
) -> AngleSolution:
    """Solve at a few triples of a pool, add those that are violated most, and repeat.

    Unlike `cvstem.design_on_pool` it does not insist: what is still violated after the last round
    is for the training of the network.

    Args:
        system: The cart-pole.
        pool: Triples (x, x_d, u_d).
        region: The region that they cover.
        settings: Rate, margin, weight of nu and scaling.
        angles: Number of angles.
        first: Triples to begin with, and to add in a round at most.
        rounds: Programs at most.

    Raises:
        InfeasibleError: There is none.
    """
    active = np.arange(min(first, len(pool.state)))
    while True:
        solution = solve_at_angles(system, pool.take(active), region, settings, angles)
        residual = contraction_residual(system, solution, pool)
        rounds -= 1
        if residual.max() <= 0.0 or rounds <= 0:
            return solution
        worst = np.argsort(residual)[::-1][: min(first, int(np.sum(residual > 0.0)))]
        active = np.union1d(active, worst)
