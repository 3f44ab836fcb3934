"""Policies behind one interface: contraction theory, planning, imitation and baselines."""

from lagros_envs import aliases
from lagros_policies.policy import NAMES, Policy, make
from lagros_policies.tasks.moved import MOVED

__all__ = ["NAMES", "Policy", "make"]

aliases.install(MOVED)
