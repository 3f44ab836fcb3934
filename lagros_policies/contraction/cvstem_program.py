"""The semidefinite program of CV-STEM: what is asked, its cones, and its solution.

Theorem 2, equations (14)-(16): over W_bar = sum_i W_i phi_i of x or of x_d, nu and chi,

    min chi + lambda nu
    s.t. -dW_bar/dt + 2 sym(A W_bar) - 2 nu B B' <= -2 (alpha + margin) W_bar   at every sample
         I <= W_bar <= chi I                                                    at every place

with one (nu, chi) for all samples, in scaled states z = S x. cvxpy states the same problem in the
tests; here the matrices go to Clarabel directly, which spares the compilation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields, check_not_negative, check_positive, check_whole
from lagros_envs.dynamics import System, vector_field
from lagros_policies.contraction.basis import CONSTANT, Basis
from lagros_policies.contraction.condition import condition_terms
from lagros_policies.contraction.metric import default_basis
from lagros_policies.contraction.places import Point
from lagros_policies.contraction.regions import MetricRegion, Samples, even_coordinate
from lagros_policies.contraction.semidefinite import (
    cone_rows,
    solve_cones,
    svec,
    symmetric_basis,
)
from lagros_policies.contraction.systems import check_basis_unmoved, check_sizes


class InfeasibleError(ValueError):
    """The condition has no solution for the asked rate and region."""


@dataclass(frozen=True)
class CvStemSettings:
    """What to design.

    Attributes:
        contraction_rate: alpha [1/s].
        degree: Degree of W_bar in cos(x_i), x_i the even coordinate of the region; 0 is a constant
            metric. A basis takes its place.
        control_penalty: lambda, the weight of nu; zero is ill-posed.
        margin: Added to alpha at the samples, so that the condition holds between them [1/s].
        scaling: Diagonal of S, the units in which chi is measured, one per state; () for those of
            the region, or ones.
        basis: phi_i of W_bar; None for 1, cos(x_i), ...
        point: Whether they are functions of x ("state") or of x_d ("nominal").

    Raises:
        ValueError: A value is out of range.
    """

    contraction_rate: float = 0.3
    degree: int = 4
    control_penalty: float = 0.1
    margin: float = 0.05
    scaling: tuple[float, ...] = ()
    basis: Basis | None = None
    point: Point = "state"

    def __post_init__(self) -> None:
        check_fields(self)
        check_positive("contraction_rate", self.contraction_rate)
        check_whole("degree", self.degree, 0)
        if not self.control_penalty > 0.0:
            raise ValueError(
                f"control_penalty={self.control_penalty!r} must be > 0: without it nu is unbounded"
            )
        check_not_negative("margin", self.margin)
        for value in self.scaling:
            check_positive("scaling", value)

    @property
    def phi(self) -> Basis:
        """The functions phi_i, where they are named or W_bar is constant."""
        return self.basis or CONSTANT


def resolved(system: System, region: MetricRegion, settings: CvStemSettings) -> CvStemSettings:
    """Return settings whose basis and scaling are given, and those of a system.

    Raises:
        ValueError: They are of other states, or the degree is that of no coordinate.
    """
    n, phi = system.state_dim, settings.basis
    scaling = settings.scaling or getattr(region, "scaling", (1.0,) * n)
    check_sizes(system, scaling=(np.asarray(scaling), (n,)))
    if phi is None:
        if settings.degree > 0 and even_coordinate(region) is None:
            raise ValueError(
                f"degree={settings.degree!r} is that of the even coordinate of a region, and a "
                f"{type(region).__name__} has none: name a basis, or take degree=0"
            )
        phi = default_basis(region, settings.degree)
    if phi != CONSTANT and max(phi.coordinates) >= n:
        raise ValueError(
            f"basis: x[{max(phi.coordinates)}] is none of the {n} states of {system!r}"
        )
    return replace(settings, basis=phi, scaling=tuple(scaling))


def solve_program(
    conditions: FloatArray, places: FloatArray, region: MetricRegion, settings: CvStemSettings
) -> tuple[FloatArray, float, float]:
    """Return W_i of the scaled states (k, n, n), nu and chi, with the bounds at places."""
    symmetric = symmetric_basis(places.shape[1])
    spread = settings.phi.at(places)[:, :, None, None, None] * symmetric
    unit = np.broadcast_to(np.eye(places.shape[1]), (len(places), *symmetric.shape[1:]))
    below, above = cone_rows(-spread, None, None), cone_rows(spread, None, -unit)
    rights = np.zeros(len(conditions)), -svec(unit).ravel(), np.zeros(len(above))
    cost = np.zeros(conditions.shape[1])
    cost[-2:] = settings.control_penalty, 1.0
    values, status = solve_cones(cost, [conditions, below, above], rights, places.shape[1])
    asked = f"alpha={settings.contraction_rate} (margin {settings.margin})"
    if status in ("PrimalInfeasible", "AlmostPrimalInfeasible"):
        cosine = settings.phi.cosine is not None or settings.phi == CONSTANT
        kind = f"of degree {settings.phi.degree}" if cosine else "of this basis"
        raise InfeasibleError(
            f"no contraction metric {kind} with {asked} exists on {region}: lower alpha or the "
            "margin, raise the degree, or shrink the region"
        )
    if values is None:
        raise RuntimeError(
            f"CV-STEM stopped with status {status} for {asked} on {region}; try another "
            "control_penalty or scaling"
        )
    scaled = np.einsum("ij,jkl->ikl", values[:-2].reshape(settings.phi.size, -1), symmetric)
    return scaled, float(values[-2]), float(values[-1])


def condition_rows(system: System, samples: Samples, settings: CvStemSettings) -> FloatArray:
    """Return the rows of the condition at every sample, one cone each."""
    scale = np.asarray(settings.scaling)
    n, phi = system.state_dim, settings.phi
    slope, gain, motion = condition_terms(system, samples)
    place = samples.state
    if settings.point == "nominal":
        place = samples.nominal
        motion = vector_field(system, place, samples.nominal_control)
    else:
        check_basis_unmoved(system, phi, place, gain)
    slope = slope * scale[:, None] / scale[None, :]
    gain = gain * scale[:, None]
    symmetric = symmetric_basis(n)
    values, rates = phi.at(place), phi.rate(place, motion)
    # d/dW_ij of the condition's left side, (s, k, n(n+1)/2, n, n).
    product = np.einsum("sab,jbc->sjac", slope, symmetric)
    both = product + np.swapaxes(product, -1, -2)
    decay = 2.0 * (settings.contraction_rate + settings.margin)
    by_dual = values[:, :, None, None, None] * (both + decay * symmetric)[:, None]
    by_dual -= rates[:, :, None, None, None] * symmetric
    by_weight = -2.0 * gain @ np.swapaxes(gain, -1, -2)
    return cone_rows(by_dual, by_weight, None)
