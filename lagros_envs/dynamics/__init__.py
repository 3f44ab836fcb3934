"""What follows from an equation of motion that is written once.

`integrate` holds a control over one step; `system` derives drift, control matrix, Jacobians and the
SDC matrix for any system; `check` tries a system of your own on every kind of number;
`straight_line`, `held` and `compiled` run a held step without the overhead of calling the two.
"""

from lagros_envs.aliases import moved_names
from lagros_envs.dynamics.check import check_system
from lagros_envs.dynamics.integrate import hold_control_slope, hold_step, linearise_hold
from lagros_envs.dynamics.system import (
    Components,
    Functions,
    System,
    control_matrix,
    jacobian,
    state_dependent_coefficient,
    vector_field,
)

moved_names(__name__)
__all__ = [
    "Components",
    "Functions",
    "System",
    "check_system",
    "control_matrix",
    "hold_control_slope",
    "hold_step",
    "jacobian",
    "linearise_hold",
    "state_dependent_coefficient",
    "vector_field",
]
