"""Actors that reinforcement learning has trained, as plain arrays, and the policies that run them.

They run in NumPy: neither torch nor a pickle is loaded. `lagros train cartpole` writes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_positive, shown
from lagros_envs.conventions import settings_of
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import ANGLE, POSITION
from lagros_policies.learning.networks import Mlp, read_safetensors, write_safetensors
from lagros_policies.observed import cartpole_rows
from lagros_policies.policy import BasePolicy
from lagros_policies.trained_for import (
    KEYS,
    EpisodeRange,
    cartpole_range,
    check_trained_for,
    range_of,
)

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
Squash = Literal["clip", "tanh"]

PRETRAINED = Path(__file__).parent / "pretrained"
SQUASHES: tuple[Squash, ...] = ("clip", "tanh")

# Where the observation says what its episode asks for.
_GOAL, _START = task.GOAL.start + POSITION, task.INITIAL_STATE.start + POSITION
_LEAN = task.INITIAL_STATE.start + ANGLE
_FORMAT = "lagros-actor-1"
# Of files that are older than the choice of a squash: their actors clip.
_CLIPPED_FORMAT = "lagros-ppo-actor-1"


def goal_frame() -> FloatArray:
    """Return F (4, 13): [p - p_f, theta, dp/dt, dtheta/dt] = F o, what the actors see."""
    matrix = np.zeros((task.STATE_DIM, task.OBSERVATION_DIM))
    matrix[:, task.STATE] = np.eye(task.STATE_DIM)
    matrix[0, task.GOAL.start] = -1.0
    return matrix


@dataclass(frozen=True)
class Actor:
    """The mean action of an agent on the cart-pole as plain arrays.

    With z = network(clip((F o - mean) / std, +-feature_clip)) the action is clip(z, +-action_clip)
    or action_clip tanh(z).

    Attributes:
        network: The layers, tanh between them.
        features: F, shape (k, 13).
        mean: Mean of F o in the training, shape (k,).
        std: Standard deviation of F o in the training, shape (k,), positive.
        feature_clip: Bound on the normalised features.
        action_clip: Bound on the action, in the units of the training.
        force_scale: Force of the action 1.0 in the training [N].
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
    force_scale: float
    squash: Squash = "clip"
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check shapes and values."""
        count = self.network.inputs
        if self.network.outputs != 1 or self.features.shape != (count, task.OBSERVATION_DIM):
            raise ValueError(
                f"features {self.features.shape} and a network of {count} inputs and "
                f"{self.network.outputs} outputs do not map an observation of "
                f"{task.OBSERVATION_DIM} to one action"
            )
        for name in ("features", "mean", "std"):
            array = getattr(self, name)
            if not np.all(np.isfinite(array)) or (name != "features" and array.shape != (count,)):
                raise ValueError(f"{name} of shape {array.shape} must be finite, one per feature")
        if not np.all(self.std > 0.0):
            raise ValueError("std must be positive")
        for name in ("feature_clip", "action_clip", "force_scale"):
            check_positive(name, getattr(self, name))
        if self.squash not in SQUASHES:
            raise ValueError(f"squash={self.squash!r} must be one of {', '.join(SQUASHES)}")

    @property
    def largest_force(self) -> float:
        """The largest force that the actor can ask for [N]."""
        return self.action_clip * self.force_scale

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
            "force_scale": repr(self.force_scale),
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
                force_scale=float(metadata["force_scale"]),
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
        settings: The task; None for the paper's. Where its `force_scale` differs from that of the
            training, the action is rescaled so that the force stays the same.
        weights: A file written by `Actor.save`, or the actor itself; None for the shipped one.
        allow_other_settings: Fly settings too for which the actor was not trained.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, another policy's, or of a training for other settings.

    Attributes:
        actor: The arrays.
        recorded_as: The policy that the file must name; None takes any.
    """

    name = "actor"
    weights_file = ""
    recorded_as: str | None = None
    restricted = True  # `policy.make` tells it whether other settings are allowed

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        weights: Path | str | Actor | None = None,
        allow_other_settings: bool = False,
    ) -> None:
        """Load the actor; see the class for the arguments."""
        self.settings = settings_of(task.CartPoleSettings(), settings)
        file = PRETRAINED / self.weights_file if weights is None else weights
        self.actor = weights = file if isinstance(file, Actor) else Actor.load(file)
        what = "the actor" if isinstance(file, Actor) else str(file)
        assumed = cartpole_range(task.CartPoleSettings(), timed=False)
        check_trained_for(
            weights.metadata, what, self.recorded_as, self.settings, assumed, allow_other_settings
        )
        trained = range_of(weights.metadata, what, assumed)
        self._episodes = EpisodeRange.of(self.name, trained, allow_other_settings)
        self._network = weights.network
        self._features = np.ascontiguousarray(weights.features.T)
        self._mean, self._std = weights.mean, weights.std
        self._feature_clip = np.float32(weights.feature_clip)
        self._action_clip = np.float32(weights.action_clip)
        self._scale = np.float32(weights.force_scale / self.settings.force_scale)

    @classmethod
    def load(cls, path: Path | str, settings: task.CartPoleSettings | None = None) -> Self:
        """Return the policy of a file written by `Actor.save`; raises as the class does."""
        return cls(settings, path)

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Return the mean action and the state as it came; see `Policy.predict`.

        Raises:
            ValueError: The observation is not one of the task, not finite, or of an episode with a
                goal farther away or a start that leans more than in the training.
        """
        rows = cartpole_rows(observation, np.float32)
        self._episodes.check(rows[..., _GOAL] - rows[..., _START], rows[..., _LEAN])
        features = rows @ self._features
        features -= self._mean
        features /= self._std
        bound = self._feature_clip
        np.minimum(np.maximum(features, -bound, out=features), bound, out=features)
        bound = self._action_clip
        action = self._network(features)
        if self.actor.squash == "tanh":
            action = bound * np.tanh(action)
        else:
            action = np.minimum(np.maximum(action, -bound), bound)
        return action * self._scale, state


class PpoPolicy(ActorPolicy):
    """The actor of proximal policy optimisation."""

    name = recorded_as = "ppo"
    weights_file = "cartpole_ppo.safetensors"


class SacPolicy(ActorPolicy):
    """The mean action of soft actor-critic."""

    name = recorded_as = "sac"
    weights_file = "cartpole_sac.safetensors"


class Td3Policy(ActorPolicy):
    """The actor of twin delayed deep deterministic policy gradients."""

    name = recorded_as = "td3"
    weights_file = "cartpole_td3.safetensors"
