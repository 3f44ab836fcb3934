"""What a system says of itself beyond its equation, held against the equation: energy and mirror.

Two attributes that a system may have, and need not:

    energy(state, functions)   a function of the state, written like the equation of motion, that
                               u = d = 0 leaves as it is; with `dissipates = True` it may fall
    mirror                     signs of the states and of the controls, ((1, -1), (-1,)) for
                               instance: the mirror image of every motion is a motion

A wrong sign in an equation of motion shows in both, long before it shows in a flight.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import shown
from lagros_envs.dynamics.system import System, components, vector_field
from lagros_envs.numbers import dual, functions

# What rounding leaves of a sum that is zero, relative to its parts.
ROUNDING = 1e-9


class Balance(NamedTuple):
    """The rate of an energy, and how large the parts are of which it is the sum.

    Attributes:
        rate: dE/dt, shape (...).
        size: The sum of |dE/dx_i dx_i/dt|, shape (...), by which rounding is judged.
    """

    rate: FloatArray
    size: FloatArray


def energy_balance(system: Any, state: FloatArray) -> Balance:
    """Return dE/dt under u = d = 0, exactly, from the slopes of E and the equation of motion.

    Args:
        system: A system that has an `energy`.
        state: x, shape (..., n).

    Raises:
        ValueError: `energy` is no function of the state that gives one number.
    """
    shape, title = state.shape[:-1], type(system).__name__
    seeds = dual.seed(components(state))
    try:
        energy = system.energy(seeds, functions)
    except Exception as error:
        raise ValueError(
            f"{title}.energy fails: {type(error).__name__}: {error}. It is called as "
            "energy(state, functions) and written like the equation of motion"
        ) from error
    if not isinstance(energy, dual.Dual):
        raise ValueError(
            f"{title}.energy gives {shown(energy)}, which does not depend on the state: return a "
            "number made of it"
        )
    slope = dual.gradients([energy], system.state_dim, shape)[..., 0, :]
    parts = slope * vector_field(system, state, np.zeros((*shape, system.control_dim)))
    return Balance(parts.sum(axis=-1), np.abs(parts).sum(axis=-1))


def mirrored(system: Any, state: FloatArray, control: FloatArray) -> FloatArray:
    """Return how far the mirror image of a motion is from being one: f(S x, S_u u) - S f(x, u).

    Args:
        system: A system that has a `mirror`.
        state: x, shape (..., n).
        control: u, shape (..., m).

    Returns:
        Shape (..., n), in units of the state per second.

    Raises:
        ValueError: `mirror` is not signs of the states and of the controls.
    """
    signs = mirror_signs(system)
    there = vector_field(system, signs[0] * state, signs[1] * control)
    difference: FloatArray = there - signs[0] * vector_field(system, state, control)
    return difference


def mirror_signs(system: System) -> tuple[FloatArray, FloatArray]:
    """Return the signs of a system's `mirror`, shapes (n,) and (m,).

    Raises:
        ValueError: They are not 1 or -1, one for each state and for each control.
    """
    given = getattr(system, "mirror", None)
    sizes = system.state_dim, system.control_dim
    try:
        first, second = (np.array(part, np.float64) for part in given)  # type: ignore[union-attr]
        right = (first.shape, second.shape) == ((sizes[0],), (sizes[1],))
        right = right and bool(np.all(np.abs(first) == 1.0) and np.all(np.abs(second) == 1.0))
    except (TypeError, ValueError):
        right = False
    if not right:
        raise ValueError(
            f"{type(system).__name__}.mirror={shown(given)} must be two tuples of 1 and -1: "
            f"{sizes[0]} signs of the states and {sizes[1]} of the controls"
        )
    return first, second
