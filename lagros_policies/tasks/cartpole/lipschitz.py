"""A proved bound of the cart-pole's Lipschitz constant (Lemma 1)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lagros_envs.checks import check_at_least
from lagros_envs.dynamics import System
from lagros_envs.numbers import Dual, Interval, Series, functions, variable
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE, POSITION, VELOCITY
from lagros_policies.tasks.cartpole.box import ProofBox
from lagros_policies.tasks.cartpole.systems import check_cartpole

# A rate whose square is a power of two [rad/s].
_FAST = 1024.0
# Rounding of the norm of a 4 by 4 matrix, relative to its Frobenius norm.
_ROUNDING = 1e-12


class Lipschitz(NamedTuple):
    """A proved Lipschitz constant of x -> f(x) + B(x) u_d, for u_d that does not answer to x.

    Attributes:
        upper: L_f, proved: ||d(f + B u_d)/dx|| is nowhere larger [1/s].
        lower: The largest norm that was found at a point [1/s].
        growth: Proved bound of the largest eigenvalue of the symmetric part, which also bounds the
            growth of an error, and is smaller [1/s].
    """

    upper: float
    lower: float
    growth: float


def lipschitz_constant(system: System, box: ProofBox, cells: int = 2000) -> Lipschitz:
    """Bound the Lipschitz constant L_f of Lemma 1 on a box, soundly.

    By Lagrange the accelerations are affine in the push f = u_d - mu_c dp/dt and quadratic in the
    pole's rate w, a = a_0 + f a_f + w a_w + w^2 a_q with functions of the angle. So is the
    Jacobian, and a norm is convex: the corners of f, w and w^2 decide, and intervals cover the
    angle between.

    Args:
        system: The cart-pole.
        box: Where x, x_d and u_d lie; its errors do not matter.
        cells: Equal intervals of the angle.

    Raises:
        TypeError: The system is no cart-pole.
        ValueError: The box has a lean.
    """
    body = check_cartpole(system, "lipschitz_constant")
    check_at_least("cells", cells, 1)
    if box.lean:
        raise ValueError(f"lean={box.lean!r} must be 0: state the force of the box instead")
    cuts = np.linspace(-box.angle, box.angle, cells + 1)
    angle = variable(Interval(cuts[:-1], cuts[1:]), 1)

    def at(push: Any, rate: Any) -> list[Any]:
        rates = body.derivative([0.0, angle, 0.0, rate], [push], functions)
        return [rates[VELOCITY], rates[ANGULAR_RATE]]

    zero = angle * 0.0
    seed = Dual(zero, zero + 1.0)
    by_push = [one.gradient for one in at(seed, zero)]
    by_rate = [one.gradient for one in at(zero, seed)]
    still, ahead, behind = at(0.0, 0.0), at(0.0, _FAST), at(0.0, -_FAST)
    # The square is so large that the rest hardly widens a_q.
    by_square = [
        ((one - rest) + (other - rest)) * (0.5 / _FAST**2)
        for one, other, rest in zip(ahead, behind, still, strict=True)
    ]
    parts = [
        _placed(cells, still, by_rate, [one * -body.cart_friction for one in by_push], True),
        _placed(cells, by_push),
        _placed(cells, by_rate, [one * 2.0 for one in by_square]),
        _placed(cells, by_square),
    ]
    push, rate = box.push(body), box.angular_rate
    high = math.nextafter(rate * rate, math.inf)
    upper = lower = growth = 0.0
    for force, speed, square in itertools.product((-push, push), (-rate, rate), (0.0, high)):
        # Wider by a unit in the last place: the digits that were published.
        slope = parts[0] + parts[1] * force + 0.0
        slope = slope + parts[2] * speed + parts[3] * square
        size = np.linalg.norm(slope.midpoint, ord=2, axis=(-1, -2))
        slack = np.linalg.norm(slope.radius, axis=(-1, -2))
        slack = slack + _ROUNDING * np.linalg.norm(slope.midpoint, axis=(-1, -2))
        upper = max(upper, float((size + slack).max()))
        if square == high or rate == 0.0:
            lower = max(lower, float((size - slack).max()))
        symmetric = 0.5 * (slope.midpoint + np.swapaxes(slope.midpoint, -1, -2))
        growth = max(growth, float((np.linalg.eigvalsh(symmetric)[:, -1] + slack).max()))
    return Lipschitz(upper, lower, growth)


def _placed(
    cells: int,
    moved: Sequence[Series],
    by_rate: Sequence[Series] | None = None,
    by_velocity: Sequence[Series] | None = None,
    kinematic: bool = False,
) -> Interval:
    """Return slopes (k, 4, 4) of the accelerations: what the angle moves, and other columns."""
    low, high = np.zeros((2, cells, 4, 4))
    columns = {
        ANGLE: [one.differentiated().parts[0] for one in moved],
        VELOCITY: [one.parts[0] for one in by_velocity or ()],
        ANGULAR_RATE: [one.parts[0] for one in by_rate or ()],
    }
    for column, entries in columns.items():
        for row, entry in enumerate(entries):
            low[:, VELOCITY + row, column] = entry.lower
            high[:, VELOCITY + row, column] = entry.upper
    for end in (low, high) if kinematic else ():
        end[:, POSITION, VELOCITY] = end[:, ANGLE, ANGULAR_RATE] = 1.0
    return Interval(low, high) * 1.0
