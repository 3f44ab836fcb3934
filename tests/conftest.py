"""Settings that every test shares."""

import os

import gymnasium
import pytest
from hypothesis import settings

from lagros_envs import registry

# No test opens a window, whoever starts pytest and however.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("MPLBACKEND", "Agg")

# The same examples on every run, and no clock: a shared machine may pause a test for a second.
settings.register_profile("lagros", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("lagros")


@pytest.fixture(autouse=True)
def tasks_of_a_test_end_with_it():
    """Forget the tasks that a test registers: the next one may call its own the same."""
    known = [registry._FOUND, registry._FOREIGN, registry._CALLED, gymnasium.registry]
    before = [dict(one) for one in known]
    yield
    for one, entries in zip(known, before, strict=True):
        one.clear()
        one.update(entries)
