"""Two bodies among discs that the general planner is measured on: a car and a planar quadrotor.

The bodies are those of `lagros/Car-v0` and `lagros/Pvtol-v0`; the limits are those of C3M (Sun,
Jha & Fan 2021). The discs are drawn another way than in the tasks, as they were when the figures
were published.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagros_envs.tasks.car.task import CarSettings
from lagros_envs.tasks.pvtol.physics import Pvtol
from lagros_policies.planning import Discs, Problem

FloatArray = NDArray[np.float64]

BODY_RADIUS, MARGIN, DISC_RADIUS = 0.2, 0.15, 0.5
CAR = CarSettings()
GRAVITY = Pvtol().gravity  # [m/s^2]


def car_problem(rng: np.random.Generator, period: float = 0.1) -> Problem:
    """Return a random episode: 6 s across a field of discs, at 1 to 2 m/s."""
    start = np.array([0.0, rng.uniform(-2.0, 2.0), rng.uniform(-0.5, 0.5), 1.5])
    goal = np.array([9.0, rng.uniform(-2.0, 2.0), rng.uniform(-0.5, 0.5), 1.5])
    discs = _discs(rng, start[:2], goal[:2], (1.5, 7.5), (-2.5, 2.5))
    return Problem(
        CAR.system,
        period,
        round(6.0 / period),
        start,
        goal,
        state_low=np.array([-np.inf, -np.inf, -np.inf, 1.0]),
        state_high=np.array([np.inf, np.inf, np.inf, 2.0]),
        control_low=np.array([-3.0, -3.0]),
        control_high=np.array([3.0, 3.0]),
        discs=discs,
    )


def pvtol_problem(rng: np.random.Generator, period: float = 0.1) -> Problem:
    """Return a random episode: 6 s from hover to hover across a field of discs."""
    start, goal = np.zeros(6), np.zeros(6)
    start[1], goal[:2] = rng.uniform(-1.5, 1.5), (6.0, rng.uniform(-1.5, 1.5))
    discs = _discs(rng, start[:2], goal[:2], (1.2, 4.8), (-1.5, 1.5))
    body = Pvtol()
    tilt, largest = np.pi / 3.0, 2.0 * body.hover
    high = np.array([np.inf, np.inf, tilt, 2.0, 1.0, tilt])
    return Problem(
        body,
        period,
        round(6.0 / period),
        start,
        goal,
        state_low=-high,
        state_high=high,
        control_low=np.zeros(2),
        control_high=np.full(2, largest),
        reference_control=np.full(2, body.hover),
        state_scale=np.array([1.0, 1.0, 0.3, 1.0, 1.0, 0.5]),
        control_scale=np.full(2, 0.1),
        discs=discs,
    )


def _discs(
    rng: np.random.Generator,
    start: FloatArray,
    goal: FloatArray,
    across: tuple[float, float],
    aside: tuple[float, float],
) -> Discs:
    """Return three to five discs, all passages open, drawn again until they fit."""
    keep = DISC_RADIUS + BODY_RADIUS + MARGIN
    ends = np.stack([start, goal])
    while True:
        count = int(rng.integers(3, 6))
        centres = np.stack([rng.uniform(*across, count), rng.uniform(*aside, count)], axis=-1)
        apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + 1e9 * np.eye(count)
        gaps = np.linalg.norm(centres[:, None] - ends, axis=-1)
        if np.all(apart >= 2.0 * keep) and np.all(gaps >= keep + 0.1):
            return Discs(centres, np.array(DISC_RADIUS), BODY_RADIUS, np.array(MARGIN))
