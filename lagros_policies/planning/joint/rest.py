"""Where agents rest that would come too near to something at their goals."""

from __future__ import annotations

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.planning.vectors import unit_vectors

_ROUNDS = 200
# What is pushed apart is pushed this much further, so that pushes come to an end [m].
_BEYOND = 1e-3


def resting_places(
    goals: FloatArray, obstacles: FloatArray, distance: FloatArray, pair_distance: float
) -> FloatArray:
    """Return places near the goals that keep distances to obstacles and to each other.

    Whatever lacks room is pushed away from what it is near to, turn by turn; where that comes to no
    end what is left lacks some.

    Args:
        goals: Shape (n, 2) [m].
        obstacles: Centres, shape (m, 2) [m].
        distance: To keep from each, shape (m,) [m].
        pair_distance: To keep between agents [m].

    Returns:
        Shape (n, 2) [m]; the goals themselves where they have room.
    """
    places = np.array(goals, dtype=np.float64)
    first, second = np.triu_indices(len(places), 1)
    for _ in range(_ROUNDS):
        delta = places[:, None] - obstacles
        gap = np.linalg.norm(delta, axis=-1)
        agent, disc = np.nonzero(gap < distance)
        between = places[first] - places[second]
        apart = np.linalg.norm(between, axis=-1)
        pair = np.flatnonzero(apart < pair_distance)
        if not (agent.size or pair.size):
            break
        short = distance[disc] - gap[agent, disc] + _BEYOND
        away = short[:, None] * unit_vectors(delta[agent, disc], gap[agent, disc])
        np.add.at(places, agent, away)
        short = 0.5 * (pair_distance - apart[pair] + _BEYOND)
        away = short[:, None] * unit_vectors(between[pair], apart[pair])
        np.add.at(places, first[pair], away)
        np.add.at(places, second[pair], -away)
    return places
