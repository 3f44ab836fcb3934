"""Policy (b) of the spacecraft: every agent plans for itself, online, on what it senses."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_above, check_instance, check_not_negative, check_whole, shown
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_policies.contraction.double_integrator import planned_margin
from lagros_policies.planning.local.map import LocalMap
from lagros_policies.planning.local.motion import Discs, LocalPlan
from lagros_policies.planning.local.plan import LocalPlanner
from lagros_policies.planning.local.problem import LocalPlannerSettings
from lagros_policies.planning.vectors import lengths
from lagros_policies.policy import BasePolicy, PolicyState, row_memories
from lagros_policies.tasks.spacecraft.gain_control import tracking_law
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.setup import (
    PAIR_SHARE,
    PLANE,
    check_planner_force,
    plan_force_limit,
    task_and_preset,
)

# A neighbour slower than this [m/s] is taken to rest, plus this for each unit of the bound: what is
# left of the disturbance in a smoothed velocity.
_STILL, _STILL_NOISE = 0.04, 0.1
# Every so many plans another way is looked for, though the one in force holds.
_FRESH_EVERY = 5
# Goals farther than this are planned for in parts: rest this far ahead on the straight line [m], on
# the way to which obstacles farther than `_AROUND` do not count [m].
_REACH, _AROUND = 8.0, 10.0
# An agent is stuck that has not come closer by `_PROGRESS` [m] for `_PATIENCE` [s].
_PROGRESS, _PATIENCE = 0.1, 6.0


@dataclass
class DistributedState:
    """What one agent remembers of its episode.

    Attributes:
        map: What it has sensed, in axes whose origin is its goal.
        plan: The plan in force; None before the first.
        age: Control steps since that plan began.
        unchecked: Control steps since it was found or confirmed.
        time: t of the last call [s].
        plans: Plans asked for.
        confirmed_plans: Times that the plan in force was found to hold, and kept.
        infeasible_plans: Plans that fall short of a distance that they were asked to keep.
        broken_plans: Plans for which the solver found nothing; the last one stayed in force.
        late_plans: Plans that took longer than the deadline; the last one stayed in force.
        closest: Least distance to the goal so far [m], in steps of what counts as progress.
        closest_time: When it got there [s].
        stuck: Whether it has not come closer for some seconds, short of the goal.
        stuck_steps: Control steps for which it was.
    """

    map: LocalMap = field(default_factory=LocalMap)
    plan: LocalPlan | None = None
    age: int = 0
    unchecked: int = 0
    time: float = -math.inf
    plans: int = 0
    confirmed_plans: int = 0
    infeasible_plans: int = 0
    broken_plans: int = 0
    late_plans: int = 0
    closest: float = math.inf
    closest_time: float = 0.0
    stuck: bool = False
    stuck_steps: int = 0

    @property
    def failed_plans(self) -> int:
        """Plans that were short of a distance, or that the solver did not find."""
        return self.infeasible_plans + self.broken_plans


class DistributedTubeMpcPolicy(BasePolicy):
    """Distributed online tube MPC with the control u* around each agent's own plan.

    Every row of an observation is one agent, which knows what it senses and remembers the obstacles
    that it has seen. It plans in axes whose origin is its goal, to rest there at T or as soon after
    as it can, or 8 m ahead where the goal is farther, in that share of the time, so that a plan and
    the time that it takes stay bounded however far it is; takes other agents to go on as they do,
    for as long as the plan's short steps last;
    and keeps to the right of whoever it meets. A plan begins at the *nominal* state of the last,
    not at the measured one: u* keeps the agent in the tube around one continuous target trajectory.

    Plans ask for `margin` to obstacles and sqrt(2) times that to agents. What cannot be kept is
    given up at a price, so that there is always a plan; plans that had to are counted as failed.
    Agents do not tell each other what they plan, so that they may block each other: who has not
    come closer to its goal for 6 s is shown as stuck.

    Args:
        settings: The task.
        preset: The preset, or its name: how many slots an observation has, and the radii of the
            agents, which it does not tell.
        num_agents: Number of agents in a world; None for the preset's own.
        disturbance_bound: d_bar to prepare for, in units of the state per second.
        contraction_rate: alpha of u* in the plane [1/s]; a faster one needs less margin and more
            effort.
        turning_rate: alpha of the heading, which no goal asks for [1/s].
        margin: Room beyond touching that plans ask for [m]; None takes it from the bound.
        replan_every: Control steps between looks at the plan in force: it is kept if it still
            keeps all distances to what is sensed by then, and renewed if not.
        kept_for: A plan older than this is renewed though it holds [s]; 0 renews it at every look.
        smoothing: Time constant of the filter of neighbours' positions and velocities [s].
        planner: The planner; its mass must be that of the task.
        law: How u* answers an error, a name of `gain_control.LAWS`; None for the policy's own.
        deadline: Delta t_max, after which a plan is late: the last one stays in force, and the late
            one is counted and dropped. An agent that has none yet waits for its first [s]. None for
            the control period.
        clock: Source of the time [s]; the processor time of the thread, which other work on the
            machine does not lengthen.

    Raises:
        ValueError: A value is out of range, there is no such law, or the thrust limit leaves plans
            no force.
    """

    name = "tube-mpc"
    prepared = True  # `policy.make` tells it the bound of the environment's disturbance
    own_law: ClassVar[str] = "gain"

    def __init__(
        self,
        settings: task.SpacecraftSettings | None = None,
        preset: str | Preset = "paper",
        num_agents: int | None = None,
        disturbance_bound: float = 0.4,
        contraction_rate: float = 2.0,
        turning_rate: float = 0.3,
        margin: float | None = None,
        replan_every: int = 2,
        kept_for: float = 0.7,
        smoothing: float = 0.7,
        planner: LocalPlannerSettings | None = None,
        law: str | None = None,
        deadline: float | None = None,
        clock: Callable[[], float] = time.thread_time,
    ) -> None:
        self.settings, self.preset = task_and_preset(settings, preset, num_agents)
        self.layout = Layout.for_preset(self.preset, self.settings)
        check_whole("replan_every", replan_every)
        for name, value in (("kept_for", kept_for), ("smoothing", smoothing)):
            check_not_negative(name, value)
        body, period = self.settings.system, self.settings.control_period
        self.deadline = period if deadline is None else deadline
        check_above("deadline", self.deadline, 0)
        if not callable(clock):
            raise ValueError(f"clock={shown(clock)} must be a function that returns seconds")
        self._clock = clock
        self.tracking = tracking_law(
            self.own_law if law is None else law, body, period, contraction_rate, turning_rate
        )
        self.margin = planned_margin(margin, disturbance_bound, contraction_rate)
        self.replan_every, self.kept_for, self.smoothing = replan_every, kept_for, smoothing
        self.still = _STILL + _STILL_NOISE * disturbance_bound
        allowed = plan_force_limit(self.settings, disturbance_bound)
        if planner is None:
            planner = LocalPlannerSettings(mass=body.mass, force_limit=allowed)
        check_instance("planner", planner, LocalPlannerSettings)
        if planner.mass != body.mass:
            raise ValueError(
                f"the planner is for mass={planner.mass!r}; the task has {body.mass!r}"
            )
        check_planner_force(planner.force_limit, allowed)
        self.planner = LocalPlanner(planner)

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Plan if it is time, and track; see `Policy.predict`.

        Rows are agents, o_l of one (o,) or of many (B, o), with a `DistributedState` each.

        Raises:
            ValueError: The observation is not that of an agent of this task, or the memories are
                not those of these rows.
        """
        sensed = Sensed.of(self.layout, observation)
        count = len(sensed.time)
        memories: list[DistributedState | None] = row_memories(
            state, episode_start, count, "agents", DistributedState
        )
        # Copies: what was returned before stays what it was.
        following = [
            DistributedState() if memory is None else replace(memory, map=copy(memory.map))
            for memory in memories
        ]
        nominal, accelerations = np.zeros((count, task.STATE_DIM)), np.zeros((count, 3))
        for row, memory in enumerate(following):
            nominal[row, PLANE], accelerations[row, :2] = self._follow(sensed, row, memory)
        states = np.zeros((count, task.STATE_DIM))
        states[:, :2], states[:, 3:5] = -sensed.goal, sensed.velocity
        states[:, 2], states[:, 5] = sensed.heading, sensed.spin
        nominal[:, 2] = sensed.heading - sensed.heading_change
        thrust = self.tracking.control(states, nominal, accelerations)
        action = (thrust / self.settings.thrust_scale).astype(np.float32)
        return (action if np.ndim(observation) == 2 else action[0]), following

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return what happened, added up over the agents of a state.

        `plans` were asked for; `confirmed_plans` are the times that one still held and was kept;
        `failed_plans` fell short of a distance or were not found; `late_plans` missed the deadline;
        `stuck` agents are stuck now;
        `stuck_steps` are the control steps that agents spent stuck.
        """
        names = ("plans", "confirmed_plans", "failed_plans", "late_plans", "stuck", "stuck_steps")
        return {name: sum(int(getattr(memory, name)) for memory in state) for name in names}

    def _follow(
        self, sensed: Sensed, row: int, memory: DistributedState
    ) -> tuple[FloatArray, FloatArray]:
        """Renew the plan of one agent if it is time; return [p_d, v_d] and the acceleration."""
        period = self.settings.control_period
        now = float(sensed.time[row])
        if now < memory.time - 0.5 * period:
            raise ValueError(
                f"the time of row {row} went back from {memory.time:g} to {now:g} s: pass "
                "state=None, or episode_start, when an episode starts"
            )
        own = np.concatenate([-sensed.goal[row], sensed.velocity[row]])
        news = self._notice(sensed, row, own, memory)
        self._note_progress(own, now, memory)
        memory.time = now
        if memory.plan is not None:
            memory.age += 1
            memory.unchecked += 1
        if memory.plan is None or news or memory.unchecked >= self.replan_every:
            self._confirm_or_renew(own, now, memory)
        plan = memory.plan
        if plan is None:
            # Nothing was ever found: hold the position.
            return np.concatenate([own[:2], np.zeros(2)]), np.zeros(2)
        elapsed = memory.age * period
        place, speed = plan.at(np.array([elapsed]))
        return np.concatenate([place[0], speed[0]]), plan.force(elapsed) / plan.mass

    def _notice(self, sensed: Sensed, row: int, own: FloatArray, memory: DistributedState) -> bool:
        """Update the map, and return whether there is something new on it."""
        obstacles = sensed.obstacles[row, sensed.obstacle_mask[row]] + [*own[:2], 0.0]
        neighbours = sensed.neighbours[row, sensed.neighbour_mask[row]] + own
        new = memory.map.notice_obstacles(obstacles)
        period = self.settings.control_period
        return memory.map.notice_neighbours(neighbours, period, self.smoothing) or new

    def _note_progress(self, own: FloatArray, now: float, memory: DistributedState) -> None:
        distance = float(np.linalg.norm(own[:2]))
        if distance <= memory.closest - _PROGRESS:
            memory.closest, memory.closest_time = distance, now
        away = distance > self.settings.goal_radius
        memory.stuck = away and now - memory.closest_time > _PATIENCE
        memory.stuck_steps += memory.stuck

    def _confirm_or_renew(self, own: FloatArray, now: float, memory: DistributedState) -> None:
        """Keep the plan in force if it still keeps its distances, else plan anew."""
        plan, elapsed = memory.plan, memory.age * self.settings.control_period
        start = own  # of a first plan; later ones begin at the nominal state
        if plan is not None:
            start = np.concatenate([part[0] for part in plan.at(np.array([elapsed]))])
        goal, left = _ahead(start[:2], self.settings.horizon - now)
        discs = self._discs(memory.map, start[:2])
        memory.unchecked = 0
        if plan is not None and elapsed < self.kept_for - 1e-9:
            short = self.planner.shortfall(plan, elapsed, goal, discs, left)
            if short <= self.planner.settings.tolerance:
                memory.confirmed_plans += 1
                return
        self._renew(start, goal, left, discs, memory)

    def _renew(
        self,
        start: FloatArray,
        goal: FloatArray,
        left: float,
        discs: Discs,
        memory: DistributedState,
    ) -> None:
        """Plan from a state to rest at a place."""
        last, elapsed = memory.plan, memory.age * self.settings.control_period
        fresh = memory.plans % _FRESH_EVERY == 0
        begun = self._clock()
        plan = self.planner.plan(start, goal, discs, left, last, elapsed, fresh)
        late = self._clock() - begun > self.deadline
        memory.plans += 1
        memory.late_plans += late
        if not plan.solved:
            memory.broken_plans += 1
            return
        if late and last is not None:
            return
        memory.infeasible_plans += plan.short > self.planner.settings.tolerance
        memory.plan, memory.age = plan, 0

    def _discs(self, known: LocalMap, place: FloatArray) -> Discs:
        obstacles, neighbours = known.obstacles, known.neighbours
        obstacles = obstacles[lengths(obstacles[:, :2] - place) <= _AROUND]
        preset = self.preset
        counts = len(obstacles), len(neighbours)
        speed = np.hypot(neighbours[:, 2], neighbours[:, 3])
        moving = speed > self.still
        velocities = np.zeros((sum(counts), 2))
        velocities[counts[0] :] = np.where(moving[:, None], neighbours[:, 2:], 0.0)
        return Discs(
            np.vstack([obstacles[:, :2], neighbours[:, :2]]),
            velocities,
            np.concatenate(
                [obstacles[:, 2] + preset.core, np.full(counts[1], 2.0 * preset.agent_radius)]
            ),
            np.repeat([self.margin, PAIR_SHARE * self.margin], counts),
            np.concatenate([np.zeros(counts[0], bool), moving]),
        )


def _ahead(place: FloatArray, left: float) -> tuple[FloatArray, float]:
    """Return where a plan is to rest and in which time, in axes whose origin is the goal."""
    distance = float(np.hypot(*place))
    if distance <= _REACH:
        return np.zeros(2), left
    share = _REACH / distance
    return (1.0 - share) * place, share * left


class LeastNormTubeMpcPolicy(DistributedTubeMpcPolicy):
    """The same with Theorem 2's least-norm u* of the metric of least chi."""

    name = "tube-mpc:least-norm"
    own_law = "least-norm"
