"""Sampled-data CV-STEM jointly over samples: one metric and one gain for all plans of a task.

For a control that is held, with the hold map Phi, F = dPhi/dx, G = dPhi/du and E = dPhi/dd at
samples (x_d, u_d) of plans, and x_d+ the next instant, the program is over W(x_d) = sum_i W_i phi_i
and Y(x_d) = K W = sum_i Y_i phi_i:

    min  mean of trace(C W C') + rho trace(Z)
    s.t. [g W(x_d), (F W + G Y)'; F W + G Y, W(x_d+) - E E' / (1 - g)] >= 0,  g = exp(-2 alpha h),
         [Z(x_d), Y(x_d); Y(x_d)', W(x_d)] >= 0

at every sample. To first order, and between samples as far as they stand for what lies there,
e'W^-1 e <= d_bar^2 once it holds (S-procedure for ||d|| <= d_bar): C W C' is the square of the tube
of the outputs C e per unit of d_bar, Z that of v = K e. So what is minimised is the tube and the
control that it takes. `along_plan` solves the same condition for each plan alone, in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields
from lagros_envs.dynamics import System, linearise_hold
from lagros_envs.dynamics.integrate import SUBSTEPS, rk4_hold
from lagros_envs.dynamics.system import components
from lagros_envs.numbers import dual
from lagros_policies.contraction.basis import CONSTANT, Basis
from lagros_policies.contraction.cvstem_program import InfeasibleError
from lagros_policies.contraction.semidefinite import solve_conic, svec, symmetric_basis

# Samples at first, samples that a round adds, and rounds at most.
_FIRST, _ADDED, _ROUNDS = 60, 20, 25
# What counts as a violation, in units of the largest dual: the solver's accuracy lies below.
_VIOLATED = 1e-6


@dataclass(frozen=True)
class SampledDesign:
    """What metric and gain are designed for.

    Attributes:
        rate: alpha [1/s].
        output_weights: Squares of the diagonal of C, shape (n,).
        control_penalty: rho.
        basis: phi_i of x_d.

    Raises:
        ValueError: A value is out of range.
    """

    rate: float
    output_weights: tuple[float, ...]
    control_penalty: float = 0.01
    basis: Basis = CONSTANT

    def __post_init__(self) -> None:
        check_fields(self, positive=["rate", "control_penalty"])


@dataclass(frozen=True)
class SampledMetric:
    """Metric and gain as functions of x_d.

    Attributes:
        design: What they were designed for.
        duals: W_i, shape (k, n, n).
        products: Y_i, shape (k, m, n).
    """

    design: SampledDesign
    duals: FloatArray
    products: FloatArray

    def dual(self, nominal: FloatArray) -> FloatArray:
        """Return W at x_d (..., n), shape (..., n, n)."""
        found: FloatArray = np.einsum("...k,kij->...ij", self.design.basis.at(nominal), self.duals)
        return found

    def gain(self, nominal: FloatArray) -> FloatArray:
        """Return K = Y W^-1 of u = u_d + K e at x_d (..., n), shape (..., m, n)."""
        product = np.einsum("...k,kij->...ij", self.design.basis.at(nominal), self.products)
        found = np.linalg.solve(self.dual(nominal), np.swapaxes(product, -1, -2))
        return np.swapaxes(found, -1, -2)


def push_slope(system: System, state: FloatArray, control: FloatArray, period: float) -> FloatArray:
    """Return E = dPhi/dd of a hold, d constant within it and zero, shape (s, n, n).

    Args:
        system: The system.
        state: x, shape (s, n).
        control: u, shape (s, m).
        period: Hold [s].
    """
    n, count = system.state_dim, len(state)
    pushes = dual.seed([np.zeros(count)] * n)
    parts = rk4_hold(system, components(state), components(control), pushes, period, dual, SUBSTEPS)
    return dual.gradients(list(parts), n, (count,))


def design_sampled(
    system: System,
    period: float,
    states: FloatArray,
    controls: FloatArray,
    design: SampledDesign,
) -> SampledMetric:
    """Solve the program of this module, with the samples at which it binds.

    It begins with some samples and adds those at which its answer violates the condition most,
    until there are none.

    Args:
        system: The system.
        period: Hold h [s].
        states: x_d, shape (s, n).
        controls: u_d, shape (s, m).
        design: What is wanted.

    Raises:
        InfeasibleError: There is no such metric, the solver finds none, or samples go on binding.
    """
    slopes = _slopes(system, period, states, controls, design)
    chosen = np.unique(np.linspace(0, len(states) - 1, _FIRST).astype(int))
    for _ in range(_ROUNDS):
        metric = _solved(tuple(part[chosen] for part in slopes), design)
        worst = _violation(metric, slopes)
        if np.max(worst) <= _VIOLATED:
            return metric
        added = np.argsort(-worst)[:_ADDED]
        chosen = np.union1d(chosen, added[worst[added] > 0.0])
    raise InfeasibleError(
        f"{len(chosen)} samples bind after {_ROUNDS} rounds and {int(np.sum(worst > _VIOLATED))} "
        "others are still violated: give fewer, or a richer basis"
    )


# phi at x_d and at x_d+, F, G, and g W's share of E E' / (1 - g).
_Slopes = tuple[FloatArray, ...]


def _slopes(
    system: System, period: float, states: FloatArray, controls: FloatArray, design: SampledDesign
) -> _Slopes:
    following, by_state, by_control = linearise_hold(system, states, controls, period)
    by_push = push_slope(system, states, controls, period)
    decay = np.full((len(states), 1, 1), math.exp(-2.0 * design.rate * period))
    pushed = by_push @ np.swapaxes(by_push, -1, -2) / (1.0 - decay)
    basis = design.basis
    return basis.at(states), basis.at(following), by_state, by_control, pushed, decay


def _violation(metric: SampledMetric, slopes: _Slopes) -> FloatArray:
    """Return by how much the condition fails at samples, in units of the largest dual, (s,)."""
    here, ahead, by_state, by_control, pushed, decay = slopes
    dual_here = np.einsum("sk,kij->sij", here, metric.duals)
    product = np.einsum("sk,kij->sij", here, metric.products)
    after = np.einsum("sk,kij->sij", ahead, metric.duals) - pushed
    moved = by_state @ dual_here + by_control @ product
    least = np.linalg.eigvalsh(_block(decay * dual_here, moved, after))[:, 0]
    scale = float(np.abs(np.linalg.eigvalsh(dual_here)).max())
    return np.asarray(-least / scale)


def _solved(slopes: _Slopes, design: SampledDesign) -> SampledMetric:
    import clarabel

    here, ahead, by_state, by_control, pushed, decay = slopes
    count, n, m = by_control.shape
    # Unit matrices of the unknowns of one function phi_i: W_i, then Y_i, then Z_i.
    square, corner = symmetric_basis(n), symmetric_basis(m)
    full = np.eye(m * n).reshape(m * n, m, n)
    zero = np.zeros
    duals = np.concatenate([square, zero((len(full) + len(corner), n, n))])
    products = np.concatenate([zero((len(square), m, n)), full, zero((len(corner), m, n))])
    squares = np.concatenate([zero((len(square) + len(full), m, m)), corner])
    # Derivatives by the unknowns of every function, shape (s, k, unknowns, ., .).
    local, later = (phi[:, :, None, None, None] for phi in (here, ahead))
    moved = local * (by_state[:, None, None] @ duals + by_control[:, None, None] @ products)
    contracts = _block(decay[:, None, None] * local * duals, moved, later * duals)
    spends = _block(local * duals, local * products, local * squares)
    offset = zero((count, 2 * n, 2 * n))
    offset[:, n:, n:] = -pushed
    blocks, rights = [], []
    for rows, right in ((contracts, offset), (spends, zero((count, n + m, n + m)))):
        vectors = np.moveaxis(svec(rows), -1, 1)
        blocks.append(-vectors.reshape(-1, here.shape[1] * len(duals)))
        rights.append(svec(right).ravel())
    price = np.einsum("i,uii->u", np.array(design.output_weights), duals)
    price = price + design.control_penalty * np.trace(squares, axis1=1, axis2=2)
    cost = np.multiply.outer(here.mean(axis=0), price).ravel()
    cones = [clarabel.PSDTriangleConeT(2 * n)] * count + [clarabel.PSDTriangleConeT(n + m)] * count
    found, status = solve_conic(cost, blocks, rights, cones)
    if found is None:
        raise InfeasibleError(
            f"no metric for rate={design.rate:g} at {count} samples (Clarabel: {status}): lower "
            "the rate, or take a richer basis"
        )
    unknowns = found.reshape(here.shape[1], len(duals))
    return SampledMetric(
        design,
        np.einsum("ku,uij->kij", unknowns, duals),
        np.einsum("ku,uij->kij", unknowns, products),
    )


def _block(first: FloatArray, below: FloatArray, last: FloatArray) -> FloatArray:
    """Return symmetric matrices [first, below'; below, last] of batches of blocks."""
    shape = np.broadcast_shapes(first.shape[:-2], below.shape[:-2], last.shape[:-2])
    first, below, last = (
        np.broadcast_to(part, shape + part.shape[-2:]) for part in (first, below, last)
    )
    above = np.concatenate([first, np.swapaxes(below, -1, -2)], axis=-1)
    under = np.concatenate([below, last], axis=-1)
    return np.concatenate([above, under], axis=-2)
