"""Rows, tables, figures and films of what was run."""

from lagros_envs.aliases import moved_names

moved_names(__name__)
