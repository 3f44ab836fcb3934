"""What the rows of a spacecraft observation mean: its named parts as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_envs.observation import NEIGHBOUR_DIM, OBSTACLE_DIM, Layout

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Sensed:
    """The observations o_l of some agents, by parts; B rows, k neighbours, m obstacles.

    Slots of what is not sensed are zero, and so is their mask.

    Attributes:
        goal: Goal relative to the agent, shape (B, 2) [m].
        velocity: Shape (B, 2) [m/s].
        heading: phi, shape (B,) [rad], in (-pi, pi].
        heading_change: phi since the start, shape (B,) [rad].
        spin: omega, shape (B,) [rad/s].
        time: t, shape (B,) [s].
        neighbours: Positions and velocities relative to the agent, shape (B, k, 4) [m, m/s].
        neighbour_mask: Which neighbours are sensed, shape (B, k).
        obstacles: Centres relative to the agent and radii, shape (B, m, 3) [m].
        obstacle_mask: Which obstacles are sensed, shape (B, m).
    """

    goal: FloatArray
    velocity: FloatArray
    heading: FloatArray
    heading_change: FloatArray
    spin: FloatArray
    time: FloatArray
    neighbours: FloatArray
    neighbour_mask: BoolArray
    obstacles: FloatArray
    obstacle_mask: BoolArray

    @classmethod
    def of(cls, layout: Layout, observation: NDArray[np.floating]) -> Sensed:
        """Take observations apart.

        Args:
            layout: Of the environment: `Layout.for_preset(preset, settings)`.
            observation: Shape (B, layout.size), or (layout.size,) for one row.

        Returns:
            The parts, in double precision.

        Raises:
            ValueError: The observation has another shape or is not finite.
        """
        rows = np.atleast_2d(np.asarray(observation, np.float64))
        if rows.ndim != 2 or rows.shape[1] != layout.size:
            raise ValueError(
                f"the observation has shape {np.shape(observation)}; with {layout.neighbours} "
                f"neighbours and {layout.obstacles} obstacles at most it has {layout.size} numbers:"
                " build the policy with the environment's preset and num_agents"
            )
        if not np.all(np.isfinite(rows)):
            raise ValueError("the observation is not finite")
        part = {name: rows[:, where] for name, where in layout.slices.items()}
        count = len(rows)
        cosine, sine, change = part["heading"].T
        return cls(
            part["goal"],
            part["velocity"],
            np.arctan2(sine, cosine),
            change,
            part["spin"][:, 0],
            part["time"][:, 0],
            part["neighbours"].reshape(count, -1, NEIGHBOUR_DIM),
            part["neighbour_mask"] > 0.0,
            part["obstacles"].reshape(count, -1, OBSTACLE_DIM),
            part["obstacle_mask"] > 0.0,
        )
