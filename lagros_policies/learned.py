"""Policy (a): a network that imitates the planner's control u_d, without feedback of the error."""

from __future__ import annotations

from lagros_envs.aliases import moved_names
from lagros_policies.learning.network_policy import NetworkPolicy

moved_names(__name__)


class LearnedPolicy(NetworkPolicy):
    """(x, o_l, t) -> u_d, trained on the target trajectories alone (Lemma 1)."""

    name = recorded_as = "learned"
