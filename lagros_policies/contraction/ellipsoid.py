"""Proof and control law of a tube with a constant metric, first of all of the invariant ellipsoid.

The condition of the ellipsoid is Theorem 2's (14) and a constant more:

    2 sym(A W) - 2 nu B B' + 2 alpha W + w_bar^2 / (2 alpha) I < 0.

It is proved on a continuous box by the search that proves (14), with the constant added to every
enclosure.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import System, control_matrix, vector_field
from lagros_envs.numbers import Interval, exact
from lagros_policies.contraction.basis import CONSTANT
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.regions import BoxRegion
from lagros_policies.contraction.tube_design import ConstantTube, TubeDesign
from lagros_policies.proof.cells import Search, search
from lagros_policies.proof.families import BoxCondition, Violation, rate_matrices
from lagros_policies.proof.matrices import negative_definite
from lagros_policies.proof.sets import triples

# ||phi_1||^2 below which the control has no effect on V.
_TINY = 1e-300
# Cells of one pass, and of a whole search.
_BATCH = 100
_MOST_CELLS = 1_000_000


@dataclass(frozen=True)
class TubeProof:
    """What the proof of a tube came to.

    Attributes:
        tube: The tube asked about.
        condition: The search for a proof of its condition on the box.
        proved: Whether the tube is proved: the condition on the whole box, W as definite as the
            tube needs, and the tube inside the box.
        seconds: Time taken [s].
    """

    tube: ConstantTube
    condition: Search[Violation]
    proved: bool
    seconds: float


def as_metric(tube: ConstantTube) -> Metric:
    """Return the constant metric of a tube, for what takes a `Metric`."""
    values, box = np.linalg.eigvalsh(tube.dual), tube.proof_box
    return Metric(
        coefficients=tube.dual[None],
        contraction_rate=tube.design.rate,
        condition_bound=float(values[-1] / values[0]),
        control_weight=tube.control_weight,
        scaling=np.ones(len(tube.dual)),
        region=box if isinstance(box, BoxRegion) else box.region,
        basis=CONSTANT,
    )


def prove_tube(system: System, tube: ConstantTube, most_seconds: float = 60.0) -> TubeProof:
    """Prove a tube on the continuous box of its condition, or say that there is no proof.

    What is proved: for every target trajectory in `tube.plan`, from e(0) = 0, under every
    disturbance (with what a learning error adds) of norm at most w_bar and under the control of
    `TubeControl` at will, |c'e(t)| <= tube.output_radius(c, t) for every c and t. The metric is
    constant, so that no disturbance enters dM/dt; the tube keeps x in the box by itself.

    Args:
        system: The system.
        tube: The tube.
        most_seconds: Time after which the search gives up [s].

    Raises:
        TypeError: The system is not that of the tube.
    """
    start = time.monotonic()
    if not tube.least_eigenvalue > 0.0:
        return TubeProof(tube, Search(False, 0, 0.0), False, time.monotonic() - start)
    matrices = rate_matrices(system, as_metric(tube), tube.design.rate, _source(tube.design))
    condition = BoxCondition(triples(tube.proof_box, system, "state"), matrices)
    found = search(condition, _BATCH, _MOST_CELLS, most_seconds)
    eye = np.eye(len(tube.dual))
    definite = bool(negative_definite(tube.least_eigenvalue * eye - exact(tube.dual)))
    proved = found.proved and definite and tube.contained
    return TubeProof(tube, found, proved, time.monotonic() - start)


@dataclass(frozen=True)
class TubeControl:
    """The least deviation from u_d under which V = e'W^-1 e keeps to its tube (Theorem 2, (17)).

    For the ellipsoid dV/dt <= -2 alpha V - w_bar^2 / (2 alpha) ||W^-1 e||^2 without the
    disturbance, which leaves dV/dt <= -2 alpha V + 2 alpha with it; for the others the paper's
    dV/dt <= -2 alpha V. Closed form, for a control at will.

    Attributes:
        system: The system.
        tube: The tube.

    Raises:
        TypeError: The system is not that of the tube.
    """

    system: System
    tube: ConstantTube

    def terms(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return phi_0 (...) and phi_1 (..., m): v is allowed where phi_0 + phi_1'v <= 0."""
        design = self.tube.design
        error = state - nominal
        pull = error @ np.linalg.inv(self.tube.dual)
        drift = vector_field(self.system, state, nominal_control)
        drift = drift - vector_field(self.system, nominal, nominal_control)
        phi_0 = 2.0 * np.sum(pull * (drift + design.rate * error), axis=-1)
        phi_0 = phi_0 + design.source * np.sum(pull * pull, axis=-1)
        gain = control_matrix(self.system, state)
        return phi_0, 2.0 * np.einsum("...ij,...i->...j", gain, pull)

    def __call__(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> FloatArray:
        """Return u*, shape (..., m).

        Args:
            state: x, shape (..., n).
            nominal: x_d, shape (..., n).
            nominal_control: u_d, shape (..., m).
        """
        phi_0, phi_1 = self.terms(state, nominal, nominal_control)
        size = np.sum(phi_1 * phi_1, axis=-1)
        acts = (phi_0 > 0.0) & (size > _TINY)
        gain = np.where(acts, phi_0 / np.where(size > _TINY, size, 1.0), 0.0)
        control: FloatArray = nominal_control - gain[..., None] * phi_1
        return control


def _source(design: TubeDesign) -> Interval | None:
    """Enclose what the disturbance adds, w_bar^2 / (2 alpha) for the ellipsoid and else nothing."""
    if design.method != "ellipsoid":
        return None
    return exact(design.disturbance_bound).square() / (exact(design.rate) * 2.0)
