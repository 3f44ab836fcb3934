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
from numpy.typing import NDArray
from scipy import sparse

from lagros_envs.checks import check_fields, check_not_negative, check_positive, check_whole
from lagros_envs.dynamics import System, control_matrix, jacobian
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, VELOCITY
from lagros_policies.contraction.cvstem import InfeasibleError
from lagros_policies.contraction.semidefinite import solve_conic, svec, symmetric_basis
from lagros_policies.contraction.systems import check_cartpole
from lagros_policies.contraction.tube_design import PlanBox, self_contained
from lagros_policies.proof.box import ProofBox

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_STATES = 4
_SIZE = _STATES + 1
# The program is solved for v in units of 10 N and for w_bar = 1: entries of one size.
_FORCE = 10.0
# Angles of x, and of y around each, at which the condition is imposed. Each program has but those
# that matter: the outermost first, then the worst that its answer violates.
_ANGLES = 9
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
        output: c, shape (4,): what the tube should be narrow in; None for the whole state.
        disturbance_bound: w_bar, in units of the state per second.
        control_penalty: Weight of Z, the square of the force, in the objective, which is in units
            of w_bar^2 [1/N^2].
        floor: Least eigenvalue of every Q_i in units of w_bar^2, with v in units of 10 N.
        margin: Added to alpha at the samples, so that the condition holds between them [1/s].
        degree: N.
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
    aperiodic: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        for name in ("period", "rate", "disturbance_bound", "control_penalty", "floor"):
            check_positive(name, getattr(self, name))
        check_not_negative("margin", self.margin)
        check_whole("degree", self.degree)
        if self.output is not None and len(self.output) != _STATES:
            raise ValueError(f"output={self.output!r} must have {_STATES} entries")


@dataclass(frozen=True)
class HeldTube:
    """A linear held control v = K e and the tube that it keeps, around trajectories of a box.

    Attributes:
        design: What it was designed for.
        duals: Q_i, shape (N + 1, 5, 5), of z = (e, v).
        gain: K, shape (1, 4).
        plan: Where the target trajectories lie.
        error: Errors for which the condition was imposed, shape (4,).
    """

    design: HeldDesign
    duals: FloatArray
    gain: FloatArray
    plan: PlanBox
    error: FloatArray

    @property
    def steady_radius(self) -> float:
        """The bound of ||e|| at all times, as time goes on."""
        values = np.linalg.eigvalsh(self.duals[:, :_STATES, :_STATES])
        return math.sqrt(float(values.max())) * (1.0 + _ROUNDING)

    @property
    def steady_outputs(self) -> FloatArray:
        """The bounds of each |e_i| at all times, as time goes on, shape (4,)."""
        entries = np.diagonal(self.duals, axis1=1, axis2=2)[:, :_STATES]
        bounds: FloatArray = np.sqrt(entries.max(axis=0)) * (1.0 + _ROUNDING)
        return bounds

    @property
    def largest_deviation(self) -> float:
        """The bound of |u - u_d| = |K e| [N]."""
        return math.sqrt(float(self.duals[0, _STATES, _STATES])) * (1.0 + _ROUNDING)

    @property
    def contained(self) -> bool:
        """Whether the tube stays where the condition was imposed; the position is free."""
        places = [ANGLE, VELOCITY, ANGULAR_RATE]
        return bool(np.all(self.steady_outputs[places] <= self.error[places]))

    @property
    def proof_box(self) -> ProofBox:
        """The box of x, x_d and u_d on which the condition is asked for."""
        return self.plan.with_errors(self.error)

    def share(self, time: Any) -> Any:
        """Return which share of the steady bounds is reached at times t [s] after e(0) = 0."""
        return np.sqrt(-np.expm1(-2.0 * self.design.rate * np.asarray(time, dtype=np.float64)))

    def output_radius(self, direction: FloatArray, time: Any) -> Any:
        """Return the bound of |c'e(t)| for c of shape (4,) at times t [s] after e(0) = 0."""
        blocks = self.duals[:, :_STATES, :_STATES]
        square = float(np.max(blocks @ direction @ direction))
        return math.sqrt(square) * self.share(time)

    def dual_at(self, phase: float) -> FloatArray:
        """Return Q(s), shape (5, 5).

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
            error: e, shape (..., 4).
            deviation: v, the deviation that is held, shape (..., 1) [N].
        """
        z = np.concatenate([error, deviation], axis=-1)
        value: FloatArray = np.sum(z @ np.linalg.inv(self.dual_at(phase)) * z, axis=-1)
        return value

    def control(
        self, state: FloatArray, nominal: FloatArray, nominal_control: FloatArray
    ) -> FloatArray:
        """Return u = u_d + K (x - x_d), shape (..., 1), to be held [N].

        Args:
            state: x, shape (..., 4).
            nominal: x_d, shape (..., 4).
            nominal_control: u_d, shape (..., 1).
        """
        control: FloatArray = nominal_control + (state - nominal) @ self.gain.T
        return control


