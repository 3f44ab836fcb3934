"""The safety filter: the nearest action that keeps every agent clear of what it senses."""

from lagros_policies.safety.filter import SafetyFilter

__all__ = ["SafetyFilter"]
