"""What the filters of the spacecraft share: a policy is asked, and its actions are changed.

Where nothing is to be changed the action is the policy's own, bit for bit. Nothing is silent: what
a filter does is counted.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray, IntArray
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_policies.policy import BasePolicy, Policy, PolicyState, as_policy
from lagros_policies.safety.barrier import BarrierSettings
from lagros_policies.tasks.spacecraft.sensed import Sensed, WorldState
from lagros_policies.tasks.spacecraft.setup import task_and_preset
from lagros_policies.tasks.spacecraft.thrusters import to_body

Counts = NDArray[np.int64]

COUNTERS = ("filtered_steps", "interventions", "infeasible")
# An agent is blocked if the goal lies within this cosine of behind what it must not touch ...
_FACING = 0.7
# ... and it passes clockwise, unless it already passes faster than this the other way [m/s].
_ALREADY_PASSING = 0.05


class FilterState(NamedTuple):
    """What a filter remembers; the inner state comes first.

    Attributes:
        inner: The state of the inner policy.
        counts: For each row of the observation the `COUNTERS` of its episode, shape (B, 3).
        memory: What the filter itself remembers, one row per agent, nan where nothing; None for a
            filter that remembers nothing.
    """

    inner: PolicyState
    counts: Counts
    memory: FloatArray | None = None


class Wanted(NamedTuple):
    """What actions do over a hold.

    Attributes:
        wrench: In the body's axes, shape (B, 3) [N, N, N m].
        middle: Heading in the middle of the hold, shape (B,) [rad].
        acceleration: Of position, in the world's axes, shape (B, 2) [m/s^2].
    """

    wrench: FloatArray
    middle: FloatArray
    acceleration: FloatArray


class ActionFilter(BasePolicy):
    """A policy whose actions a filter changes.

    It uses what lies within the sensing radius and the radii of the preset, also for an inner
    policy that observes everything.

    Args:
        policy: The inner policy, of the spacecraft; its actions are those of the environment.
        settings: The task.
        preset: The preset, or its name: the layout of the observation and the radii.
        num_agents: Number of agents; None for the preset's own.

    Raises:
        TypeError: The inner policy is not one.
        ValueError: A value is out of range.
    """

    def __init__(
        self,
        policy: Policy,
        settings: task.SpacecraftSettings | None = None,
        preset: str | Preset = "paper",
        num_agents: int | None = None,
    ) -> None:
        self.policy = as_policy(policy)
        self.name = f"{self.policy.name}+filter"
        self.observes = self.policy.observes
        self.settings, self.preset = task_and_preset(settings, preset, num_agents)
        self.layout = Layout.for_preset(self.preset, self.settings)
        thrusters = np.eye(task.THRUSTERS)
        self._wrench_of_thrust = np.stack(self.settings.system.wrench(list(thrusters)), axis=-1)

    def wanted(self, actions: NDArray[Any], sensed: Sensed) -> Wanted:
        """Return what actions do over a hold.

        The force is held in the body's axes, which turn: they are taken in the middle of the hold.

        Args:
            actions: One per agent, shape (B, 8), in units of `settings.thrust_scale`.
            sensed: What the agents sense.
        """
        body, h = self.settings.system, self.settings.control_period
        wrench = task.applied_forces(self.settings, actions) @ self._wrench_of_thrust
        turn = wrench[:, 2] / (2.0 * body.inertia)
        middle = sensed.heading + 0.5 * h * sensed.spin + 0.125 * h * h * turn
        return Wanted(wrench, middle, to_body(wrench[:, :2] / body.mass, -middle))

    def sidestep(
        self,
        kept: BarrierSettings,
        rows: IntArray,
        normal: FloatArray,
        passing: FloatArray,
        sensed: Sensed,
    ) -> FloatArray:
        """Return what to add to the acceleration of agents that are blocked, (k, 2) [m/s^2].

        Two agents that meet head-on, and an agent behind an obstacle, would wait for ever where the
        filter leaves only the way back. An agent that does not get on, and whose goal lies behind
        what it must not touch, is pushed along the rim until it passes at the sidestep's speed:
        clockwise, or the way in which it already passes. Both agents of a pair find the same sense
        of turning about each other.

        Args:
            kept: Speeds and rate of the sidestep.
            rows: Which agents, shape (k,).
            normal: From what each must not touch to it, of length one, shape (k, 2).
            passing: Its velocity relative to that, shape (k, 2) [m/s].
            sensed: What all agents sense.
        """
        x, y = normal[:, 0], normal[:, 1]
        goal, velocity = sensed.goal[rows], sensed.velocity[rows]
        distance = np.sqrt(np.sum(goal * goal, axis=-1))
        behind = -(x * goal[:, 0] + y * goal[:, 1]) > _FACING * distance
        along = np.stack([y, -x], axis=-1)
        clockwise = y * passing[:, 0] - x * passing[:, 1]
        along = np.where((clockwise < -_ALREADY_PASSING)[:, None], -along, along)
        lacking = np.maximum(kept.sidestep_speed - np.sum(along * velocity, axis=-1), 0.0)
        # Who has arrived stays.
        progress = np.sum(velocity * goal, axis=-1)
        blocked = (
            behind
            & (distance > self.settings.goal_radius)
            & (progress < kept.blocked_speed * distance)
        )
        size = kept.sidestep_rate * blocked * lacking
        push: FloatArray = size[:, None] * along
        return push

    def _filtered(
        self, actions: NDArray[Any], sensed: Sensed, memory: FloatArray | None
    ) -> tuple[Float32Array, BoolArray, BoolArray, FloatArray | None]:
        """Return actions, which were changed, where not all could be kept, and what to remember.

        Args:
            actions: One per agent, shape (B, 8), in units of `settings.thrust_scale`.
            sensed: What the agents sense.
            memory: What was remembered, shape (B, q), nan where an episode begins; None at the
                first call.
        """
        raise NotImplementedError

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Ask the inner policy and filter its actions; see `Policy.predict`.

        Rows are what the inner policy takes, agents or worlds, and so are the actions.

        Raises:
            ValueError: The observation, the state or the inner action has a wrong shape, or is not
                finite.
        """
        if self.observes == "local":
            sensed = Sensed.of(self.layout, observation)
            rows = len(sensed.time)
        else:
            slots = max(1, self.preset.obstacle_count[1])
            world = WorldState.of(self.preset.agents, slots, observation)
            sensed = world.sensed(self.settings.sensing_radius)
            rows = len(world.time)
        inner, counts, memory = self._remembered(state, rows, episode_start)
        wanted, inner = self.policy.predict(observation, inner, episode_start, deterministic)
        actions = self._checked(wanted, len(sensed.time))
        filtered, changed, infeasible, memory = self._filtered(actions, sensed, memory)
        seen = np.stack([np.ones_like(changed), changed, infeasible], axis=-1)
        counts = counts + seen.reshape(rows, -1, len(COUNTERS)).sum(axis=1)
        return filtered.reshape(np.shape(wanted)), FilterState(inner, counts, memory)

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return the inner policy's counters and the filter's own, over the rows of a state.

        `filtered_steps` are the agent-steps seen, `interventions` those whose action was changed,
        and `infeasible` those at which not everything could be kept clear of, so that the largest
        violation was made least.
        """
        totals = state.counts.sum(axis=0).tolist()
        return {**self.policy.counters(state.inner), **dict(zip(COUNTERS, totals, strict=True))}

    def reseed(self, generator: np.random.Generator) -> None:
        """Pass the generator on, if the inner policy draws anything."""
        self.policy.reseed(generator)

    @property
    def draws(self) -> bool:
        """Whether the inner policy takes a generator."""
        return self.policy.draws

    @property
    def bare(self) -> BasePolicy:
        """The inner policy."""
        return self.policy

    def _remembered(
        self, state: PolicyState, count: int, episode_start: BoolArray | None
    ) -> FilterState:
        """Return the inner state and what was counted, which starts anew with an episode."""
        if state is None:
            return FilterState(None, np.zeros((count, len(COUNTERS)), np.int64))
        if not isinstance(state, FilterState) or len(state.counts) != count:
            raise ValueError(
                f"state must be what the filter returned for these {count} rows, or None at the "
                "start of an episode"
            )
        if episode_start is None:
            return state
        starts = np.ravel(episode_start).astype(bool)
        if len(starts) != count:
            raise ValueError(f"episode_start has {len(starts)} entries; {count} rows are observed")
        memory = state.memory
        if memory is not None:
            begins = np.repeat(starts, len(memory) // count)
            memory = np.where(begins[:, None], np.nan, memory)
        return FilterState(state.inner, np.where(starts[:, None], 0, state.counts), memory)

    def _checked(self, wanted: Any, agents: int) -> NDArray[Any]:
        """Return the inner actions, one row per agent."""
        actions = np.asarray(wanted)
        if actions.size != agents * task.THRUSTERS or actions.shape[-1:] != (task.THRUSTERS,):
            raise ValueError(
                f"{self.policy.name} answered with shape {actions.shape} for {agents} agents; an "
                f"action has {task.THRUSTERS} numbers for each"
            )
        if not np.all(np.isfinite(actions)):
            raise ValueError(f"the action of {self.policy.name} is not finite")
        return actions.reshape(agents, task.THRUSTERS)
