"""Policy (c), LAG-ROS: a network that imitates the robust control u* (Theorem 1)."""

from __future__ import annotations

from lagros_policies.imitation.network_policy import NetworkPolicy


class LagrosPolicy(NetworkPolicy):
    """(x, o_l, t) -> u*: planner and tracking control in one evaluation."""

    name = "lagros"
    weights_file = "cartpole_lagros.safetensors"
