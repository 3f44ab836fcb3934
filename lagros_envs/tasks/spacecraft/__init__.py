"""Spacecraft simulators in the plane, among discs and each other."""
