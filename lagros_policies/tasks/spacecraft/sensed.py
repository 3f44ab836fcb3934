"""What the rows of a spacecraft observation or global state mean: their named parts as arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.tasks.spacecraft.physics import HEADING, SPIN, VELOCITY_X
from lagros_envs.tasks.spacecraft.sensing import NEIGHBOUR_DIM, OBSTACLE_DIM, Layout
from lagros_envs.tasks.spacecraft.task import STATE_DIM
from lagros_policies.observed import as_numbers
from lagros_policies.tasks.spacecraft.setup import PLANE

# Up to so many slots it takes longer to find those in use than to look at all.
_FEW = 16


class Sensed(NamedTuple):
    """The observations o_l of some agents, by parts; B rows, k neighbours, m obstacles.

    Slots of what is not sensed are zero, and so is their mask. Where an observation has many, those
    after the last that anybody uses are left out, but one.

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
            ValueError: The observation has another shape, no rows, or is not finite.
        """
        rows = _rows(
            observation,
            layout.size,
            f"with {layout.neighbours} neighbours and {layout.obstacles} obstacles at most it has "
            f"{layout.size} numbers: build the policy with the environment's preset and num_agents",
        )
        at = layout.slices
        others, discs = (_used(rows, at[name]) for name in ("neighbour_mask", "obstacle_mask"))
        return cls(
            rows[:, : at["neighbours"].start].astype(np.float64),
            _bodies(rows, at["neighbours"], NEIGHBOUR_DIM, others),
            others,
            _bodies(rows, at["obstacles"], OBSTACLE_DIM, discs),
            discs,
        )


class WorldState(NamedTuple):
    """The global states `state()` of some worlds, by parts; B worlds, n agents, m obstacles.

    Attributes:
        time: t, shape (B,) [s].
        states: x of every agent, shape (B, n, 6).
        goals: Shape (B, n, 2) [m].
        obstacles: Centres and radii, shape (B, m, 3) [m]; zero in slots without an obstacle.
        obstacle_mask: Which slots have one, shape (B, m).
    """

    time: FloatArray
    states: FloatArray
    goals: FloatArray
    obstacles: FloatArray
    obstacle_mask: BoolArray

    @classmethod
    def of(cls, agents: int, obstacles: int, observation: NDArray[np.floating]) -> WorldState:
        """Take global states apart; `sensing.named_state_space` says how they are laid out.

        Args:
            agents: n, agents in a world.
            obstacles: m, slots for obstacles.
            observation: Shape (B, size), or (size,) for one world.

        Returns:
            The parts, in double precision.

        Raises:
            ValueError: The observation has another shape, no rows, is not finite, or is no global
                state.
        """
        ends = np.cumsum(
            [1, STATE_DIM * agents, 2 * agents, OBSTACLE_DIM * obstacles, obstacles]
        ).tolist()
        rows = _rows(
            observation,
            ends[-1],
            f"the state() of {agents} agents and up to {obstacles} obstacles has {ends[-1]} "
            "numbers: build the policy with the environment's preset and num_agents, and its "
            "filter too",
        )
        parts = np.split(rows.astype(np.float64), ends[:-1], axis=1)
        time, states, goals, discs, mask = parts
        if not np.isin(mask, (0.0, 1.0)).all():
            raise ValueError(
                f"the observation is not the state() of {agents} agents and up to {obstacles} "
                "obstacles: the obstacles' mask is neither 0 nor 1"
            )
        worlds = len(rows)
        return cls(
            time[:, 0],
            states.reshape(worlds, agents, STATE_DIM),
            goals.reshape(worlds, agents, 2),
            discs.reshape(worlds, obstacles, OBSTACLE_DIM),
            mask > 0.0,
        )

    def sensed(self, radius: float) -> Sensed:
        """Return what every agent senses, by rows of worlds and agents.

        The change of heading, which a global state does not tell, is zero.

        Args:
            radius: How far an agent senses [m].
        """
        states, moving = self.states, self.states[..., PLANE]
        worlds, n = states.shape[:2]
        others = np.array([[j for j in range(n) if j != i] for i in range(n)], np.intp)
        # One agent alone has one slot for neighbours, which stays empty.
        neighbours = np.zeros((worlds, n, max(1, n - 1), NEIGHBOUR_DIM))
        neighbours[:, :, : n - 1] = moving[:, others.reshape(n, n - 1)] - moving[:, :, None]
        seen = np.linalg.norm(neighbours[..., :2], axis=-1) <= radius
        seen &= n > 1
        rims = np.repeat(self.obstacles[:, None], n, axis=1)
        rims[..., :2] -= states[:, :, None, :2]
        near = np.linalg.norm(rims[..., :2], axis=-1) <= radius + rims[..., 2]
        near &= self.obstacle_mask[:, None]
        heading = states[..., HEADING]
        own = (
            self.goals - states[..., :2],
            states[..., VELOCITY_X : VELOCITY_X + 2],
            np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=-1),
            states[..., [SPIN]],
            np.repeat(self.time[:, None, None], n, axis=1),
        )
        return Sensed(
            np.concatenate(own, axis=-1).reshape(worlds * n, -1),
            neighbours.reshape(worlds * n, -1, NEIGHBOUR_DIM),
            seen.reshape(worlds * n, -1),
            rims.reshape(worlds * n, -1, OBSTACLE_DIM),
            near.reshape(worlds * n, -1),
        )


def _used(rows: NDArray[Any], mask: slice) -> BoolArray:
    """Return a mask, (B, slots), of many slots without those that come after the last in use."""
    present: BoolArray = rows[:, mask] > 0.0
    if present.shape[1] <= _FEW:
        return present
    used = np.flatnonzero(present.any(axis=0))
    return present[:, : used[-1] + 1 if used.size else 1]


def _bodies(rows: NDArray[Any], at: slice, numbers: int, mask: BoolArray) -> FloatArray:
    """Return the slots of a mask, each of so many numbers, shape (B, slots, numbers)."""
    slots = mask.shape[1]
    taken = rows[:, at.start : at.start + numbers * slots].astype(np.float64)
    return taken.reshape(len(rows), slots, numbers)


def _rows(observation: Any, size: int, wanted: str) -> NDArray[Any]:
    """Return observations as rows of their own precision; `wanted` says what they must be."""
    single = type(observation) is np.ndarray and observation.dtype == np.float32
    rows: NDArray[Any] = observation if single else as_numbers(observation, np.float64)
    if rows.ndim == 1:
        rows = rows[None]
    if rows.ndim != 2 or rows.shape[1] != size:
        raise ValueError(f"the observation has shape {np.shape(observation)}; {wanted}")
    if not len(rows):
        raise ValueError("the observation has no rows: no one is there to act")
    if not np.isfinite(rows).all():
        raise ValueError("the observation is not finite")
    return rows
