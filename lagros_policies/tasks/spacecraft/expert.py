"""The expert that the learned spacecraft policies imitate: joint plans, tracked with u*.

At the start of an episode it is policy (d). Where a learner has strayed from the plan it plans
again from where the agents are, as (d) would, but in the tube: the plan may begin beside the
states, at a cost for the deviation, and keeps every margin from its first instant on. So u* around
it answers what the sensors show: a lost margin, a velocity that no plan would have, a goal near by.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields
from lagros_envs.tasks.spacecraft.scenarios import Scenario
from lagros_envs.tasks.spacecraft.task import STATE_DIM, SpacecraftSettings
from lagros_policies.planning.joint.planner import JointPlanner
from lagros_policies.tasks.spacecraft.centralized import planner_settings
from lagros_policies.tasks.spacecraft.pace import time_to_go
from lagros_policies.tasks.spacecraft.setup import PLANE, write_plan
from lagros_policies.tasks.spacecraft.wrench_control import WrenchTracking

# Beyond this the grid of the planner's guesses would grow without end [m].
SEARCH_RADIUS = 15.0
# Of the plans after the first.
_NODE_PERIOD = 1.0  # [s]
_EFFORT_TOLERANCE = 0.2


@dataclass(frozen=True)
class SpacecraftExpertSettings:
    """What the expert plans and how it tracks.

    Attributes:
        margin: Room beyond touching that plans ask for first [m].
        contraction_rate: alpha of u* in the plane [1/s].
        turning_rate: alpha of the heading [1/s].
        start_weight: Cost of a plan's deviation e from the state, as a share of e'Me / 2; small, so
            that a plan moves as it would like to and u* brings the agent there.
        side_preference: Share by which plans find going counter-clockwise around an obstacle
            cheaper. Labels that go left in one world and right in the next add up to nothing, and
            what imitates them comes to rest before the obstacle.

    Raises:
        ValueError: A value is not positive and finite.
    """

    margin: float = 0.3
    contraction_rate: float = 2.0
    turning_rate: float = 0.3
    start_weight: float = 0.5
    side_preference: float = 0.25

    def __post_init__(self) -> None:
        check_fields(self, positive=[item.name for item in fields(self)])


class SpacecraftExpert:
    """Plans of some worlds with the same number of agents, and u* around them.

    Args:
        scenarios: One per world.
        settings: What to plan and how to track.
        task: The task.
    """

    def __init__(
        self,
        scenarios: list[Scenario],
        settings: SpacecraftExpertSettings,
        task: SpacecraftSettings,
    ) -> None:
        self.scenarios, self.settings, self.task = scenarios, settings, task
        period = task.control_period
        self.tracking = WrenchTracking.for_rates(
            task.system, period, settings.contraction_rate, settings.turning_rate
        )
        first = planner_settings(task, settings.margin)
        first = replace(first, grid=replace(first.grid, preference=settings.side_preference))
        # What is followed for a few steps needs no fine grid, and a plan that does not come easily
        # is left to the next turn: other labels are cheaper.
        again = replace(
            first,
            nodes=round(task.horizon / _NODE_PERIOD),
            margins=first.margins[::2],
            restarts=1,
            searches=1,
            scp=replace(first.scp, effort_tolerance=_EFFORT_TOLERANCE),
        )
        self.planners = JointPlanner(first), JointPlanner(again)
        worlds, agents = len(scenarios), scenarios[0].num_agents
        self.nominal = np.zeros((worlds, task.steps + 1, agents, STATE_DIM))
        self.pushes = np.zeros((worlds, task.steps, agents, 3))
        self.plans = self.failed_plans = 0

    def plan(self, world: int, step: int, states: FloatArray) -> bool:
        """Plan one world from where its agents are, for the rest of the episode.

        Args:
            world: Which world.
            step: Control step; at 0 the plan begins at the states, later in the tube around them.
            states: x of its agents, shape (agents, 6).

        Returns:
            Whether there is a new plan; if not, the last one stays in force. None is looked for
            where an agent strayed further than `SEARCH_RADIUS` from its goal.
        """
        scenario, task, settings = self.scenarios[world], self.task, self.settings
        start_cost: FloatArray | None = None
        durations = np.full(len(states), task.horizon)
        planner = self.planners[0]
        self.plans += 1
        if step > 0:
            start_cost = settings.start_weight * self.tracking.plane.matrix
            way = np.linalg.norm(scenario.goals - states[:, :2], axis=1)
            if not np.all(way <= SEARCH_RADIUS):
                self.failed_plans += 1
                return False
            planner = self.planners[1]
            node = planner.settings.node_period
            time = time_to_go(way, task.horizon - step * task.control_period)
            durations = np.ceil(time / node - 1e-9) * node
        plan = planner.plan(
            states[:, PLANE],
            scenario.goals,
            scenario.obstacles,
            scenario.obstacle_radii,
            scenario.agent_radius,
            scenario.core,
            durations,
            start_cost,
        )
        if not plan.solved:
            self.failed_plans += 1
            return False
        headings, period = scenario.headings, task.control_period
        write_plan(plan, step, headings, period, self.nominal[world], self.pushes[world])
        return True

    def acceleration(self, step: int, states: FloatArray) -> FloatArray:
        """Return the acceleration of u*, shape (worlds, agents, 3) [m/s^2, m/s^2, rad/s^2].

        Args:
            step: Control step.
            states: x, shape (worlds, agents, 6).
        """
        return self.tracking.acceleration(states, self.nominal[:, step], self.pushes[:, step])

    def control(self, step: int, states: FloatArray) -> FloatArray:
        """Return u*, shape (worlds, agents, 8) [N]; arguments as of `acceleration`."""
        return self.tracking.control(states, self.nominal[:, step], self.pushes[:, step])
