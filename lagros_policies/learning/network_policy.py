"""A policy that is one evaluation of a network: the common body of (a) and (c)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lagros_envs.conventions import settings_of
from lagros_envs.tasks.cartpole import task
from lagros_policies.learning.features import See
from lagros_policies.learning.networks import Mlp
from lagros_policies.observed import observed_rows
from lagros_policies.policy import BasePolicy, PolicyState
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.cartpole.features import FEATURES, cartpole_features, see
from lagros_policies.trained_for import check_weights

Float32Array = NDArray[np.float32]


class NetworkPolicy(BasePolicy):
    """Maps (x, o_l, t) to a force by one evaluation of a network, without torch.

    Args:
        settings: The task; it fixes the unit of the action.
        weights: A safetensors file written by `Mlp.save`; the shipped one if left out.
        allow_other_settings: Fly settings too for which the network was not trained.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, its network has other inputs, is another policy's, or was
            trained for other settings.

    Attributes:
        see: What the network sees of an observation, and the signs of its outputs.
    """

    see: ClassVar[See] = staticmethod(see)
    name: str
    weights_file: str
    restricted = True  # `policy.make` tells it whether other settings are allowed

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        weights: Path | str | None = None,
        allow_other_settings: bool = False,
    ) -> None:
        """Load the network."""
        self.settings = settings_of(task.CartPoleSettings(), settings)
        path = PRETRAINED / self.weights_file if weights is None else weights
        self.network = Mlp.load(path)
        if self.network.inputs != len(FEATURES) or self.network.outputs != 1:
            raise ValueError(
                f"{path} has {self.network.inputs} inputs and {self.network.outputs} outputs; "
                f"a cart-pole network has {len(FEATURES)} and 1"
            )
        self._check_episodes = check_weights(
            self.settings, self.network.metadata, str(path), self, True, allow_other_settings
        )
        self._unit = np.float32(1.0 / self.settings.force_scale)

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Evaluate the network; see `Policy.predict`.

        Raises:
            ValueError: The observation is not one of the task, not finite, or of an episode with a
                goal farther away or a start that leans more than in the training.
        """
        rows = observed_rows(observation, task.OBSERVATION_DIM, np.float32)
        self._check_episodes(rows)
        features, side = cartpole_features(rows)
        force = self.network(features)
        return force * (side[..., None] * self._unit), state

    def bare_forward(self, features: Float32Array) -> Float32Array:
        """Evaluate the network alone, for timing: features (7,) to force (1,) [N]."""
        return self.network(features)

    def example_features(self) -> Float32Array:
        """Return typical features, shape (7,)."""
        return np.array([-2.0, 0.5, 1.0, -0.5, 3.0, 0.8, 0.5], np.float32)
