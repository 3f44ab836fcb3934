"""Settings that every test shares."""

import os

from hypothesis import settings

# No test opens a window, whoever starts pytest and however.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("MPLBACKEND", "Agg")

# The same examples on every run, and no clock: a shared machine may pause a test for a second.
settings.register_profile("lagros", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("lagros")
