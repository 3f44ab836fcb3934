"""Reinforcement learning of our tasks: settings, resumable runs, lessons and learning curves."""
