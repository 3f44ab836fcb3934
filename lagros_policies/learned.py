"""Policy (a): networks that imitate the planner's control u_d, without u* around a plan."""

from __future__ import annotations

from lagros_envs.aliases import moved_names
from lagros_policies.learning.network_policy import NetworkPolicy

moved_names(__name__)


class LearnedPolicy(NetworkPolicy):
    """(x, o_l, t) -> u_d, trained on the target trajectories alone (Lemma 1)."""

    name = recorded_as = "learned"


class LearnedMpcPolicy(NetworkPolicy):
    """(x, o_l, t) -> u_d, trained on plans from wherever flights come to, its own among them.

    Policy (a) with the data and the care of (c). It imitates model predictive control that plans
    from the measured state: no target trajectory is tracked, and no tube is about it.
    """

    name = recorded_as = "learned-mpc"
