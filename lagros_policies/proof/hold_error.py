"""The error after a hold: linear in error and disturbance, and a remainder by Taylor models.

With e = x - x_d, u = u_d + v + K (e - c) + w and the environment's own Runge-Kutta step Phi,

    e' = Phi(x_d + e, u, d) - x_d'  in  c' + A (e - c) + E d + N w + U [-b, b].

Phi runs on Taylor models over an ellipsoid around the set of errors, so that A and E are its slopes
at the middle of the set and the polynomials hold all that is quadratic and cubic; these are bounded
over the same ellipsoid, and what they have of a middle and of a line goes to c' and A. Floats round
everywhere: what they may lose is bounded beforehand and added to b.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.dynamics import System
from lagros_envs.dynamics.integrate import rk4_hold
from lagros_envs.numbers import functions
from lagros_envs.numbers.taylor import Monomials, TaylorModel, monomials
from lagros_policies.proof.error_set import ROUNDING, WIDER, ErrorSet
from lagros_policies.proof.remainder import (
    cubic_forms,
    cubic_lines,
    narrower_lines,
    narrower_range,
    quadratic_forms,
    quadratic_range,
)
from lagros_policies.proof.steering import Steering

# A coordinate whose error is smaller is given so much: the ellipsoid needs some width.
_THIN = 1e-9
# How much wider the ellipsoid is than what floats make of it.
_ROOM = 1e-8
# Directions of the remainder, the largest, whose quadratic forms are looked at more closely.
_CLOSER = 2
# An error beyond this is not followed: its square would soon be no number.
_LOST = 1e30


@dataclass(frozen=True)
class HoldOfErrors:
    """The held step of a system, as errors see it.

    Attributes:
        system: The system.
        period: Hold [s].
        bound: d_bar, in units of the state per second.
        channels: Which coordinates d moves, shape (n,).
        curved: Which of states and controls Phi is not affine in, shape (n + m,). A wrong one costs
            width, never soundness: what is not kept in a polynomial is in its rest.
    """

    system: System
    period: float
    bound: float
    channels: BoolArray
    curved: BoolArray

    @property
    def monomials(self) -> Monomials:
        """Of the curved coordinates, the others and d."""
        curved = int(self.curved.sum())
        return monomials(curved, self.curved.size - curved, int(self.channels.sum()))

    @property
    def drift(self) -> FloatArray:
        """How d moves the state within half a hold, at most and by itself, shape (n, channels)."""
        drift: FloatArray = 0.5 * self.period * self.bound * np.eye(len(self.channels))
        return drift[:, self.channels]

    def following(
        self,
        errors: ErrorSet,
        steering: Steering,
        state: FloatArray,
        control: FloatArray,
        following: FloatArray,
    ) -> tuple[ErrorSet, BoolArray]:
        """Return where the errors are after a hold.

        Args:
            errors: Where e lies, of p plans.
            steering: What the control is there.
            state: x_d, shape (p, n).
            control: u_d, shape (p, m).
            following: x_d at the end of the hold, shape (p, n).

        Returns:
            The errors, and for which plans they are known, shape (p,); the others are at zero.
        """
        domain = _Domain.around(errors, steering, self.drift, self.curved)
        place = np.concatenate([state + errors.centre, control + steering.offset], axis=1)
        kept = self.monomials
        ended = self._ended(domain, place)
        parts = np.moveaxis(np.stack([one.parts for one in ended]), -1, 0)
        rest = np.stack([one.rest for one in ended], axis=-1)
        known = domain.known & np.isfinite(parts).all(axis=(1, 2)) & np.isfinite(rest).all(axis=1)
        parts = np.where(known[:, None, None], parts, 0.0)
        rest = np.where(known[:, None], rest, 0.0)
        basis, middle, lines, radius = _remainder(
            kept, parts, domain.blocks(errors, steering, self.drift)
        )
        by_curved = parts[:, :, kept.first[0]] + basis @ lines
        matrix, lost = domain.slopes(by_curved, parts[:, :, kept.first[1]])
        slope = matrix @ domain.rows
        lost = lost + rest + errors.rounded(slope)
        lost += ROUNDING * _times(np.abs(matrix), _times(np.abs(domain.rows), errors.spread))
        lost += ROUNDING * _times(np.abs(basis), np.abs(lines).sum(axis=-1) + np.abs(middle))
        lost += ROUNDING * (np.abs(parts[:, :, 0]) + np.abs(following))
        centre = parts[:, :, 0] - following + _times(basis, middle)
        pushes = parts[:, :, kept.first[2]] + matrix[:, :, : len(self.drift)] @ self.drift
        lost += ROUNDING * (np.abs(matrix[:, :, : len(self.drift)]) @ self.drift).sum(axis=-1)
        radius = (radius + _times(_transposed(np.abs(basis)), lost)) * WIDER
        # The directions of the remainder are orthogonal but for rounding.
        radius += _ROOM * lost.sum(axis=-1, keepdims=True)
        n = state.shape[1]
        segments = [basis * radius[:, None], matrix[:, :, n:] * steering.radius[:, None]]
        result = errors.moved(slope, centre, pushes, np.concatenate(segments, axis=2) * WIDER)
        known &= np.all(result.spread + np.abs(centre) < _LOST, axis=1)
        return (result if known.all() else result.emptied(~known)), known

    def _ended(self, domain: _Domain, place: FloatArray) -> list[TaylorModel]:
        """Return Phi as Taylor models: in y, the other coordinates and d."""
        kept, plans = self.monomials, len(place)
        curved, lone, pushed = kept.first
        numbers = []
        for index, bent in enumerate(self.curved.tolist()):
            parts = np.zeros((kept.count, plans))
            parts[0] = place[:, index]
            before = int(self.curved[:index].sum())
            if bent:
                parts[curved] = domain.scale[:, before].T
            else:
                parts[lone.start + index - before] = domain.width[:, index]
            # What rounded the place, and nothing else: the rows of `scale` are as they are.
            numbers.append(TaylorModel(kept, parts, ROUNDING * np.abs(place[:, index])))
        # The state half-way is what varies: from there d moves it half as far as from the start.
        pushes: list[TaylorModel | float] = []
        for index, moved in enumerate(self.channels.tolist()):
            parts = np.zeros((kept.count, plans))
            if moved:
                parts[pushed.start + int(self.channels[:index].sum())] = self.bound
            push = TaylorModel(kept, parts, np.zeros(plans)) if moved else 0.0
            pushes.append(push)
            numbers[index] = numbers[index] - push * (0.5 * self.period)
        n = self.system.state_dim
        found = rk4_hold(self.system, numbers[:n], numbers[n:], pushes, self.period, functions)
        # A rate may be a plain number, but then x is not.
        return list(found)


@dataclass(frozen=True)
class _Domain:
    """The ellipsoid that Taylor models are made over: z = B y, ||y|| <= 1, z of curved rows.

    Attributes:
        rows: From e - c to states and controls, shape (p, n + m, n); controls have noise besides.
        width: Bounds of these, shape (p, n + m).
        scale: B, shape (p, r, r).
        known: Where there is an ellipsoid, shape (p,); elsewhere B is the identity.
        curved: As in `HoldOfErrors`.
    """

    rows: FloatArray
    width: FloatArray
    scale: FloatArray
    known: BoolArray
    curved: BoolArray

    @classmethod
    def around(
        cls, errors: ErrorSet, steering: Steering, drift: FloatArray, curved: BoolArray
    ) -> _Domain:
        """Enclose states half-way and controls of a set of errors."""
        plans, n = errors.centre.shape
        m = steering.gain.shape[1]
        rows = np.concatenate(
            [np.broadcast_to(np.eye(n), (plans, n, n)), steering.gain.reshape(plans, m, n)], axis=1
        )
        noise = np.zeros((plans, n + m, m))
        noise[:, n + np.arange(m), np.arange(m)] = steering.radius
        moved = np.zeros((n + m, drift.shape[1]))
        moved[:n] = drift
        reach = errors.support(rows) + noise.sum(axis=-1) + np.abs(moved).sum(axis=-1)
        width = np.maximum(reach * WIDER, _THIN)
        unit = 1.0 / width[:, curved, None]
        some = rows[:, curved] * unit
        segments = np.concatenate([some @ errors.segments, noise[:, curved] * unit], axis=2)
        flat = some @ errors.balls.reshape(plans, n, -1)
        balls = flat.reshape(plans, some.shape[1], *errors.balls.shape[2:])
        balls = np.concatenate([balls, (moved[curved] * unit)[:, :, None]], axis=2)
        shape = ErrorSet.ellipsoid(balls, segments)
        # Rounding of the generators, as a share of the width: where gains cancel it counts.
        share = ROUNDING * _times(np.abs(some), errors.spread).max(axis=1)
        room = _ROOM + share * share / _ROOM
        shape = shape * (1.0 + _ROOM) + room[:, None, None] * np.eye(shape.shape[1])
        known = np.asarray(np.isfinite(shape).all(axis=(1, 2)))
        scale = width[:, curved, None] * np.linalg.cholesky(
            np.where(known[:, None, None], shape, np.eye(shape.shape[1]))
        )
        scale = np.where(known[:, None, None], scale, np.eye(shape.shape[1]))
        return cls(rows, width, scale, known, curved)

    def blocks(self, errors: ErrorSet, steering: Steering, drift: FloatArray) -> FloatArray:
        """Return G_j G_j' of the balls and segments whose sum y lies in, shape (p, j, r, r)."""
        plans, n = errors.centre.shape
        noise = np.zeros((plans, self.rows.shape[1], steering.gain.shape[1]))
        noise[:, n:] = steering.radius[:, :, None] * np.eye(steering.gain.shape[1])
        moved = np.zeros((plans, self.rows.shape[1], drift.shape[1]))
        moved[:, :n] = drift
        columns = np.concatenate([moved, self.rows @ errors.generators, noise], axis=2)
        columns = np.where(self.known[:, None, None], columns[:, self.curved], 0.0)
        columns = np.linalg.solve(self.scale, columns)
        count, width = errors.balls.shape[2] + 1, errors.balls.shape[3]
        balls = columns[:, :, : count * width].reshape(plans, columns.shape[1], count, width)
        balls = np.moveaxis(balls, 2, 1)
        thin = np.moveaxis(columns[:, :, count * width :], 2, 1)[..., None]
        return np.concatenate([balls @ _transposed(balls), thin @ _transposed(thin)], axis=1)

    def slopes(self, by_curved: FloatArray, by_lone: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slopes by states and controls, from those by y and by the other coordinates.

        Args:
            by_curved: L, by y, shape (p, n, r).
            by_lone: By the others in units of their width, shape (p, n, s).

        Returns:
            Shape (p, n, n + m), and what floats lose of L y, shape (p, n).
        """
        found: FloatArray = _transposed(
            np.linalg.solve(_transposed(self.scale), _transposed(by_curved))
        )
        defect = np.abs(by_curved - found @ self.scale)
        defect += ROUNDING * (np.abs(by_curved) + np.abs(found) @ np.abs(self.scale))
        matrix = np.zeros((*by_curved.shape[:2], self.rows.shape[1]))
        matrix[:, :, self.curved] = found
        matrix[:, :, ~self.curved] = by_lone / self.width[:, None, ~self.curved]
        lost = np.sqrt((defect * defect).sum(axis=-1)) + ROUNDING * np.abs(by_lone).sum(axis=-1)
        return matrix, lost * WIDER


def _remainder(
    kept: Monomials, parts: FloatArray, blocks: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Enclose what is quadratic and cubic in polynomials (p, n, count).

    Returns:
        U (p, n, n), c (p, n), A (p, n, r) and b (p, n): it lies within U (c + A y + [-b, b]).
    """
    places = [kept.of_degree(2), kept.of_degree(3), kept.mixed]
    bent = np.concatenate([parts[:, :, place] for place in places], axis=2)
    _, basis = np.linalg.eigh(bent @ _transposed(bent))
    turned = _transposed(basis) @ parts
    forms = quadratic_forms(turned[:, :, places[0]], kept.members[places[0]], kept.variables)
    middle, radius = quadratic_range(forms)
    most = slice(-_CLOSER, None)
    middle[:, most], radius[:, most] = narrower_range(
        forms[:, most], middle[:, most], radius[:, most], blocks
    )
    forms = cubic_forms(turned[:, :, places[1]], kept.members[places[1]], kept.variables)
    lines, left = cubic_lines(forms)
    lines[:, most], left[:, most] = narrower_lines(
        forms[:, most], lines[:, most], left[:, most], blocks
    )
    mixed = np.sqrt((turned[:, :, places[2]] ** 2).sum(axis=-1))
    size = np.abs(bent).sum(axis=(1, 2))[:, None]
    return basis, middle, lines, (radius + left + mixed + 1e-13 * size) * WIDER


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    product: FloatArray = (matrix @ vector[..., None])[..., 0]
    return product


def _transposed(matrix: NDArray[Any]) -> FloatArray:
    turned: FloatArray = np.swapaxes(matrix, -1, -2)
    return turned
