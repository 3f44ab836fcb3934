"""Which thrusters fire: the u >= 0 of least norm for a wrench, in closed form.

The eight thrusters are four opposing pairs, so that each pair is one signed thruster s and the
least u >= 0 fires one of the two: u = (max(s, 0), max(-s, 0)) with ||u|| = ||s||. The four signed
thrusters make the wrench w = G s with

    G = [[1, 1, 0, 0], [0, 0, 1, 1], [l, -l, b, -b]],  G G' = diag(2, 2, 2 l^2 + 2 b^2),

whose least s is G'(G G')^-1 w. Hence min ||u||^2 = (F_1^2 + F_2^2)/2 + tau^2 / (2 l^2 + 2 b^2):
force and torque do not compete, the heading does not matter, and zero torque costs least.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.physics import HEADING, SPIN, Spacecraft, check_spacecraft

# The pairs, as (positive, negative) thrusters of the signed ones; see `Spacecraft.wrench`.
_POSITIVE = (5, 4, 7, 6)
_NEGATIVE = (0, 1, 2, 3)


def allocate(body: Spacecraft, wrench: FloatArray) -> FloatArray:
    """Return the u >= 0 of least norm that makes a wrench.

    Args:
        body: The spacecraft.
        wrench: Forces along the body's two axes and torque, shape (..., 3) [N, N, N m].

    Returns:
        u, shape (..., 8) [N]; `body.wrench` of it is the wrench.
    """
    return np.maximum(wrench @ allocation_matrix(body), 0.0)


@lru_cache(maxsize=16)
def allocation_matrix(body: Spacecraft) -> FloatArray:
    """Return the matrix (3, 8) of the signed thrusters s = G'(G G')^-1 w, each with both signs."""
    check_spacecraft(body, "allocation_matrix")
    share = 2.0 * (body.arm**2 + body.side_arm**2)
    turn, side_turn = body.arm / share, body.side_arm / share
    signed = np.array(
        [
            [0.5, 0.5, 0.0, 0.0],
            [0.0, 0.0, 0.5, 0.5],
            [turn, -turn, side_turn, -side_turn],
        ]
    )
    matrix = np.zeros((3, 8))
    matrix[:, _POSITIVE] = signed
    matrix[:, _NEGATIVE] = -signed
    matrix.flags.writeable = False
    return matrix


def to_body(force: FloatArray, heading: FloatArray) -> FloatArray:
    """Turn forces (..., 2) from the world's axes into the body's at headings (...) [rad]."""
    sine, cosine = np.sin(heading), np.cos(heading)
    first = cosine * force[..., 0] - sine * force[..., 1]
    second = sine * force[..., 0] + cosine * force[..., 1]
    return np.stack([first, second], axis=-1)


def wrench_of_acceleration(
    body: Spacecraft, state: FloatArray, acceleration: FloatArray
) -> FloatArray:
    """Return the wrench that accelerates a body.

    Args:
        body: The spacecraft.
        state: x, shape (..., 6).
        acceleration: Of x, y and heading, shape (..., 3) [m/s^2, m/s^2, rad/s^2].

    Returns:
        The wrench in the body's axes, shape (..., 3) [N, N, N m].
    """
    check_spacecraft(body, "wrench_of_acceleration")
    force = to_body(body.mass * acceleration[..., :2], state[..., HEADING])
    torque = 2.0 * body.inertia * acceleration[..., 2:]
    return np.concatenate([force, torque], axis=-1)


def thrust_for_acceleration(
    body: Spacecraft, state: FloatArray, acceleration: FloatArray
) -> FloatArray:
    """Return the u >= 0 of least norm that gives an acceleration, shape (..., 8) [N].

    Args:
        body: The spacecraft.
        state: x, shape (..., 6).
        acceleration: Of x, y and heading, shape (..., 3) [m/s^2, m/s^2, rad/s^2].
    """
    return allocate(body, wrench_of_acceleration(body, state, acceleration))


def held_thrust(
    body: Spacecraft, state: FloatArray, acceleration: FloatArray, period: float
) -> FloatArray:
    """Return the u >= 0 of least norm that gives an acceleration over a hold, shape (..., 8) [N].

    The wrench is held in the body's axes, which turn: it is made for the heading in the middle of
    the hold.

    Args:
        body: The spacecraft.
        state: x at the beginning, shape (..., 6).
        acceleration: Of x, y and heading, shape (..., 3) [m/s^2, m/s^2, rad/s^2].
        period: The hold's [s].
    """
    middle = np.array(np.broadcast_to(state, (*acceleration.shape[:-1], 6)))
    turn = 0.125 * period * period * acceleration[..., 2]
    middle[..., HEADING] += 0.5 * period * middle[..., SPIN] + turn
    return thrust_for_acceleration(body, middle, acceleration)
