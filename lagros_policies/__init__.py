"""Contraction theory, planning, imitation, and one module per policy."""
