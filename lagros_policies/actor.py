"""Actors that reinforcement learning has trained, as plain arrays, and the policies that run them.

They run in NumPy: neither torch nor a pickle is loaded. `lagros train` writes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_positive, shown
from lagros_envs.task import Numbers, Task
from lagros_policies.learning.networks import Mlp, read_safetensors, write_safetensors
from lagros_policies.observed import observed_rows
from lagros_policies.policy import BasePolicy
from lagros_policies.room import found_file, task_of
from lagros_policies.trained_for import KEYS, check_weights

Squash = Literal["clip", "tanh"]

SQUASHES: tuple[Squash, ...] = ("clip", "tanh")

_FORMAT = "lagros-actor-1"
# Of files that are older than the choice of a squash: their actors clip.
_CLIPPED_FORMAT = "lagros-ppo-actor-1"
# Of the first task, whose control is a force.
_SCALE = "force_scale"


def goal_frame(task: Task) -> FloatArray:
    """Return F (k, o), what the actors of a task see: F o, of an observation o.

    It is the state, as its difference from the goal in those coordinates in which goals differ, and
    each disc from the position, with its radius.
    """
    n, layout = task.system.state_dim, task.layout
    matrix = np.zeros((n + 3 * task.most_discs, layout.size))
    matrix[:n, layout.state] = np.eye(n)
    for index in task.short_goal or range(n):
        matrix[index, layout.goal.start + index] = -1.0
    matrix[n:, layout.discs] = np.eye(3 * task.most_discs)
    for axis, index in enumerate(task.position):
        matrix[n + axis :: 3, index] = -1.0
    return matrix


@dataclass(frozen=True)
class Actor:
    """The mean action of an agent as plain arrays.

    With z = network(clip((F o - mean) / std, +-feature_clip)) the action is clip(z, +-action_clip)
    or action_clip tanh(z).

    Attributes:
        network: The layers, tanh between them.
        features: F, shape (k, o), of observations of o numbers.
        mean: Mean of F o in the training, shape (k,).
        std: Standard deviation of F o in the training, shape (k,), positive.
        feature_clip: Bound on the normalised features.
        action_clip: Bound on the action, in the units of the training.
        control_scale: Change of each control for the action 1 in the training, shape (m,).
        squash: How the action is bounded, "clip" or "tanh".
        metadata: What `trained_for.weights_record` says of it; stored beside the arrays.

    Raises:
        ValueError: The shapes do not fit together or a value is out of range.
    """

    network: Mlp
    features: Float32Array
    mean: Float32Array
    std: Float32Array
    feature_clip: float
    action_clip: float
    control_scale: Numbers
    squash: Squash = "clip"
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count, outputs = self.network.inputs, self.network.outputs
        fits = self.features.ndim == 2 and len(self.features) == count
        if not fits or len(self.control_scale) != outputs:
            raise ValueError(
                f"features {self.features.shape}, a network of {count} inputs and {outputs} "
                f"outputs and control_scale={self.control_scale!r} do not map an observation to an "
                "action"
            )
        for name in ("features", "mean", "std"):
            array = getattr(self, name)
            if not np.all(np.isfinite(array)) or (name != "features" and array.shape != (count,)):
                raise ValueError(f"{name} of shape {array.shape} must be finite, one per feature")
        if not np.all(self.std > 0.0):
            raise ValueError("std must be positive")
        for name in ("feature_clip", "action_clip"):
            check_positive(name, getattr(self, name))
        for scale in self.control_scale:
            check_positive("control_scale", scale)
        if self.squash not in SQUASHES:
            raise ValueError(f"squash={self.squash!r} must be one of {', '.join(SQUASHES)}")

    @property
    def largest_control(self) -> Numbers:
        """How far from the centre each control can be asked for, shape (m,)."""
        return tuple(self.action_clip * scale for scale in self.control_scale)

    def save(self, path: Path | str) -> None:
        """Write the actor as safetensors, atomically."""
        tensors = {"features": self.features, "mean": self.mean, "std": self.std}
        layers = zip(self.network.weights, self.network.biases, strict=True)
        for index, (weight, bias) in enumerate(layers):
            tensors[f"layer{index}.weight"] = weight
            tensors[f"layer{index}.bias"] = bias
        metadata = {
            **self.metadata,
            "format": _FORMAT,
            "activation": "tanh",
            "squash": self.squash,
            "feature_clip": repr(self.feature_clip),
            "action_clip": repr(self.action_clip),
            _SCALE: ",".join(map(repr, self.control_scale)),
        }
        write_safetensors(path, tensors, metadata)

    @classmethod
    def load(cls, path: Path | str) -> Actor:
        """Read an actor; nothing in the file is executed.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or not such an actor.
        """
        tensors, metadata = read_safetensors(path)
        known = metadata.get("format") in (_FORMAT, _CLIPPED_FORMAT)
        if not known or metadata.get("activation") != "tanh":
            raise ValueError(
                f"{path} is not an actor of this package: its metadata say {shown(metadata)}"
            )
        layers = sum(name.endswith(".weight") for name in tensors)
        squash: Any = "clip" if metadata["format"] == _CLIPPED_FORMAT else metadata.get("squash")
        try:
            return cls(
                network=Mlp(
                    [tensors[f"layer{index}.weight"] for index in range(layers)],
                    [tensors[f"layer{index}.bias"] for index in range(layers)],
                ),
                features=tensors["features"],
                mean=tensors["mean"],
                std=tensors["std"],
                feature_clip=float(metadata["feature_clip"]),
                action_clip=float(metadata["action_clip"]),
                control_scale=tuple(map(float, metadata[_SCALE].split(","))),
                squash=squash,
                metadata={name: metadata[name] for name in KEYS if name in metadata},
            )
        except KeyError as error:
            raise ValueError(f"{path} lacks the entry {error}") from error
        except ValueError as error:
            raise ValueError(f"{path} is damaged: {error}") from error


class ActorPolicy(BasePolicy):
    """An actor in the place of a controller.

    Args:
        settings: The task; None for the paper's. Where its `control_scale` differs from that of the
            training, the action is rescaled so that the control stays the same.
        weights: A file written by `Actor.save`, or the actor itself; None for the task's own.
        allow_other_settings: Fly settings too for which the actor was not trained.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, another policy's, of other observations, or of a training
            for other settings.

    Attributes:
        actor: The arrays.
    """

    name = "actor"
    restricted = True  # `policy.make` tells it whether other settings are allowed

    def __init__(
        self,
        settings: Task | None = None,
        weights: Path | str | Actor | None = None,
        allow_other_settings: bool = False,
    ) -> None:
        self.settings = task = task_of(settings)
        if weights is None:
            made = self.recorded_as or self.name
            options = "--residual BETA" if made == "residual" else f"--algo {made}"
            weights = found_file(task, f"{made}.safetensors", options)
        self.actor = actor = weights if isinstance(weights, Actor) else Actor.load(weights)
        what = "the actor" if isinstance(weights, Actor) else str(weights)
        self._check_episodes = check_weights(
            task, actor.metadata, what, self, False, allow_other_settings
        )
        sizes = actor.features.shape[1], actor.network.outputs
        self._size = task.layout.size
        if sizes != (self._size, task.system.control_dim):
            raise ValueError(
                f"{what} maps observations of {sizes[0]} numbers to actions of {sizes[1]}; those "
                f"of {task.name} have {self._size} and {task.system.control_dim}"
            )
        self._features = np.ascontiguousarray(actor.features.T)
        self._feature_clip = np.float32(actor.feature_clip)
        self._action_clip = np.float32(actor.action_clip)
        self._scale = np.divide(actor.control_scale, task.control_scale).astype(np.float32)

    @classmethod
    def load(cls, path: Path | str, settings: Task | None = None) -> Self:
        """Return the policy of a file written by `Actor.save`; raises as the class does."""
        return cls(settings, path)

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Return the mean action and the state as it came; see `Policy.predict`.

        Raises:
            ValueError: The observation is not one of the task, not finite, or of an episode unlike
                those of the training.
        """
        rows = observed_rows(observation, self._size, np.float32)
        self._check_episodes(rows)
        features = rows @ self._features
        features -= self.actor.mean
        features /= self.actor.std
        bound = self._feature_clip
        np.minimum(np.maximum(features, -bound, out=features), bound, out=features)
        bound = self._action_clip
        action = self.actor.network(features)
        if self.actor.squash == "tanh":
            action = bound * np.tanh(action)
        else:
            action = np.minimum(np.maximum(action, -bound), bound)
        return action * self._scale, state


class PpoPolicy(ActorPolicy):
    """The actor of proximal policy optimisation."""

    name = recorded_as = "ppo"


class SacPolicy(ActorPolicy):
    """The mean action of soft actor-critic."""

    name = recorded_as = "sac"


class Td3Policy(ActorPolicy):
    """The actor of twin delayed deep deterministic policy gradients."""

    name = recorded_as = "td3"
