"""Policy (c), LAG-ROS: a network that imitates the robust control u* (Theorem 1)."""

from __future__ import annotations

from lagros_envs.aliases import moved_names
from lagros_policies.learning.network_policy import NetworkPolicy

moved_names(__name__)


class LagrosPolicy(NetworkPolicy):
    """(x, o_l, t) -> u*: planner and tracking control in one evaluation."""

    name = recorded_as = "lagros"
