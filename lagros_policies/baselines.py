"""Baselines: LQR, random actions, the shipped PPO actor, and any stable-baselines3 model.

Every policy here follows stable-baselines3's `PolicyPredictor` protocol. Observations are those of
`lagros_envs.cartpole`, (13,) or (B, 13); actions are (1,) or (B, 1), in units of
`CartPoleSettings.force_scale` [N].
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lagros_envs import cartpole_task as task

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
Observes = Literal["local", "global"]

PRETRAINED_PPO = Path(__file__).parent / "pretrained" / "cartpole_ppo.safetensors"
PPO_FORMAT = "lagros-ppo-actor-1"

# What the PPO baseline looks at: [p - p_f, theta, dp/dt, dtheta/dt, t], linear in the observation.
GOAL_FRAME: FloatArray = np.zeros((5, task.OBSERVATION_DIM))
GOAL_FRAME[:4, task.STATE] = np.eye(4)
GOAL_FRAME[0, task.GOAL.start] = -1.0
GOAL_FRAME[4, task.TIME] = 1.0
GOAL_FRAME.flags.writeable = False


class LqrPolicy:
    """Linear-quadratic regulator about the upright goal: u = -K (x - x_f).

    K minimises the infinite sum of x'Qx + u'Ru for the exact linearisation at the upright of the
    control step with zero-order hold. The weights follow Bryson's rule, one over the square of the
    largest acceptable value: `settings.goal_range` for p [m], `settings.initial_angle` for theta
    [rad], `force_scale` for u [N], and for the rates what crosses those ranges in one second.

    Args:
        settings: The task.
        state_weights: Diagonal of Q for [p, theta, dp/dt, dtheta/dt]; None for the rule.
        force_weight: R [1/N^2]; None for the rule.

    Raises:
        ValueError: The weights are not non-negative (R: positive) or have a wrong shape.
        ImportError: SciPy is not installed.

    Attributes:
        gain: K, shape (1, 4) [N per unit of the state].
    """

    name = "lqr"
    observes: Observes = "local"

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        state_weights: FloatArray | None = None,
        force_weight: float | None = None,
    ) -> None:
        """Solve for the gain; see the class for the arguments."""
        self.settings = settings or task.CartPoleSettings()


class PpoPolicy:
    """The actor of a PPO agent, as plain matrices: a mean action without torch.

    action = clip(network((F o - mean) / std clipped to +-c), +-a), hidden layers tanh. The action
    is rescaled if the task has another `force_scale` than the one of the training.

    Args:
        weights: Matrices of the layers, each (outputs, inputs) as in torch.
        biases: Biases of the layers.
        features: F, from the observation to the features, shape (k, 13).
        mean: Mean of the features in the training, shape (k,).
        std: Their standard deviation, shape (k,).
        feature_clip: c, normalised features are clipped to plus or minus this.
        action_clip: a, in the action units of the training.
        force_scale: Force of the action 1.0 in the training [N].
        settings: The task to act in.
        name: Name in tables.
    """

    observes: Observes = "local"

    def __init__(
        self,
        weights: list[NDArray[Any]],
        biases: list[NDArray[Any]],
        features: NDArray[Any],
        mean: NDArray[Any],
        std: NDArray[Any],
        feature_clip: float,
        action_clip: float,
        force_scale: float,
        settings: task.CartPoleSettings | None = None,
        name: str = "ppo",
    ) -> None:
        """Store the actor; see the class for the arguments."""
        self.name = name
        self.settings = settings or task.CartPoleSettings()
        self._weights = [np.asarray(w, np.float32).T.copy() for w in weights]
        self._biases = [np.asarray(b, np.float32) for b in biases]
        self._features = np.asarray(features, np.float32).T.copy()
        self._mean = np.asarray(mean, np.float32)
        self._std = np.asarray(std, np.float32)
        self._feature_clip = np.float32(feature_clip)
        self._action_clip = np.float32(action_clip)
        self._action_scale = np.float32(force_scale / self.settings.force_scale)

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        x = np.asarray(observation, np.float32) @ self._features
        c = self._feature_clip
        x = np.minimum(np.maximum((x - self._mean) / self._std, -c), c)
        for w, b in zip(self._weights[:-1], self._biases[:-1], strict=True):
            x = np.tanh(x @ w + b)
        x = x @ self._weights[-1] + self._biases[-1]
        a = self._action_clip
        return np.minimum(np.maximum(x, -a), a) * self._action_scale, state
