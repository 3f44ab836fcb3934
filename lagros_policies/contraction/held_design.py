"""The invariant ellipsoid of a control that is held: a linear gain and a tube for all times.

In a hold, v = u - u_d is constant, so that z = (e, v) obeys a linear differential inclusion,

    dz/ds = [A(s) B(s); 0 0] z + E d(s),    E = (I; 0),  0 <= s <= h,

with A the mean of J(y, u_d) over the segment from x_d to x and B = B(x), both anywhere on a box.
A quadratic form that moves within the hold, V(s, z) = z'Q(s)^-1 z, obeys

    dV/ds <= -2 alpha V + 2 alpha   if   -dQ/ds + 2 sym([A B; 0 0] Q) + 2 alpha Q
                                          + w_bar^2 / (2 alpha) E E' <= 0                      (*)

(S-procedure for ||d|| <= w_bar, as for the ellipsoid at will). At an instant v becomes K e, and V
does not rise if V(0, (e, K e)) <= min_v V(h, (e, v)) = e'W(h)^-1 e, W the block of Q of e, which is

    Q(0) >= L W(h) L',    L = (I; K).                                                         (**)

So V <= 1 - exp(-2 alpha t) after e(0) = 0, at the instants and between them, and e'W(s)^-1 e <= V.
Nothing is linearised and no map of a hold is enclosed: d may change within the hold at will, and so
may u_d.

Q(s) is a polynomial in Bernstein's form, Q(s) = sum_i b_i(s / h) Q_i with b_i >= 0 that sum to one.
The left side of (*) has the same form, so that it is enough to impose it on its coefficients; they
are affine in Q_i. With Q_0 = [[W_0, Y'], [Y, Z]], K = Y W_0^-1 and W_N <= W_0, (**) is linear too:
gain and tube come from one semidefinite program. With W_i <= W_0 for all i the bound holds for
every sequence of holds of at most h.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields
from lagros_envs.dynamics import System
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.semidefinite import solve_conic, svec, symmetric_basis
from lagros_policies.contraction.systems import check_sizes
from lagros_policies.contraction.tube_design import Plans, self_contained

# Each program has but the samples that matter: some first, then the worst that its answer violates.
_WORST = 30
_ROUNDS = 40
# W_0 exceeds W_N by this share, so that the proof of (**) has room for its rounding.
_SLACK = 1e-4
_ROUNDING = 1e-9


@dataclass(frozen=True)
class HeldDesign:
    """What a tube of a held control is designed for.

    Attributes:
        period: The hold h [s].
        rate: alpha [1/s].
        output: c, shape (n,): what the tube should be narrow in; None for the whole state.
        disturbance_bound: w_bar, in units of the state per second.
        control_penalty: Weight of Z, the square of v, in the objective, which is in units
            of w_bar^2.
        floor: Least eigenvalue of every Q_i in units of w_bar^2, with v in `control_unit`.
        margin: Added to alpha at the samples, so that the condition holds between them [1/s].
        degree: N.
        control_unit: In which the program counts v: entries of one size.
        aperiodic: Whether every sequence of holds of at most h is to be covered.

    Raises:
        ValueError: A value is out of range.
    """

    period: float = 0.1
    rate: float = 0.5
    output: tuple[float, ...] | None = None
    disturbance_bound: float = 0.3
    control_penalty: float = 1e-4
    floor: float = 1e-3
    margin: float = 0.03
    degree: int = 6
    control_unit: float = 10.0
    aperiodic: bool = False

    def __post_init__(self) -> None:
        positive = "period", "rate", "disturbance_bound", "control_penalty", "floor", "control_unit"
        check_fields(self, positive, not_negative=["margin"], least={"degree": 1})


@dataclass(frozen=True)
class HeldTube:
    """A linear held control v = K e and the tube that it keeps, around trajectories of a box.

    Attributes:
        design: What it was designed for.
        duals: Q_i, shape (N + 1, n + m, n + m), of z = (e, v).
        gain: K, shape (m, n).
        plan: Where the target trajectories lie, some `Plans`.
        error: Errors for which the condition was imposed, shape (n,).
    """

    design: HeldDesign
    duals: FloatArray
    gain: FloatArray
    plan: Any
    error: FloatArray

    @property
    def states(self) -> int:
        """Number n of states."""
        return int(self.gain.shape[1])

    @property
    def steady_radius(self) -> float:
        """The bound of ||e|| at all times, as time goes on."""
        values = np.linalg.eigvalsh(self.duals[:, : self.states, : self.states])
        return math.sqrt(float(values.max())) * (1.0 + _ROUNDING)

    @property
    def steady_outputs(self) -> FloatArray:
        """The bounds of each |e_i| at all times, as time goes on, shape (n,)."""
        entries = np.diagonal(self.duals, axis1=1, axis2=2)[:, : self.states]
        bounds: FloatArray = np.sqrt(entries.max(axis=0)) * (1.0 + _ROUNDING)
        return bounds

    @property
    def largest_deviation(self) -> float:
        """The bound of ||u - u_d|| = ||K e||."""
        block = self.duals[0, self.states :, self.states :]
        return math.sqrt(float(np.linalg.eigvalsh(block)[-1])) * (1.0 + _ROUNDING)

    @property
    def contained(self) -> bool:
        """Whether the tube stays where the condition was imposed."""
        places = self.plan.bounded
        return bool(np.all(self.steady_outputs[places] <= self.error[places]))

    @property
    def proof_box(self) -> Any:
        """The box of x, x_d and u_d on which the condition is asked for."""
        return self.plan.with_errors(self.error)

    def share(self, time: Any) -> Any:
        """Return which share of the steady bounds is reached at times t [s] after e(0) = 0."""
        return np.sqrt(-np.expm1(-2.0 * self.design.rate * np.asarray(time, dtype=np.float64)))

    def output_radius(self, direction: FloatArray, time: Any) -> Any:
        """Return the bound of |c'e(t)| for c of shape (n,) at times t [s] after e(0) = 0."""
        blocks = self.duals[:, : self.states, : self.states]
        square = float(np.max(blocks @ direction @ direction))
        return math.sqrt(square) * self.share(time)

    def dual_at(self, phase: float) -> FloatArray:
        """Return Q(s), shape (n + m, n + m).

        Args:
            phase: s / h, from 0 to 1.
        """
        n = self.design.degree
        weights = [math.comb(n, i) * phase**i * (1.0 - phase) ** (n - i) for i in range(n + 1)]
        dual: FloatArray = np.tensordot(np.array(weights), self.duals, axes=1)
        return dual

    def energy(self, phase: float, error: FloatArray, deviation: FloatArray) -> FloatArray:
        """Return V(s, (e, v)), which never exceeds share(t)^2.

        Args:
            phase: s / h, from 0 to 1.
            error: e, shape (..., n).
            deviation: v, the deviation that is held, shape (..., m).
        """
        z = np.concatenate([error, deviation], axis=-1)
        value: FloatArray = np.sum(z @ np.linalg.inv(self.dual_at(phase)) * z, axis=-1)
        return value

    def control(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> FloatArray:
        """Return u = u_d + K (x - x_d), shape (..., m), to be held.

        Args:
            state: x, shape (..., n).
            nominal: x_d, shape (..., n).
            nominal_control: u_d, shape (..., m).
        """
        control: FloatArray = nominal_control + (state - nominal) @ self.gain.T
        return control


def design_held(system: System, plan: Plans, error: FloatArray, design: HeldDesign) -> HeldTube:
    """Solve the program on samples of a box (not yet proved).

    Args:
        system: The system.
        plan: Where the target trajectories lie, some `Plans`.
        error: Largest |x - x_d|, shape (n,).
        design: What to design.

    Raises:
        TypeError: The system is not that of the plans.
        InfeasibleError: There is no such tube.
        RuntimeError: The solver stopped for another reason.
        ValueError: There is no such box.
    """
    n, m = system.state_dim, system.control_dim
    if design.output is not None:
        check_sizes(system, output=(np.array(design.output), (n,)))
    slope, gain, chosen = plan.held_samples(system, error)
    lifted = _lifted(slope, gain, design.control_unit)
    for _ in range(_ROUNDS):
        duals, status = _solve(lifted[chosen], design, n)
        if duals is None and "Infeasible" in status:
            raise InfeasibleError(
                f"no held tube with alpha={design.rate} and period={design.period} exists for "
                f"{plan} and errors up to {np.round(error, 3).tolist()}: lower the disturbance "
                "bound, the period or alpha"
            )
        if duals is None:
            raise RuntimeError(f"the program stopped with status {status} for {design}")
        residual = _residual(lifted, duals, design, n)
        worst = np.argsort(residual)[-_WORST:]
        worst = worst[residual[worst] > 0.0]
        if not len(worst):
            break
        chosen[worst] = True
    else:
        raise RuntimeError(f"the samples still fail after {_ROUNDS} rounds for {design}")
    units = design.disturbance_bound * np.array([1.0] * n + [design.control_unit] * m)
    duals = duals * (units[:, None] * units)
    first = duals[0]
    feedback = np.linalg.solve(first[:n, :n], first[:n, n:]).T
    return HeldTube(design, duals, feedback, plan, error)


def design_held_contained(system: System, plan: Plans, design: HeldDesign) -> HeldTube:
    """Design a tube on the errors that it allows itself: from none, until both meet.

    Raises:
        InfeasibleError: The errors outgrow the box on which there is a tube.
        RuntimeError: The solver stopped, or the two did not meet.
    """
    return self_contained(
        lambda error: design_held(system, plan, error, design),
        f"disturbance_bound={design.disturbance_bound} held for {design.period} s around {plan}",
        system.state_dim,
    )


def bernstein_rate(degree: int) -> list[dict[int, float]]:
    """Return how the coefficients of h dQ/ds, raised to the degree of Q, depend on those of Q.

    Args:
        degree: N.

    Returns:
        For each of N + 1 coefficients the weights by index, whole numbers.
    """
    rows = []
    for i in range(degree + 1):
        row = {i - 1: -float(i), i: float(2 * i - degree), i + 1: float(degree - i)}
        rows.append({index: weight for index, weight in row.items() if weight != 0.0})
    return rows


def _lifted(slope: FloatArray, gain: FloatArray, unit: float) -> FloatArray:
    """Return [J B; 0 0] at samples, (s, n + m, n + m), with v in its unit."""
    n, size = slope.shape[-1], slope.shape[-1] + gain.shape[-1]
    lifted = np.zeros((len(slope), size, size))
    lifted[:, :n, :n], lifted[:, :n, n:] = slope, unit * gain
    return lifted


def _residual(lifted: FloatArray, duals: FloatArray, design: HeldDesign, n: int) -> FloatArray:
    """Return the largest eigenvalue of (*) at samples (s,), with half of the margin, (s,)."""
    rate = 2.0 * design.rate + design.margin
    source = _pushed(n, lifted.shape[-1]) / (2.0 * design.rate)
    worst = np.full(len(lifted), -math.inf)
    for dual, row in zip(duals, bernstein_rate(design.degree), strict=True):
        moved = sum(weight / design.period * duals[index] for index, weight in row.items())
        product = lifted @ dual
        left = product + np.swapaxes(product, -1, -2) + rate * dual + source - moved
        worst = np.maximum(worst, np.linalg.eigvalsh(left)[:, -1])
    return worst


def _pushed(n: int, size: int) -> FloatArray:
    """Return E E', the part of (e, v) that a disturbance pushes."""
    return np.diag(np.arange(size) < n).astype(np.float64)


def _solve(lifted: FloatArray, design: HeldDesign, n: int) -> tuple[FloatArray | None, str]:
    """Minimise t + lambda Z_0 over Q_0 ... Q_N and t for w_bar = 1; return them and the status."""
    import clarabel

    whole = lifted.shape[-1]
    basis = symmetric_basis(whole)
    size, count = len(basis), design.degree + 1
    columns = count * size + 1
    error_part = svec(basis[:, :n, :n]).T
    product = np.einsum("sab,jbc->sjac", lifted, basis)
    product = product + np.swapaxes(product, -1, -2) + 2.0 * (design.rate + design.margin) * basis
    motion = np.swapaxes(svec(product), -1, -2)
    source = _pushed(n, whole) / (2.0 * design.rate)
    blocks: list[FloatArray] = []
    rights: list[FloatArray] = []
    cones: list[Any] = []

    def impose(rows: dict[int, FloatArray], by_bound: FloatArray | None, right: FloatArray) -> None:
        # Rows z + slack = right, slack in a semidefinite cone: (Q_0, ..., Q_N, t) in columns.
        block = np.zeros((len(right), columns))
        for index, part in rows.items():
            block[:, index * size : (index + 1) * size] = part
        if by_bound is not None:
            block[:, -1] = by_bound
        blocks.append(block)
        rights.append(right)
        cones.append(clarabel.PSDTriangleConeT(round(math.sqrt(2 * len(right) + 0.25) - 0.5)))

    full, nothing = svec(basis).T, np.zeros(len(error_part))
    for index, rate in enumerate(bernstein_rate(design.degree)):
        still = {place: -weight / design.period * full for place, weight in rate.items()}
        for one in motion:
            moving = one + still.get(index, 0.0)
            impose({**still, index: moving}, None, -svec(source))
        impose({index: -full}, None, -design.floor * svec(np.eye(whole)))
        if index == design.degree or (design.aperiodic and index > 0):
            impose({0: -error_part, index: (1.0 + _SLACK) * error_part}, None, nothing)
        if design.output is None:
            impose({index: error_part}, -svec(np.eye(n)), nothing)
        else:
            c = np.array(design.output)
            width = basis[:, :n, :n] @ c @ c
            impose({index: width[None]}, np.array([-1.0]), np.zeros(1))
    cost = np.zeros(columns)
    effort = np.trace(basis[:, n:, n:], axis1=1, axis2=2)
    cost[:size] = design.control_penalty * design.control_unit**2 * effort
    cost[-1] = 1.0
    values, status = solve_conic(cost, blocks, rights, cones)
    if values is None:
        return None, status
    return np.einsum("kj,jab->kab", values[:-1].reshape(count, size), basis), status