def design_held(system: System, plan: PlanBox, error: FloatArray, design: HeldDesign) -> HeldTube:
    """Solve the program on samples of a box (not yet proved).

    Args:
        system: A cart-pole.
        plan: Where the target trajectories lie.
        error: Largest |x - x_d|, shape (4,); that of the position does not matter.
        design: What to design.

    Returns:
        The tube.

    Raises:
        TypeError: The system is no cart-pole.
        InfeasibleError: There is no such tube.
        RuntimeError: The solver stopped for another reason.
        ValueError: The box reaches pi/2.
    """
    check_cartpole(system, "design_held")
    lifted, chosen = _samples(system, plan.with_errors(error))
    for _ in range(_ROUNDS):
        duals, status = _solve(lifted[chosen], design)
        if duals is None and "Infeasible" in status:
            raise InfeasibleError(
                f"no held tube with alpha={design.rate} and period={design.period} exists for "
                f"{plan} and errors up to {np.round(error, 3).tolist()}: lower the disturbance "
                "bound, the period or alpha"
            )
        if duals is None:
            raise RuntimeError(f"the program stopped with status {status} for {design}")
        residual = _residual(lifted, duals, design)
        worst = np.argsort(residual)[-_WORST:]
        worst = worst[residual[worst] > 0.0]
        if not len(worst):
            break
        chosen[worst] = True
    else:
        raise RuntimeError(f"the samples still fail after {_ROUNDS} rounds for {design}")
    units = design.disturbance_bound * np.array([1.0] * _STATES + [_FORCE])
    duals = duals * (units[:, None] * units)
    first = duals[0]
    feedback = np.linalg.solve(first[:_STATES, :_STATES], first[:_STATES, _STATES:]).T
    return HeldTube(design, duals, feedback, plan, error)


