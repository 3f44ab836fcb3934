"""What the rows of a spacecraft observation mean: its named parts as arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.observation import NEIGHBOUR_DIM, OBSTACLE_DIM, Layout

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class Sensed(NamedTuple):
    """The observations o_l of some agents, by parts; B rows, k neighbours, m obstacles.

    Slots of what is not sensed are zero, and so is their mask. The parts are views: policies that
    decide within microseconds take only those that they need.

    Attributes:
        own: What an agent knows of itself, shape (B, 9); its columns have names below.
        neighbours: Positions and velocities relative to the agent, shape (B, k, 4) [m, m/s].
        neighbour_mask: Which neighbours are sensed, shape (B, k).
        obstacles: Centres relative to the agent and radii, shape (B, m, 3) [m].
        obstacle_mask: Which obstacles are sensed, shape (B, m).
    """

    own: FloatArray
    neighbours: FloatArray
    neighbour_mask: BoolArray
    obstacles: FloatArray
    obstacle_mask: BoolArray

    @property
    def goal(self) -> FloatArray:
        """Goal relative to the agent, shape (B, 2) [m]."""
        return self.own[:, 0:2]

    @property
    def velocity(self) -> FloatArray:
        """Velocity, shape (B, 2) [m/s]."""
        return self.own[:, 2:4]

    @property
    def facing(self) -> FloatArray:
        """Heading as (cos phi, sin phi), shape (B, 2)."""
        return self.own[:, 4:6]

    @property
    def heading(self) -> FloatArray:
        """Heading phi in (-pi, pi], shape (B,) [rad]."""
        heading: FloatArray = np.arctan2(self.own[:, 5], self.own[:, 4])
        return heading

    @property
    def heading_change(self) -> FloatArray:
        """Turn of the heading since the start, shape (B,) [rad]."""
        return self.own[:, 6]

    @property
    def spin(self) -> FloatArray:
        """Turning rate omega, shape (B,) [rad/s]."""
        return self.own[:, 7]

    @property
    def time(self) -> FloatArray:
        """Time t since the start, shape (B,) [s]."""
        return self.own[:, 8]

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
        rows = np.asarray(observation, np.float64)
        if rows.ndim == 1:
            rows = rows[None]
        if rows.ndim != 2 or rows.shape[1] != layout.size:
            raise ValueError(
                f"the observation has shape {np.shape(observation)}; with {layout.neighbours} "
                f"neighbours and {layout.obstacles} obstacles at most it has {layout.size} numbers:"
                " build the policy with the environment's preset and num_agents"
            )
        if not np.isfinite(rows).all():
            raise ValueError("the observation is not finite")
        at, count = layout.slices, len(rows)
        return cls(
            rows[:, : at["neighbours"].start],
            rows[:, at["neighbours"]].reshape(count, -1, NEIGHBOUR_DIM),
            rows[:, at["neighbour_mask"]] > 0.0,
            rows[:, at["obstacles"]].reshape(count, -1, OBSTACLE_DIM),
            rows[:, at["obstacle_mask"]] > 0.0,
        )
