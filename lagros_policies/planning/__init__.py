"""Target trajectories (x_d, u_d): sequential convex programming over sparse quadratic programs."""

from lagros_envs.aliases import moved_names
from lagros_policies.planning.guess import PlannerSettings, plan_trajectory
from lagros_policies.planning.problem import Discs, Problem
from lagros_policies.planning.scp import ScpSettings, solve_scp
from lagros_policies.planning.trajectory import Trajectory

__all__ = [
    "Discs",
    "PlannerSettings",
    "Problem",
    "ScpSettings",
    "Trajectory",
    "plan_trajectory",
    "solve_scp",
]

moved_names(__name__)
