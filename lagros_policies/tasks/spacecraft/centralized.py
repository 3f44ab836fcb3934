"""Policy (d): the centralised planner. One plan for all agents at the start, tracked with u*."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_instance
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.physics import HEADING, SPIN
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_policies.contraction.double_integrator import planned_margin
from lagros_policies.planning.joint.plan import JointPlan
from lagros_policies.planning.joint.planner import JointPlanner, JointPlannerSettings
from lagros_policies.policy import BasePolicy, Observes, PolicyState, row_memories
from lagros_policies.tasks.spacecraft.sensed import WorldState
from lagros_policies.tasks.spacecraft.setup import (
    PAIR_SHARE,
    PLANE,
    check_planner_force,
    plan_force_limit,
    task_and_preset,
    write_plan,
)
from lagros_policies.tasks.spacecraft.wrench_control import WrenchTracking

# Time from node to node of a plan [s].
_NODE_PERIOD = 0.5
# Where no plan keeps the margin these shares of it are tried in turn.
_SHARES = (1.0, 0.75, 0.5, 0.25)
# Leave tight starts at this acceleration [m/s^2]. With it and `PAIR_SHARE`, at d_bar = 1 in 60
# worlds: success 99.7 % (99.4 % on 60 worlds not looked at before), against 96.4 % with equal room
# and the planner's own margin_growth.
_MARGIN_GROWTH = 0.05


def planner_settings(
    settings: task.SpacecraftSettings, margin: float, disturbance_bound: float = 0.0
) -> JointPlannerSettings:
    """Return how to plan the task with a margin, less of it where there is no such plan.

    Args:
        settings: The task.
        margin: Room beyond touching to ask for first [m].
        disturbance_bound: d_bar for which plans leave force where there is a thrust limit, in units
            of the state per second.

    Raises:
        ValueError: The horizon is not a whole number of node steps of 0.5 s, one of those is not a
            whole number of control periods, or the thrust limit leaves no force for plans.
    """
    nodes = round(settings.horizon / _NODE_PERIOD)
    if abs(nodes * _NODE_PERIOD - settings.horizon) > 1e-6:
        raise ValueError(
            f"horizon={settings.horizon!r} s must be a whole number of node steps of "
            f"{_NODE_PERIOD} s; or give a planner of your own"
        )
    return JointPlannerSettings(
        horizon=settings.horizon,
        nodes=nodes,
        control_period=settings.control_period,
        mass=settings.system.mass,
        margins=tuple(share * margin for share in _SHARES),
        pair_share=PAIR_SHARE,
        margin_growth=_MARGIN_GROWTH,
        force_limit=plan_force_limit(settings, disturbance_bound),
    )


@dataclass(frozen=True)
class CentralizedState:
    """What the policy remembers of the episode of one world.

    Attributes:
        plan: The plan, solved or not; None if too little time was left to ask for one.
        starts: Positions from which it was made, shape (agents, 2) [m].
        goals: The goals that it was made for, shape (agents, 2) [m].
        nominal: x_d at every control instant of the episode, shape (steps + 1, agents, 6); at rest
            after the plan's end, and all the time where it failed. An environment takes it as
            `options["nominal"]`.
        accelerations: Of x, y and heading under u_d, shape (steps, agents, 3).
    """

    plan: JointPlan | None
    starts: FloatArray
    goals: FloatArray
    nominal: FloatArray
    accelerations: FloatArray

    @property
    def solved(self) -> bool:
        """Whether there is a plan to follow."""
        return self.plan is not None and self.plan.solved


class CentralizedPolicy(BasePolicy):
    """Joint trajectories of all agents, planned once, with the control u* around them.

    It is fed the environment's `state()`. At the start of an episode it plans for all agents from
    where they are; then each tracks its trajectory, and keeps station at its end. If there is no
    plan every agent holds its position, and that is counted.

    The plan keeps `margin` to obstacles, and sqrt(2) times that between agents, as both err. By
    default the margin is the position error that 95 % of agents do not exceed under the disturbance
    bound at the contraction rate (`expected_margin`), at least 0.05 m. Where no such plan is found,
    three quarters, a half and a quarter of it are tried; the plan says which it keeps.

    Args:
        settings: The task.
        preset: The preset, or its name: how many obstacles `state()` has room for, and the radii of
            the agents, which `state()` does not tell.
        num_agents: Number of agents; None for the preset's own.
        disturbance_bound: d_bar to prepare for, in units of the state per second.
        contraction_rate: alpha of u* in the plane [1/s]; a faster one needs less margin and more
            effort.
        turning_rate: alpha of the heading, which no goal asks for [1/s].
        margin: Room beyond touching that plans ask for first [m]; None takes it from the bound.
        planner: The planner, with margins of its own.

    Raises:
        ValueError: A value is out of range, `margin` and `planner` are both given, the planner's
            periods or mass are not those of the task, or the thrust limit leaves it less force.
    """

    name = "centralized"
    prepared = True  # `policy.make` tells it the bound of the environment's disturbance
    observes: Observes = "global"

    def __init__(
        self,
        settings: task.SpacecraftSettings | None = None,
        preset: str | Preset = "paper",
        num_agents: int | None = None,
        disturbance_bound: float = 0.4,
        contraction_rate: float = 2.0,
        turning_rate: float = 0.3,
        margin: float | None = None,
        planner: JointPlannerSettings | None = None,
    ) -> None:
        self.settings, self.preset = task_and_preset(settings, preset, num_agents)
        self.agents = self.preset.agents
        self.obstacles = max(1, self.preset.obstacle_count[1])
        if margin is not None and planner is not None:
            raise ValueError("give margin or planner, not both: a planner has its own margins")
        body, period = self.settings.system, self.settings.control_period
        self.tracking = WrenchTracking.for_rates(body, period, contraction_rate, turning_rate)
        wanted = planned_margin(margin, disturbance_bound, contraction_rate)
        if planner is None:
            planner = planner_settings(self.settings, wanted, disturbance_bound)
        check_instance("planner", planner, JointPlannerSettings)
        if planner.control_period != period or planner.mass != body.mass:
            raise ValueError(
                f"the planner is for control_period={planner.control_period!r} and "
                f"mass={planner.mass!r}; the task has {period!r} and {body.mass!r}"
            )
        check_planner_force(planner.force_limit, plan_force_limit(self.settings, disturbance_bound))
        self.planner = JointPlanner(planner)

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Plan at the start, then track; see `Policy.predict`.

        Rows are worlds, `state()` of one (s,) or of many (B, s), with a `CentralizedState` each;
        actions are those of all agents in the environment's order, (agents, 8) or (B, agents, 8).

        Raises:
            ValueError: The observation is not a `state()` of this task, or the memories are not
                those of these worlds.
        """
        worlds = WorldState.of(self.agents, self.obstacles, observation)
        count = len(worlds.time)
        memories: list[CentralizedState | None] = row_memories(
            state, episode_start, count, "worlds", CentralizedState
        )
        following = [
            self._start(worlds, world) if memory is None else _same(worlds, world, memory)
            for world, memory in enumerate(memories)
        ]
        steps = [self._step(time) for time in worlds.time.tolist()]
        # The clock of an episode that ran past its limit stands still.
        last = self.settings.steps - 1
        thrust = self.tracking.control(
            worlds.states,
            np.stack([memory.nominal[k] for memory, k in zip(following, steps, strict=True)]),
            np.stack(
                [
                    memory.accelerations[min(k, last)]
                    for memory, k in zip(following, steps, strict=True)
                ]
            ),
        )
        action = (thrust / self.settings.thrust_scale).astype(np.float32)
        return (action if np.ndim(observation) == 2 else action[0]), following

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return how many plans were asked for and how many failed, over the worlds of a state."""
        return {
            "plans": len(state),
            "failed_plans": sum(not memory.solved for memory in state),
        }

    def _step(self, time: float) -> int:
        return min(round(time / self.settings.control_period), self.settings.steps)

    def _start(self, worlds: WorldState, world: int) -> CentralizedState:
        """Plan one world from what is observed now."""
        settings, planning = self.settings, self.planner.settings
        first, goals = self._step(float(worlds.time[world])), worlds.goals[world].copy()
        states = worlds.states[world]
        plan: JointPlan | None = None
        left = (settings.steps - first) * settings.control_period
        if left >= 2.0 * planning.node_period - 1e-9:
            obstacles = worlds.obstacles[world, worlds.obstacle_mask[world]]
            plan = self.planner.plan(
                states[:, PLANE],
                goals,
                obstacles[:, :2],
                obstacles[:, 2],
                self.preset.agent_radius,
                self.preset.core,
                min(planning.horizon, left),
            )
        # Without a plan: at rest where it is.
        nominal = np.repeat(states[None], settings.steps + 1, axis=0)
        nominal[..., 3 : SPIN + 1] = 0.0
        accelerations = np.zeros((settings.steps, self.agents, 3))
        if plan is not None and plan.solved:
            headings, period = states[:, HEADING], settings.control_period
            end = write_plan(plan, first, headings, period, nominal, accelerations)
            nominal[end:, :, 3:] = 0.0
        return CentralizedState(plan, states[:, :2].copy(), goals, nominal, accelerations)


def _same(worlds: WorldState, world: int, memory: CentralizedState) -> CentralizedState:
    """Return the memory, if it is of an episode with these goals, and these starts at its start."""
    starts = worlds.states[world, :, :2] if worlds.time[world] == 0.0 else memory.starts
    if not (
        np.array_equal(worlds.goals[world], memory.goals) and np.array_equal(starts, memory.starts)
    ):
        raise ValueError(
            "the state is of an episode with other starts or goals; pass state=None, or "
            "episode_start, when an episode starts"
        )
    return memory
