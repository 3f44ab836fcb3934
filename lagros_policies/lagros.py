"""Policy (c), LAG-ROS: a network that imitates the robust control u* (Theorem 1)."""

from __future__ import annotations

from lagros_policies.learning.network_policy import NetworkPolicy
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftNetworkPolicy


class LagrosPolicy(NetworkPolicy):
    """(x, o_l, t) -> u*: planner and tracking control in one evaluation."""

    name = recorded_as = "lagros"
    weights_file = "cartpole_lagros.safetensors"


class SpacecraftLagrosPolicy(SpacecraftNetworkPolicy):
    """o_l -> u* of each spacecraft from what it senses alone."""

    name = recorded_as = "lagros"
    weights_file = "spacecraft_lagros.safetensors"
