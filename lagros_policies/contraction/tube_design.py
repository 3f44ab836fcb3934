"""Constant metrics that make a tube small: the paper's, one for an output, and the ellipsoid.

With W constant, A the SDC matrix and w = d + B(u_L - u*), ||w|| <= w_bar, three programs in W:

    paper       -2 nu B B' + 2 sym(A W) + 2 alpha W <= 0,  I <= W,          least lambda_max(W)
    output c    the same,                                                   least c'W c
    ellipsoid   -2 nu B B' + 2 sym(A W) + 2 alpha W + w_bar^2 / (2 alpha) I <= 0,
                                                      least lambda_max(W), or c'W c

The first two give ||e||_M <= w_bar / alpha at most (Theorem 1, lambda_max(M) = 1), so that
|c'e| <= sqrt(c'W c) w_bar / alpha. They bound the push of a disturbance by its largest in any
direction. The third weighs it by direction (S-procedure for a peak-bounded w, Boyd et al. 1994,
section 6.1.3): for V = e'W^-1 e

    dV/dt <= -2 alpha V + 2 alpha,    so that V <= 1 - exp(-2 alpha t) after V(0) = 0

and |c'e| <= sqrt(c'W c (1 - exp(-2 alpha t))): the ellipsoid V <= 1 is never left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar

import numpy as np

from lagros_envs.aliases import moved_names
from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import check_fields
from lagros_envs.dynamics import System, control_matrix, jacobian
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.regions import BoxRegion
from lagros_policies.contraction.semidefinite import solve_conic, svec, symmetric_basis

moved_names(__name__)
Method = Literal["paper", "output", "ellipsoid"]

# Points of a box at which the condition is imposed, and those that a held control begins with.
_SAMPLES = 300
_FIRST = 40
_LEAST_ERROR = 1e-9
# Rounds in which the errors that the tube allows, and those that the condition allows, meet.
_ROUNDS = 40
# The errors allowed exceed those of the tube by this share, so that the rounds end.
_ROOM = 1.01
# Far above the rounding of an eigenvalue of a small matrix whose condition is below 1e5.
_ROUNDING = 1e-9


class Plans(Protocol):
    """Where target trajectories lie: `PlanBounds`, or a set with a shape of its own."""

    @property
    def bounded(self) -> list[int]:
        """Which coordinates of x are bounded; the others are free."""

    def with_errors(self, error: FloatArray) -> Any:
        """Return the box of x, x_d and u_d for errors of at most `error`, shape (n,)."""

    def samples(self, system: System, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return J(y, u_d), shape (s, n, n), and B(x), (s, n, m), at points of that box."""

    def held_samples(
        self, system: System, error: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the same for a control that is held, and which to begin with, shape (s,)."""


@dataclass(frozen=True)
class PlanBounds:
    """Target trajectories in a box.

    Attributes:
        low: Least x_d, shape (n,); infinite where the motion does not depend on it.
        high: Largest x_d.
        control_low: Least u_d, shape (m,).
        control_high: Largest u_d.

    Raises:
        ValueError: A lower bound is not below its upper bound.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    control_low: tuple[float, ...]
    control_high: tuple[float, ...]

    def __post_init__(self) -> None:
        self.with_errors(np.ones(len(self.low)))

    @property
    def bounded(self) -> list[int]:
        """Which coordinates of x are bounded."""
        return [int(index) for index in np.flatnonzero(np.isfinite(self.low))]

    def with_errors(self, error: FloatArray) -> BoxRegion:
        """Return the box of x, x_d and u_d for errors of at most `error`, shape (n,)."""
        some = np.maximum(error, _LEAST_ERROR)
        low, high = np.array(self.low) - some, np.array(self.high) + some
        ends = [tuple(end.tolist()) for end in (low, high, some)]
        return BoxRegion(ends[0], ends[1], ends[2], self.control_low, self.control_high)

    def samples(self, system: System, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return J(y, u_d), shape (s, n, n), and B(x), (s, n, m), at random corners and middles."""
        box, rng = self.with_errors(error), np.random.default_rng(0)

        def drawn(low: Sequence[float], high: Sequence[float]) -> FloatArray:
            ends = np.array([low, high])
            ends = np.where(np.isfinite(ends), ends, 0.0)
            three = np.stack([ends[0], ends.mean(axis=0), ends[1]])
            return np.take_along_axis(three, rng.integers(0, 3, (_SAMPLES, len(low))), axis=0)

        y, control = drawn(box.low, box.high), drawn(box.control_low, box.control_high)
        x = np.clip(y + rng.choice([-1.0, 0.0, 1.0], y.shape) * np.array(box.error), *_finite(box))
        return jacobian(system, y, control)[0], control_matrix(system, x)

    def held_samples(
        self, system: System, error: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return `samples`, and the first of them to begin with."""
        slope, gain = self.samples(system, error)
        return slope, gain, np.arange(len(slope)) < _FIRST


def _finite(box: BoxRegion) -> tuple[FloatArray, FloatArray]:
    low, high = np.array(box.low), np.array(box.high)
    return np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, 0.0)


@dataclass(frozen=True)
class TubeDesign:
    """What a constant metric is designed for.

    Attributes:
        method: One of the three programs.
        rate: alpha [1/s].
        output: c, shape (n,): what the tube should be narrow in; None for the whole state.
        disturbance_bound: w_bar, in units of the state per second.
        control_penalty: lambda, weight of nu in the objective; for the ellipsoid, whose W grows
            with the square of the disturbance, in units of w_bar^2.
        floor: Least eigenvalue of the ellipsoid's W in units of w_bar^2 / (2 alpha): a W that is
            almost singular is hard to prove.
        margin: Added to alpha at the samples, so that the condition holds between them [1/s].

    Raises:
        ValueError: A value is out of range, or the output does not fit the method.
    """

    method: Method = "ellipsoid"
    rate: float = 0.8
    output: tuple[float, ...] | None = None
    disturbance_bound: float = 0.75
    control_penalty: float = 0.02
    floor: float = 0.03
    margin: float = 0.05

    def __post_init__(self) -> None:
        positive = "rate", "disturbance_bound", "control_penalty", "floor"
        check_fields(self, positive, not_negative=["margin"])
        if self.method == "output" and self.output is None:
            raise ValueError("output=None: method='output' needs the direction c")
        if self.method == "paper" and self.output is not None:
            raise ValueError("output must be None for method='paper': use method='output'")

    @property
    def source(self) -> float:
        """w_bar^2 / (2 alpha), what the disturbance adds to the condition; 0 but for the ellipsoid.

        The margin counts as part of alpha in the program, not here.
        """
        return self.disturbance_bound**2 / (2.0 * self.rate) if self.method == "ellipsoid" else 0.0


@dataclass(frozen=True)
class ConstantTube:
    """A tube of a constant metric around target trajectories of a box.

    Attributes:
        design: What it was designed for.
        dual: W, shape (n, n). For the ellipsoid V = e'W^-1 e <= 1 is the tube; else I <= W.
        control_weight: nu.
        plan: Where the target trajectories lie, some `Plans`.
        error: Errors for which the condition was imposed, shape (n,).
    """

    design: TubeDesign
    dual: FloatArray
    control_weight: float
    plan: Any
    error: FloatArray

    @property
    def energy(self) -> float:
        """The bound of V = e'W^-1 e, as time goes on."""
        if self.design.method == "ellipsoid":
            return 1.0
        return (self.design.disturbance_bound / self.design.rate) ** 2 / self.least_eigenvalue

    @property
    def least_eigenvalue(self) -> float:
        """A number below the least eigenvalue of W: lambda_max(M) is at most one over it."""
        return float(np.linalg.eigvalsh(self.dual)[0]) * (1.0 - _ROUNDING)

    @property
    def steady_radius(self) -> float:
        """The bound of ||e|| as time goes on."""
        largest = float(np.linalg.eigvalsh(self.dual)[-1]) * (1.0 + _ROUNDING)
        return math.sqrt(self.energy * largest)

    @property
    def steady_outputs(self) -> FloatArray:
        """The bounds of each |e_i| as time goes on, shape (n,)."""
        bounds: FloatArray = np.sqrt(self.energy * np.diag(self.dual)) * (1.0 + _ROUNDING)
        return bounds

    @property
    def contained(self) -> bool:
        """Whether the tube stays where its condition was imposed, without which it is none."""
        places = self.plan.bounded
        return bool(np.all(self.steady_outputs[places] <= self.error[places]))

    @property
    def largest_bound(self) -> float:
        """The largest w_bar for which the tube is contained; for the ellipsoid its own or zero."""
        if self.design.method == "ellipsoid":
            return self.design.disturbance_bound if self.contained else 0.0
        places = self.plan.bounded
        room = float(np.min(self.error[places] / self.steady_outputs[places]))
        return room * self.design.disturbance_bound

    @property
    def proof_box(self) -> Any:
        """The box of x, x_d and u_d on which the condition is asked for."""
        return self.plan.with_errors(self.error)

    def share(self, time: Any) -> Any:
        """Return which share of the steady radius is reached at times t [s] after e(0) = 0."""
        rate = self.design.rate
        if self.design.method == "ellipsoid":
            return np.sqrt(-np.expm1(-2.0 * rate * np.asarray(time, dtype=np.float64)))
        return -np.expm1(-rate * np.asarray(time, dtype=np.float64))

    def output_radius(self, direction: FloatArray, time: Any) -> Any:
        """Return the bound of |c'e(t)| for c of shape (n,) at times t [s] after e(0) = 0."""
        return math.sqrt(self.energy * float(direction @ self.dual @ direction)) * self.share(time)


def design_constant(
    system: System, plan: Plans, error: FloatArray, design: TubeDesign
) -> ConstantTube:
    """Solve one of the three programs on samples of a box (not yet proved).

    Args:
        system: The system.
        plan: Where the target trajectories lie.
        error: Largest |x - x_d|, shape (n,).
        design: What to design.

    Raises:
        TypeError: The system is not that of the plans.
        InfeasibleError: There is no such constant metric.
        RuntimeError: The solver stopped for another reason.
        ValueError: There is no such box.
    """
    slope, gain = plan.samples(system, error)
    dual, weight, status = _solve(slope, gain, design)
    if dual is None:
        if "Infeasible" in status:
            raise InfeasibleError(
                f"no constant metric with alpha={design.rate} exists for {plan} and errors up to "
                f"{np.round(error, 3).tolist()}: lower alpha or the disturbance bound"
            )
        raise RuntimeError(f"the program stopped with status {status} for {design}")
    return ConstantTube(design, dual, weight, plan, error)


class TubeInBox(Protocol):
    """A tube whose condition was imposed on a box."""

    @property
    def steady_outputs(self) -> FloatArray:
        """Bound of each |e_i|, shape (n,)."""

    @property
    def contained(self) -> bool:
        """Whether the tube keeps the state in that box."""


Contained = TypeVar("Contained", bound=TubeInBox)


def design_contained(system: System, plan: Plans, design: TubeDesign) -> ConstantTube:
    """Design a tube on the errors that it allows itself: from none, until both meet.

    Raises:
        InfeasibleError: The errors outgrow the box on which there is a metric.
        RuntimeError: The solver stopped, or the two did not meet.
    """
    return self_contained(
        lambda error: design_constant(system, plan, error, design),
        f"disturbance_bound={design.disturbance_bound} around {plan}",
        system.state_dim,
    )


def self_contained(
    design_for: Callable[[FloatArray], Contained], what: str, states: int
) -> Contained:
    """Design a tube again and again, each time on the errors that the last one allows.

    Args:
        design_for: Gives the tube for errors (n,) up to which its condition is to hold; ValueError
            (so InfeasibleError) where there is none.
        what: What the tube is for, to be said where there is none.
        states: Number n of states.

    Returns:
        The first tube that is contained in the box of its condition.

    Raises:
        InfeasibleError: The errors outgrow the box on which there is a tube.
        RuntimeError: The two did not meet.
    """
    error = np.zeros(states)
    for _ in range(_ROUNDS):
        try:
            tube = design_for(error)
        except ValueError as problem:
            raise InfeasibleError(f"no contained tube for {what}: {problem}") from problem
        if tube.contained:
            return tube
        error = np.maximum(error, _ROOM * tube.steady_outputs)
    raise RuntimeError(f"the errors still grow after {_ROUNDS} rounds for {what}")


def _solve(
    slope: FloatArray, gain: FloatArray, design: TubeDesign
) -> tuple[FloatArray | None, float, str]:
    """Minimise t + lambda nu over W, nu and t; return W, nu and the solver's status."""
    import clarabel

    n = slope.shape[-1]
    basis = symmetric_basis(n)
    size = len(basis)
    product = np.einsum("sab,jbc->sjac", slope, basis)
    by_dual = product + np.swapaxes(product, -1, -2)
    by_dual = by_dual + 2.0 * (design.rate + design.margin) * basis
    by_weight = -2.0 * gain @ np.swapaxes(gain, -1, -2)
    eye = np.eye(n)
    floor = design.floor * design.source if design.method == "ellipsoid" else 1.0
    # Rows z + slack = right, slack in a cone: (W, nu, t) in columns.
    blocks = [
        np.column_stack([svec(part).T, svec(push), np.zeros(size)])
        for part, push in zip(by_dual, by_weight, strict=True)
    ]
    rights = [-svec(design.source * eye)] * len(slope)
    blocks.append(np.column_stack([-svec(basis).T, np.zeros((size, 2))]))
    rights.append(-floor * svec(eye))
    cones: list[Any] = [clarabel.PSDTriangleConeT(n)] * (len(slope) + 1)
    if design.output is None:
        blocks.append(np.column_stack([svec(basis).T, np.zeros(size), -svec(eye)]))
        rights.append(np.zeros(size))
        cones.append(clarabel.PSDTriangleConeT(n))
    else:
        c = np.asarray(design.output)
        blocks.append(np.concatenate([basis @ c @ c, [0.0, -1.0]])[None])
        rights.append(np.zeros(1))
        cones.append(clarabel.NonnegativeConeT(1))
    cost = np.zeros(size + 2)
    unit = design.disturbance_bound**2 if design.method == "ellipsoid" else 1.0
    cost[-2:] = design.control_penalty * unit, 1.0
    values, status = solve_conic(cost, blocks, rights, cones)
    if values is None:
        return None, 0.0, status
    dual = np.einsum("j,jab->ab", values[:size], basis)
    return dual, float(values[size]), status
