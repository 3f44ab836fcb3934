"""Target trajectories (x_d, u_d): sequential convex programming over sparse quadratic programs."""

from lagros_policies.planning.cartpole import CartPolePlanner, CartPolePlannerSettings
from lagros_policies.planning.scp import ScpSettings, ScpSolver
from lagros_policies.planning.trajectory import Trajectory

__all__ = [
    "CartPolePlanner",
    "CartPolePlannerSettings",
    "ScpSettings",
    "ScpSolver",
    "Trajectory",
]
