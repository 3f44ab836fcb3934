"""Target trajectories (x_d, u_d): sequential convex programming over sparse quadratic programs."""

from lagros_policies.planning.guess import PlannerSettings, plan_trajectory
from lagros_policies.planning.problem import Discs, Problem
from lagros_policies.planning.scp import ScpSettings, solve_scp
from lagros_policies.planning.trajectory import Trajectory
from lagros_policies.tasks.cartpole.planner import CartPolePlanner, CartPolePlannerSettings

__all__ = [
    "CartPolePlanner",
    "CartPolePlannerSettings",
    "Discs",
    "PlannerSettings",
    "Problem",
    "ScpSettings",
    "Trajectory",
    "plan_trajectory",
    "solve_scp",
]
