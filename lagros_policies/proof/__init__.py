"""Contraction proved on continuous sets: interval arithmetic, cells, and exact fractions."""
