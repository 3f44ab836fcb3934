"""Rows, tables, figures and films of what was run."""
