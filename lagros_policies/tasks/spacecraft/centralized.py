"""Policy (d): the centralised planner. One plan for all agents at the start, tracked with u*.

With the gain that belongs to the metric as u*, a plan that keeps the law's proved error from
obstacles, and twice that between agents, is free of collisions whatever the disturbance does
(`guarantee`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_instance, check_name
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.physics import HEADING, SPIN
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_policies.contraction.double_integrator import LEAST_MARGIN, planned_margin
from lagros_policies.planning.joint.plan import JointPlan
from lagros_policies.planning.joint.planner import JointPlanner, JointPlannerSettings
from lagros_policies.planning.joint.rest import resting_places
from lagros_policies.policy import BasePolicy, Observes, PolicyState, row_memories
from lagros_policies.tasks.spacecraft.gain_control import (
    PLAN_ACCELERATION,
    GainTracking,
    tracking_law,
)
from lagros_policies.tasks.spacecraft.sensed import WorldState
from lagros_policies.tasks.spacecraft.setup import (
    PAIR_SHARE,
    PLANE,
    check_planner_force,
    plan_force_limit,
    task_and_preset,
    write_plan,
)
from lagros_policies.tasks.spacecraft.wrench_control import AxesTracking

# Time from node to node of a plan [s], and up to how many nodes of it. Longer plans, of worlds of
# many, have steps of twice, three times ... that, and are rounded down to whole ones.
_NODE_PERIOD, _MOST_NODES = 0.5, 90
# Where no plan keeps the margin these shares of it are tried in turn.
_SHARES = (1.0, 0.75, 0.5, 0.25)
# Leave tight starts at this acceleration [m/s^2]. With it and `PAIR_SHARE`, at d_bar = 1 in 60
# worlds: success 99.7 % (99.4 % on 60 worlds not looked at before), against 96.4 % with equal room
# and the planner's own margin_growth.
_MARGIN_GROWTH = 0.05
# Of certified plans: two agents err towards each other; beside the law's bound they keep what their
# straight pieces leave of the true path, and the planner's tolerance [m]. Beyond `_MOST_CERTIFIED`
# [m] few worlds have such a plan, and the search for it takes long.
_CERTIFIED_PAIR, _CERTIFIED_SPARE, _MOST_CERTIFIED, _CERTIFIED_TRIES = 2.0, 4e-3, 0.25, 3
# Control steps after which a tube has its full size.
_GROWN = 50
# Beyond a margin, where agents are to rest: the planner plans wider by as much [m].
_GOAL_SPARE = 6e-3


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
        ValueError: The horizon, up to 45 s, is not a whole number of node steps of 0.5 s, one of
            those is not a whole number of control periods, or the thrust limit leaves no force for
            plans.
    """
    steps = math.ceil(settings.horizon / (_MOST_NODES * _NODE_PERIOD) - 1e-9)
    period = steps * _NODE_PERIOD
    nodes = math.floor(settings.horizon / period + 1e-9)
    if steps == 1 and abs(nodes * period - settings.horizon) > 1e-6:
        raise ValueError(
            f"horizon={settings.horizon!r} s must be a whole number of node steps of "
            f"{_NODE_PERIOD} s; or give a planner of your own"
        )
    return JointPlannerSettings(
        horizon=nodes * period,
        nodes=nodes,
        control_period=settings.control_period,
        mass=settings.system.mass,
        margins=tuple(share * margin for share in _SHARES),
        pair_share=PAIR_SHARE,
        margin_growth=_MARGIN_GROWTH,
        force_limit=plan_force_limit(settings, disturbance_bound),
    )


