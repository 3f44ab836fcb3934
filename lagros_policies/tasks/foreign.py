"""What policies are told of an environment of somebody else's, see `lagros_envs.foreign`."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np

from lagros_envs.arrays import BoolArray, Float32Array
from lagros_envs.foreign import Foreign
from lagros_policies.policy import BasePolicy
from lagros_policies.sb3_model import Spaces, limits

POLICIES = {"random": "lagros_policies.tasks.foreign:ForeignRandomPolicy"}
SPACES = "lagros_policies.tasks.foreign:spaces"


def spaces(task: Foreign) -> Spaces:
    """Return what a policy observes and answers."""
    facts = task.facts
    low, high = limits(facts.action_space)
    seen, done = facts.observation_space.shape, facts.action_space.shape
    assert seen is not None
    assert done is not None
    return Spaces(seen, done, low, f"{task.name} has", high)


class ForeignRandomPolicy(BasePolicy):
    """Samples of the action space, from the generator of the episode.

    Args:
        settings: The environment.
    """

    name = "random"

    def __init__(self, settings: Foreign) -> None:
        self._space = deepcopy(settings.facts.action_space)
        self.reseed(np.random.default_rng(0))

    def reseed(self, generator: np.random.Generator) -> None:
        """Draw from a generator."""
        self._space.seed(int(generator.integers(2**31)))

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Draw one action, whatever is observed."""
        return np.asarray(self._space.sample(), np.float32), state
