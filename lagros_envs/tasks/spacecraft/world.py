"""Many worlds of many spacecraft side by side: one array operation per step for all of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray, IntArray
from lagros_envs.disturbances import Disturbance, Situation
from lagros_envs.dynamics.held import HeldBatch
from lagros_envs.sweep import Path, swept_agents, swept_obstacles
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.loops import touched
from lagros_envs.tasks.spacecraft.nearby import Near, Nearby
from lagros_envs.tasks.spacecraft.scenarios import Scenario

# With 2 substeps of 0.05 s, halving the substep moves no state of a 45 s episode by 1e-4 while
# the body turns slower than 5 rad/s.
SUBSTEPS = 2


class Outcome(NamedTuple):
    """What one step brought each agent; every array has shape (worlds, agents).

    Attributes:
        reward: See `task.reward`.
        terminated: Whether every agent of the world has collided.
        truncated: Whether the time limit is reached.
    """

    reward: FloatArray
    terminated: BoolArray
    truncated: BoolArray


class SpacecraftWorld:
    """Worlds with the same number of agents each, moved together.

    Agents float freely and pass through what they hit: a collision is counted, for good, and
    whoever collided stays an obstacle to the others. A world ends at the time limit, or as soon as
    all its agents have collided.

    Arrays are stored with the coordinate first, (6, worlds, agents), which is what the equation of
    motion works on.

    Args:
        worlds: Number of worlds.
        agents: Agents in each world.
        obstacles: Most obstacles that a world can hold.
        disturbance: The disturbance; every agent has its own realisation.
        settings: The task.
        compiled: Whether numba compiles the equation of motion, see `dynamics.held.HeldBatch`.

    Attributes:
        compiled: Whether it is compiled.
        step_limit: Control steps after which an episode is truncated.
    """

    def __init__(
        self,
        worlds: int,
        agents: int,
        obstacles: int,
        disturbance: Disturbance,
        settings: task.SpacecraftSettings,
        compiled: bool | None = False,
    ) -> None:
        """Allocate the worlds; `begin` starts them."""
        self.worlds, self.agents, self.obstacles = worlds, agents, obstacles
        self.disturbance, self.settings = disturbance, settings
        self.step_limit = settings.steps
        shape = (worlds, agents)
        self._substep = substep = settings.control_period / SUBSTEPS
        pushed = disturbance.kind != "none"
        self._hold = HeldBatch(
            settings.system.by_wrench, substep, shape, compiled, 1, pushed=pushed
        )
        self.compiled = self._hold.compiled
        self.parts = np.zeros((task.STATE_DIM, *shape))
        self.goals = np.zeros((2, *shape))
        self.start_headings = np.zeros(shape)
        self.obstacle_centres = np.zeros((2, worlds, obstacles))
        # An absent obstacle has the radius -inf, so that nothing touches or senses it.
        self.obstacle_radii = np.full((worlds, obstacles), -np.inf)
        self.agent_radius = np.zeros(worlds)
        self.core_radius = np.zeros(worlds)
        # Found where it is asked for first, after worlds have begun.
        self._nearby: Nearby | None = None
        self._near: Near | None = None
        self.scenarios: list[Scenario | None] = [None] * worlds
        self.nominal: FloatArray | None = None
        self.step_count = np.zeros(worlds, dtype=np.intp)
        self.forces = np.zeros((task.THRUSTERS, *shape))
        self.effort = np.zeros(shape)
        self.effort_to_success = np.zeros(shape)
        self.success_time = np.full(shape, np.inf)
        self.paper_success_time = np.full(shape, np.inf)
        self.collision_time = np.full(shape, np.inf)
        self.reached = np.zeros(shape, bool)
        self.push = np.zeros((task.STATE_DIM, *shape))
        self._pushes = np.zeros((worlds, settings.steps, task.STATE_DIM, agents))
        self._everywhere = np.arange(worlds)

    # Where everything is.

    @property
    def states(self) -> FloatArray:
        """The states x, shape (worlds, agents, 6)."""
        return self.parts.transpose(1, 2, 0).copy()

    @property
    def time(self) -> FloatArray:
        """The time t of each world, shape (worlds,) [s]."""
        return cast(FloatArray, self.step_count * self.settings.control_period)

    @property
    def collided(self) -> BoolArray:
        """Which agents have collided so far, shape (worlds, agents)."""
        return cast(BoolArray, np.isfinite(self.collision_time))

    @property
    def goal_distance(self) -> FloatArray:
        """||p - p_f||, shape (worlds, agents) [m]."""
        return _length(*(self.parts[:2] - self.goals))

    # An episode.

    def begin(
        self,
        worlds: IntArray,
        scenarios: Sequence[Scenario],
        generators: Iterable[np.random.Generator],
    ) -> None:
        """Start an episode in some worlds.

        Args:
            worlds: Which worlds.
            scenarios: One for each.
            generators: The disturbance stream of each episode; not looked at where there is no
                disturbance. Every agent has a stream of its own,
                so that an agent meets the same disturbance among any number of others.

        Raises:
            ValueError: A scenario has another number of agents, or too many obstacles.
        """
        for scenario in scenarios:
            self.check(scenario)
        self._place(worlds, scenarios)
        for world, scenario in zip(worlds, scenarios, strict=True):
            self.scenarios[world] = scenario
        settings = self.settings
        if self.disturbance.kind != "none":
            for world, generator in zip(worlds, generators, strict=True):
                for agent, stream in enumerate(generator.spawn(self.agents)):
                    self._pushes[world, :, :, agent] = self.disturbance.realise(
                        stream, settings.steps, settings.control_period
                    )
        self.parts[3:, worlds] = 0.0
        self.start_headings[worlds] = self.parts[2, worlds]
        self.forces[:, worlds] = 0.0
        self.push[:, worlds] = 0.0
        self.step_count[worlds] = 0
        for array in (self.effort, self.effort_to_success):
            array[worlds] = 0.0
        for array in (self.success_time, self.paper_success_time, self.collision_time):
            array[worlds] = np.inf
        self.reached[worlds] = False
        chosen = np.zeros(self.worlds, bool)
        chosen[worlds] = True
        self._note_arrivals(self.goal_distance, chosen[:, None])

    def step(self, forces: FloatArray) -> Outcome:
        """Hold every agent's forces for one control step.

        Args:
            forces: u >= 0, shape (worlds, agents, 8) [N].
        """
        settings = self.settings
        before = self.goal_distance
        control = forces.transpose(2, 0, 1).copy()
        self.push = self._current_push()
        path, integrated = self._advance(control)
        effort = np.einsum("uwa,uwa->wa", control, control) * settings.control_period
        self.forces = control
        self.effort += effort
        self.step_count = self.step_count + 1
        hit = self._touched(path, self._look(float(path.reach.max()))) | ~integrated
        first_collision = hit & ~self.collided
        # The end of the step at the latest.
        self.collision_time = np.where(first_collision, self.time[:, None], self.collision_time)
        after = self.goal_distance
        first_success = self._note_arrivals(after)
        rewards = task.reward(settings, effort, before - after, first_success, first_collision)
        over = np.all(self.collided, axis=1)
        late = self.step_count >= self.step_limit
        return Outcome(
            rewards,
            np.repeat(over[:, None], self.agents, axis=1),
            np.repeat(late[:, None], self.agents, axis=1),
        )

    @property
    def near(self) -> Near:
        """What may be sensed: who is near whom, and near which obstacle."""
        near = self._near
        if near is None or not (near.points == self.parts[:2]).all():
            near = self._look(0.0)
        return near

    def info(self) -> dict[str, Any]:
        """Return the measures of every agent, each of shape (worlds, agents) or with axes behind.

        `SpacecraftParallelEnv` says what they mean.
        """
        distance = self.goal_distance
        collided = self.collided
        radius = self.settings.tube.radius(self.time)
        info = {
            "success": np.isfinite(self.success_time),
            "is_success": np.isfinite(self.success_time),
            "success_time": self.success_time.copy(),
            "strict_success": (distance <= self.settings.goal_radius) & ~collided,
            "reached": self.reached.copy(),
            "paper_success": np.isfinite(self.paper_success_time),
            "paper_success_time": self.paper_success_time.copy(),
            "collided": collided,
            "collision_time": self.collision_time.copy(),
            "effort": self.effort.copy(),
            "effort_to_success": self.effort_to_success.copy(),
            "disturbance": self.push.transpose(1, 2, 0).copy(),
            "tube_radius": np.repeat(radius[:, None], self.agents, axis=1),
            "goal_distance": distance,
        }
        nominal = self.nominal_now()
        if nominal is not None:
            info["tracking_error"] = np.linalg.norm(self.states - nominal, axis=-1)
        return info

    def nominal_now(self) -> FloatArray | None:
        """Return x_d of every agent at this time, shape (worlds, agents, 6), or None."""
        if self.nominal is None:
            return None
        index = np.minimum(self.step_count, self.settings.steps)
        return self.nominal[self._everywhere, index]

    def check(self, scenario: Scenario) -> None:
        """Check that a scenario fits into these worlds.

        Raises:
            ValueError: It has another number of agents, or too many obstacles.
        """
        if scenario.num_agents != self.agents:
            raise ValueError(
                f"the scenario has {scenario.num_agents} agents; this environment was built with "
                f"num_agents={self.agents}"
            )
        if len(scenario.obstacles) > self.obstacles:
            raise ValueError(
                f"the scenario has {len(scenario.obstacles)} obstacles; this environment holds at "
                f"most {self.obstacles}: build it with preset=dataclasses.replace(PRESETS[...], "
                f"obstacle_count=(0, {len(scenario.obstacles)}))"
            )

    def _place(self, worlds: IntArray, scenarios: Sequence[Scenario]) -> None:
        """Write agents, goals and obstacles of the worlds, obstacles once for every agent."""
        # Coordinates first.
        self.parts[:2, worlds] = np.stack([one.starts.T for one in scenarios], 1)
        self.parts[2, worlds] = [one.headings for one in scenarios]
        self.goals[:, worlds] = np.stack([one.goals.T for one in scenarios], 1)
        centres = np.zeros((2, worlds.size, self.obstacles))
        radii = np.full(centres.shape[1:], -np.inf)
        for place, one in enumerate(scenarios):
            count = len(one.obstacles)
            centres[:, place, :count] = one.obstacles.T
            radii[place, :count] = one.obstacle_radii
        self.obstacle_centres[:, worlds], self.obstacle_radii[worlds] = centres, radii
        self.agent_radius[worlds] = [one.agent_radius for one in scenarios]
        self.core_radius[worlds] = [one.core for one in scenarios]
        self._nearby = self._near = None

    def _look(self, reach: float) -> Near:
        """Return what is near agents that came from no further than the reach [m], and keep it."""
        if self._nearby is None:
            self._nearby = Nearby(
                self.settings.sensing_radius,
                self.parts[:2],
                self.goals,
                2.0 * self.agent_radius,
                self.obstacle_centres,
                self.obstacle_radii,
                self.core_radius,
            )
        self._near = self._nearby.at(self.parts[:2].copy(), reach)
        return self._near

    def _touched(self, path: Path, near: Near) -> BoolArray:
        """Return who came too close to an agent or an obstacle on the way."""
        contact, touch = 2.0 * self.agent_radius, self.obstacle_radii + self.core_radius[:, None]
        if self.compiled:
            return touched(path, contact, self.obstacle_centres, touch, near)
        hit = swept_agents(path, contact, near.agents)
        if self.obstacles:
            hit |= swept_obstacles(path, self.obstacle_centres, touch, near.obstacles)
        return hit

    def _current_push(self) -> FloatArray:
        """Return d of this step, (6, worlds, agents)."""
        if self.disturbance.kind == "none":
            return self.push
        # Past the time limit (a caller who ignored `truncated`) the last push stays.
        index = np.minimum(self.step_count, self.settings.steps - 1)
        push = self._pushes[self._everywhere, index].transpose(1, 0, 2)
        if not self.disturbance.is_feedback:
            return push.copy()
        situation = Situation(
            self.states,
            self.nominal_now(),
            np.repeat(self.time[:, None], self.agents, axis=1),
            push.transpose(1, 2, 0),
        )
        return self.disturbance.respond(situation).transpose(2, 0, 1).copy()

    def _advance(self, control: FloatArray) -> tuple[Path, BoolArray]:
        """Move the states over one control step, and tell which could be integrated."""
        wrench = self.settings.system.wrench(list(control))
        points = np.empty((SUBSTEPS + 1, 2, self.worlds, self.agents))
        # No turn of the body makes its force longer, and a path whose acceleration is at most a
        # leaves its chord by at most a h^2 / 8.
        acceleration = _length(wrench[0], wrench[1]) / self.settings.system.mass
        bulge = (acceleration + _length(self.push[3], self.push[4])) * (self._substep**2 / 8.0)
        points[0] = self.parts[:2]
        with np.errstate(over="ignore", invalid="ignore"):
            parts = self._saturated(self.parts, self._hold(self.parts, wrench, self.push))
            points[1] = parts[:2]
            for substep in range(1, SUBSTEPS):
                parts = self._saturated(parts, self._hold.go_on(parts))
                points[substep + 1] = parts[:2]
            integrated = np.all(np.abs(parts) <= task.LARGEST_STATE, axis=0)
        if not integrated.all():
            # What could not be integrated stays where it was, and so does its path.
            parts = np.where(integrated, parts, self.parts)
            points = np.where(integrated, points, points[:1])
            bulge = np.where(integrated, bulge, 0.0)
        self.parts = parts.copy()
        return Path.through(points, bulge), integrated

    def _saturated(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """Return states after a substep as the speed limit leaves them.

        A velocity along an axis that reaches the limit stays there: what it would have gained goes,
        and the way that it would have covered with it, v_e^2 / 2a of an acceleration a that leads
        v_e beyond the limit.
        """
        limit = self.settings.speed_limit
        if limit is None:
            return after
        parts = after.copy()
        for place, speed in ((0, 3), (1, 4)):
            kept = np.clip(after[speed], -limit, limit)
            beyond = after[speed] - kept
            gain = after[speed] - before[speed]
            share = np.divide(beyond, gain, out=np.zeros_like(gain), where=beyond != 0.0)
            parts[place] -= 0.5 * self._substep * beyond * share
            parts[speed] = kept
        return parts

    def _note_arrivals(self, distance: FloatArray, worlds: BoolArray | bool = True) -> BoolArray:
        """Record the first arrivals, after the collisions, and return who just arrived.

        Args:
            distance: ||p - p_f||, shape (worlds, agents) [m].
            worlds: Which worlds to look at, shape (worlds, 1); True for all.
        """
        settings, now = self.settings, self.time[:, None]
        eligible = ~self.collided & worlds
        open_ = np.isinf(self.success_time) & worlds
        there = worlds & (distance <= settings.goal_radius)
        self.reached = self.reached | there
        first = eligible & open_ & there
        self.effort_to_success = np.where(open_, self.effort, self.effort_to_success)
        self.success_time = np.where(first, now, self.success_time)
        _, _, _, velocity_x, velocity_y, _ = self.parts
        square = distance * distance + velocity_x * velocity_x + velocity_y * velocity_y
        inside = square <= (settings.tube.radius(self.time) ** 2)[:, None]
        paper = eligible & inside & np.isinf(self.paper_success_time)
        self.paper_success_time = np.where(paper, now, self.paper_success_time)
        return cast(BoolArray, first)


def _length(first: FloatArray, second: FloatArray) -> FloatArray:
    # Three times faster than hypot; no state comes near the squares that overflow.
    length: FloatArray = np.sqrt(first * first + second * second)
    return length