def certified_planner(
    settings: JointPlannerSettings,
    law: AxesTracking,
    disturbance_bound: float,
    most: float = math.inf,
) -> JointPlanner | None:
    """Return a planner that keeps the proved error of a law, and looks harder for plans.

    The error of the gain grows from nothing, and so does the margin.

    Args:
        settings: How to plan without.
        law: The law.
        disturbance_bound: d_bar, in units of the state per second.
        most: Largest margin that is looked for [m].

    Returns:
        The planner; None where the margin is larger than that.
    """
    profile: tuple[float, ...] = ()
    if isinstance(law, GainTracking):
        tube = law.around_any_plan(disturbance_bound)
        margin = tube.largest + _CERTIFIED_SPARE
        # That of the end of each step, over all of it.
        ahead = (tube.instants[0, 1 : _GROWN + 1] + _CERTIFIED_SPARE) / margin
        profile = tuple(np.minimum(ahead, 1.0).tolist())
    else:
        margin = law.margin(disturbance_bound) + _CERTIFIED_SPARE
    if margin > most:
        return None
    limit = PLAN_ACCELERATION * settings.mass / math.sqrt(2.0)
    if settings.force_limit is not None:
        limit = min(limit, settings.force_limit)
    wanted = replace(
        settings,
        margins=(max(margin, LEAST_MARGIN),),
        margin_profile=profile,
        pair_share=_CERTIFIED_PAIR,
        force_limit=limit,
        restarts=_CERTIFIED_TRIES,
        searches=_CERTIFIED_TRIES,
    )
    return JointPlanner(wanted)


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

    With the margin "certified" the plan keeps from obstacles what the error of the law never
    exceeds under the disturbance bound (`AxesTracking.margin`, proved), twice that between agents,
    and ends beside goals that lack that room. With "expected" it keeps the position error that
    95 % of agents do not exceed (`expected_margin`, at least 0.05 m), and sqrt(2) times that
    between agents, as both err; where no such plan is found, three quarters, a half and a quarter
    of it are tried. By default the first is tried where it is at most 0.25 m, and then the second.
    The plan says which margin it keeps.

    Args:
        settings: The task.
        preset: The preset, or its name: how many obstacles `state()` has room for, and the radii of
            the agents, which `state()` does not tell.
        num_agents: Number of agents; None for the preset's own.
        disturbance_bound: d_bar to prepare for, in units of the state per second.
        contraction_rate: alpha of u* in the plane [1/s]; a faster one needs less margin and more
            effort. None for the policy's own, 2 1/s.
        turning_rate: alpha of the heading, which no goal asks for [1/s].
        margin: Room beyond touching that plans ask for [m], "certified" or "expected"; None for the
            two in turn.
        planner: The planner, with margins of its own.
        law: How u* answers an error, a name of `gain_control.LAWS`; None for the policy's own.

    Raises:
        ValueError: A value is out of range, `margin` and `planner` are both given, the planner's
            periods or mass are not those of the task, the thrust limit leaves it less force, or
            there is no such law or margin.
    """

    name = "centralized"
    prepared = True  # `policy.make` tells it the bound of the environment's disturbance
    observes: Observes = "global"
    own_law: ClassVar[str] = "gain"
    own_rate: ClassVar[float] = 2.0

    def __init__(
        self,
        settings: task.SpacecraftSettings | None = None,
        preset: str | Preset = "paper",
        num_agents: int | None = None,
        disturbance_bound: float = 0.4,
        contraction_rate: float | None = None,
        turning_rate: float = 0.3,
        margin: float | Literal["certified", "expected"] | None = None,
        planner: JointPlannerSettings | None = None,
        law: str | None = None,
    ) -> None:
        self.settings, self.preset = task_and_preset(settings, preset, num_agents)
        self.agents = self.preset.agents
        self.obstacles = max(1, self.preset.obstacle_count[1])
        if margin is not None and planner is not None:
            raise ValueError("give margin or planner, not both: a planner has its own margins")
        body, period = self.settings.system, self.settings.control_period
        chosen = self.own_law if law is None else law
        rate = self.own_rate if contraction_rate is None else contraction_rate
        self.tracking: AxesTracking = tracking_law(chosen, body, period, rate, turning_rate)
        if isinstance(margin, str):
            check_name("margin", margin, ("certified", "expected"))
        given = None if isinstance(margin, str) else margin
        wanted = planned_margin(given, disturbance_bound, rate)
        self.certified: JointPlanner | None = None
        if planner is None:
            planner = planner_settings(self.settings, wanted, disturbance_bound)
            if margin in (None, "certified"):
                most = math.inf if margin == "certified" else _MOST_CERTIFIED
                self.certified = certified_planner(planner, self.tracking, disturbance_bound, most)
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
            plan = self._plan(states[:, PLANE], goals, obstacles, min(planning.horizon, left))
        # Without a plan: at rest where it is.
        nominal = np.repeat(states[None], settings.steps + 1, axis=0)
        nominal[..., 3 : SPIN + 1] = 0.0
        accelerations = np.zeros((settings.steps, self.agents, 3))
        if plan is not None and plan.solved:
            headings, period = states[:, HEADING], settings.control_period
            end = write_plan(plan, first, headings, period, nominal, accelerations)
            nominal[end:, :, 3:] = 0.0
        return CentralizedState(plan, states[:, :2].copy(), goals, nominal, accelerations)

    def _plan(
        self, starts: FloatArray, goals: FloatArray, obstacles: FloatArray, duration: float
    ) -> JointPlan:
        """Plan with the certified margin, and where there is no such plan with the expected one."""
        radius, core = self.preset.agent_radius, self.preset.core
        scene: tuple[Any, ...] = (obstacles[:, :2], obstacles[:, 2], radius, core, duration)
        if self.certified is not None:
            settings = self.certified.settings
            room = settings.margins[0] + _GOAL_SPARE
            rests = resting_places(
                goals,
                obstacles[:, :2],
                obstacles[:, 2] + core + room,
                2.0 * radius + settings.pair_share * settings.margins[0] + _GOAL_SPARE,
            )
            moved = np.linalg.norm(rests - goals, axis=-1)
            # A goal within an obstacle is none that another place stands for.
            if np.all(moved <= settings.margins[0]):
                plan: JointPlan = self.certified.plan(starts, rests, *scene)
                if plan.solved:
                    return plan
        found: JointPlan = self.planner.plan(starts, goals, *scene)
        return found


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


class FirmCentralizedPolicy(CentralizedPolicy):
    """The same at twice the rate: worlds are proved under twice the bound, for more effort."""

    name = "centralized:firm"
    own_rate = 4.0


class EllipsoidCentralizedPolicy(CentralizedPolicy):
    """The same with the gain of the least invariant ellipsoid in the plane."""

    name = "centralized:ellipsoid"
    own_law = "ellipsoid"


class LeastNormCentralizedPolicy(CentralizedPolicy):
    """The same with Theorem 2's least-norm u* of the metric of least chi."""

    name = "centralized:least-norm"
    own_law = "least-norm"


class LqrPlanPolicy(CentralizedPolicy):
    """The same with a plain linear quadratic regulator: a baseline that knows no metric."""

    name = "lqr-plan"
    own_law = "lqr"


# The policies that differ from one another in the law alone.
CENTRALIZED = (
    CentralizedPolicy,
    FirmCentralizedPolicy,
    EllipsoidCentralizedPolicy,
    LeastNormCentralizedPolicy,
    LqrPlanPolicy,
)