def design_held_contained(system: System, plan: PlanBox, design: HeldDesign) -> HeldTube:
    """Design a tube on the errors that it allows itself: from none, until both meet.

    Args:
        system: A cart-pole.
        plan: Where the target trajectories lie.
        design: What to design.

    Returns:
        A tube that is contained in the box of its condition.

    Raises:
        InfeasibleError: The errors outgrow the box on which there is a tube.
        RuntimeError: The solver stopped, or the two did not meet.
    """
    return self_contained(
        lambda error: design_held(system, plan, error, design),
        f"disturbance_bound={design.disturbance_bound} held for {design.period} s around {plan}",
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


def _samples(system: System, box: ProofBox) -> tuple[FloatArray, BoolArray]:
    """Return [J B; 0 0] at points of a box, (s, 5, 5), and which to begin with, (s,)."""
    error = min(box.angle_error, 2.0 * box.angle)
    gaps = np.linspace(-error, error, _ANGLES)
    # Where y reaches the edge of the box is one of them.
    angles = np.append(np.linspace(0.0, box.angle, _ANGLES), abs(box.angle - error))
    place, offset, drive = (
        part.ravel()
        for part in np.meshgrid(range(len(angles)), range(len(gaps)), [-1.0, 1.0], indexing="ij")
    )
    outer = np.isin(place, [0, _ANGLES - 1]) & np.isin(offset, [0, _ANGLES - 1])
    angle, gap = angles[place.astype(np.intp)], gaps[offset.astype(np.intp)]
    x, y = np.zeros((2, len(angle), _STATES))
    x[:, ANGLE], y[:, ANGLE] = angle, np.clip(angle + gap, -box.angle, box.angle)
    # Friction makes a velocity act like a force: the two are extreme together.
    y[:, VELOCITY] = -drive * box.velocity
    slopes = []
    for rate in (-box.angular_rate, 0.0, box.angular_rate):
        y[:, ANGULAR_RATE] = rate
        slopes.append(jacobian(system, y, drive[:, None] * box.force)[0])
    behind, still, ahead = slopes
    # J is affine in (w, w^2): the proof takes the corners of the tangents to the parabola.
    tip = 0.25 * (ahead - behind)
    corners = np.concatenate([behind, ahead, still - tip, still + tip])
    lifted = np.zeros((len(corners), _SIZE, _SIZE))
    lifted[:, :_STATES, :_STATES] = corners
    lifted[:, :_STATES, _STATES:] = _FORCE * np.tile(control_matrix(system, x), (4, 1, 1))
    return lifted, np.tile(outer, 4)


def _residual(lifted: FloatArray, duals: FloatArray, design: HeldDesign) -> FloatArray:
    """Return the largest eigenvalue of (*) at samples (s,), with half of the margin, (s,)."""
    rate = 2.0 * design.rate + design.margin
    source = np.diag([1.0] * _STATES + [0.0]) / (2.0 * design.rate)
    worst = np.full(len(lifted), -math.inf)
    for dual, row in zip(duals, bernstein_rate(design.degree), strict=True):
        moved = sum(weight / design.period * duals[index] for index, weight in row.items())
        product = lifted @ dual
        left = product + np.swapaxes(product, -1, -2) + rate * dual + source - moved
        worst = np.maximum(worst, np.linalg.eigvalsh(left)[:, -1])
    return worst


def _solve(lifted: FloatArray, design: HeldDesign) -> tuple[FloatArray | None, str]:
    """Minimise t + lambda Z_0 over Q_0 ... Q_N and t for w_bar = 1; return them and the status."""
    import clarabel

    basis = symmetric_basis(_SIZE)
    size, count = len(basis), design.degree + 1
    columns = count * size + 1
    error_part = svec(basis[:, :_STATES, :_STATES]).T
    product = np.einsum("sab,jbc->sjac", lifted, basis)
    product = product + np.swapaxes(product, -1, -2) + 2.0 * (design.rate + design.margin) * basis
    motion = np.swapaxes(svec(product), -1, -2)
    source = np.diag([1.0] * _STATES + [0.0]) / (2.0 * design.rate)
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

    full = svec(basis).T
    for index, rate in enumerate(bernstein_rate(design.degree)):
        still = {place: -weight / design.period * full for place, weight in rate.items()}
        for one in motion:
            moving = one + still.get(index, 0.0)
            impose({**still, index: moving}, None, -svec(source))
        impose({index: -full}, None, -design.floor * svec(np.eye(_SIZE)))
        if index == design.degree or (design.aperiodic and index > 0):
            impose({0: -error_part, index: (1.0 + _SLACK) * error_part}, None, np.zeros(10))
        if design.output is None:
            impose({index: error_part}, -svec(np.eye(_STATES)), np.zeros(10))
        else:
            c = np.array(design.output)
            width = basis[:, :_STATES, :_STATES] @ c @ c
            impose({index: width[None]}, np.array([-1.0]), np.zeros(1))
    cost = np.zeros(columns)
    cost[:size] = design.control_penalty * _FORCE**2 * basis[:, -1, -1]
    cost[-1] = 1.0
    rows = sparse.csc_matrix(np.vstack(blocks))
    values, status = solve_conic(cost, rows, np.concatenate(rights), cones)
    if values is None:
        return None, status
    return np.einsum("kj,jab->kab", values[:-1].reshape(count, size), basis), status
