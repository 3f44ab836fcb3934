"""Docking: a chaser that approaches a target on a circular orbit."""
