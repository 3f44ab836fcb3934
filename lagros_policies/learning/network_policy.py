"""A policy that is one evaluation of a network: the common body of (a) and (c)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.task import Task
from lagros_policies.learning.features import RecordedView, seen, view_of
from lagros_policies.learning.networks import Mlp
from lagros_policies.observed import observed_rows
from lagros_policies.policy import BasePolicy, PolicyState
from lagros_policies.room import found_file, task_of
from lagros_policies.trained_for import check_weights

Float32Array = NDArray[np.float32]


class NetworkPolicy(BasePolicy):
    """Maps (x, o_l, t) to the control by one evaluation of a network, without torch.

    Args:
        settings: The task; it fixes the unit of the action.
        weights: A safetensors file written by `Mlp.save`; the task's own if left out.
        allow_other_settings: Fly settings too for which the network was not trained.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, its network has other inputs, is another policy's, or was
            trained for other settings.

    Attributes:
        see: What the network sees of an observation, and the signs of its outputs.
    """

    restricted = True  # `policy.make` tells it whether other settings are allowed

    def __init__(
        self,
        settings: Task | Mapping[str, Any] | None = None,
        weights: Path | str | None = None,
        allow_other_settings: bool = False,
    ) -> None:
        """Load the network."""
        task = self.settings = task_of(settings)
        path = found_file(task, f"{self.name}.safetensors") if weights is None else weights
        self.see, self.network = view_of(task), Mlp.load(path)
        wanted = len(self.see.names), task.system.control_dim
        if (self.network.inputs, self.network.outputs) != wanted:
            raise ValueError(
                f"{path} has {self.network.inputs} inputs and {self.network.outputs} outputs; "
                f"a {task.name} network has {wanted[0]} and {wanted[1]}"
            )
        self._look = RecordedView(self.see, task.layout.size)
        self._check_episodes = check_weights(
            task, self.network.metadata, str(path), self, True, allow_other_settings
        )
        self._unit = (1.0 / np.array(task.control_scale)).astype(np.float32)
        centre = np.array(task.control_centre, np.float32)
        # Rounding has the last word where nothing is taken off.
        self._centre = centre if np.any(centre) else None

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Evaluate the network; see `Policy.predict`.

        Raises:
            ValueError: The observation is not one of the task, not finite, or of an episode unlike
                those of the training.
        """
        rows = observed_rows(observation, self.settings.layout.size, np.float32)
        self._check_episodes(rows)
        features, signs = seen(self._look, rows)
        control = self.network(features)
        if self._centre is not None:
            control = (control if signs is None else control * signs) - self._centre
            return control * self._unit, state
        return control * (self._unit if signs is None else signs * self._unit), state

    def bare_forward(self, features: Float32Array) -> Float32Array:
        """Evaluate the network alone, for timing: features (f,) to control (m,)."""
        return self.network(features)

    def example_features(self) -> Float32Array:
        """Return typical features, shape (f,)."""
        task = self.settings
        episode = task.sample(np.random.default_rng(0))
        row = np.zeros(task.layout.size, np.float32)
        row[task.layout.state] = row[task.layout.initial_state] = episode.initial_state
        row[task.layout.goal] = episode.goal
        discs = episode.discs.ravel()
        row[task.layout.discs][: len(discs)] = discs
        return seen(self.see, row)[0]
