"""Policies behind one interface: contraction theory, planning, imitation and baselines."""

from lagros_policies.policy import NAMES, Policy, make

__all__ = ["NAMES", "Policy", "make"]
