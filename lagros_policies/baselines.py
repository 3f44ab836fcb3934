"""Baselines: LQR, random actions, the shipped PPO actor, and any stable-baselines3 model.

Every policy here follows stable-baselines3's `PolicyPredictor` protocol. Observations are those of
`lagros_envs.cartpole`, (13,) or (B, 13); actions are (1,) or (B, 1) float32, in units of
`CartPoleSettings.force_scale` [N].
"""

from __future__ import annotations

import importlib
import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lagros_envs import cartpole_task as task
from lagros_envs.dynamics import linearise_hold
from lagros_policies.imitation.networks import Mlp, read_safetensors, write_safetensors

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
Observes = Literal["local", "global"]

PRETRAINED_PPO = Path(__file__).parent / "pretrained" / "cartpole_ppo.safetensors"
ALGORITHMS = ("A2C", "DDPG", "PPO", "SAC", "TD3")

_PPO_FORMAT = "lagros-ppo-actor-1"


class LqrPolicy:
    """Linear-quadratic regulator about the upright goal: u = -K (x - x_f).

    K minimises the infinite sum of x'Qx + u'Ru for the exact linearisation, at the upright, of one
    control step with zero-order hold. The default weights follow Bryson's rule, one over the square
    of the largest acceptable value: for p `settings.goal_range` [m], for theta
    `settings.initial_angle` [rad], for the rates what crosses these ranges in one second, for u
    `settings.force_scale` [N] (1 where such a range is zero).

    Args:
        settings: The task; None for the paper's.
        state_weights: Diagonal of Q for [p, theta, dp/dt, dtheta/dt]; None for the rule.
        force_weight: R [1/N^2]; None for the rule.

    Raises:
        ValueError: Q is not four non-negative numbers with that of p positive, or R is not
            positive.
        ImportError: SciPy is not installed.

    Attributes:
        gain: K, shape (1, 4) [N per unit of the state].
    """

    observes: Observes = "local"

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        state_weights: Sequence[float] | None = None,
        force_weight: float | None = None,
    ) -> None:
        """Solve for the gain; see the class for the arguments."""
        try:
            from scipy.linalg import solve_discrete_are
        except ImportError as error:
            raise ImportError("LqrPolicy needs SciPy: pip install 'lagros[policies]'") from error
        self.name = "lqr"
        self.settings = settings or task.CartPoleSettings()
        if state_weights is None:
            ranges = [self.settings.goal_range or 1.0, self.settings.initial_angle or 1.0] * 2
            state_weights = [1.0 / (value * value) for value in ranges]
        if force_weight is None:
            force_weight = 1.0 / self.settings.force_scale**2
        diagonal = np.asarray(state_weights, dtype=np.float64)
        # Without a weight on p nothing brings the cart to its goal, and Riccati has no solution.
        fits = diagonal.shape == (task.STATE_DIM,) and bool(np.all(np.isfinite(diagonal)))
        if not (fits and np.all(diagonal >= 0.0) and diagonal[0] > 0.0):
            raise ValueError(
                f"state_weights={state_weights!r} must be {task.STATE_DIM} finite numbers >= 0, "
                "the first > 0"
            )
        if not (math.isfinite(force_weight) and force_weight > 0.0):
            raise ValueError(f"force_weight={force_weight!r} must be finite and > 0")
        _, transition, effect = linearise_hold(
            self.settings.system,
            np.zeros(task.STATE_DIM),
            np.zeros(1),
            self.settings.control_period,
        )
        weight = np.array([[force_weight]])
        cost = solve_discrete_are(transition, effect, np.diag(diagonal), weight)
        self.gain: FloatArray = np.linalg.solve(
            weight + effect.T @ cost @ effect, effect.T @ cost @ transition
        )
        self._action_gain = self.gain.T / self.settings.force_scale

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Return -K (x - x_f) as an action, and the state as it came; see the module."""
        observation = np.asarray(observation, dtype=np.float64)
        error = observation[..., task.GOAL] - observation[..., task.STATE]
        return (error @ self._action_gain).astype(np.float32), state


class RandomPolicy:
    """Actions uniform in [-1, 1], from the policy's own generator.

    `deterministic` changes nothing: the draws are reproducible through the seed.

    Args:
        settings: The task; None for the paper's. The policy does not look at it.
        seed: Seed of the generator.
    """

    observes: Observes = "local"

    def __init__(self, settings: task.CartPoleSettings | None = None, seed: int = 0) -> None:
        """Seed the generator; see the class for the arguments."""
        self.name = "random"
        self.settings = settings or task.CartPoleSettings()
        self._rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Draw one action per row of the observation, and return the state as it came."""
        shape = (*np.shape(observation)[:-1], 1)
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32), state


def goal_frame() -> FloatArray:
    """Return F (4, 13): [p - p_f, theta, dp/dt, dtheta/dt] = F o, what the PPO baseline sees."""
    matrix = np.zeros((task.STATE_DIM, task.OBSERVATION_DIM))
    matrix[:, task.STATE] = np.eye(task.STATE_DIM)
    matrix[0, task.GOAL.start] = -1.0
    return matrix


@dataclass(frozen=True)
class PpoActor:
    """The mean action of a PPO agent as plain arrays.

    action = clip(network(clip((F o - mean) / std, +-feature_clip)), +-action_clip).

    Attributes:
        network: The layers, tanh between them.
        features: F, shape (k, 13).
        mean: Mean of F o in the training, shape (k,).
        std: Standard deviation of F o in the training, shape (k,), positive.
        feature_clip: Bound on the normalised features.
        action_clip: Bound on the action, in the units of the training.
        force_scale: Force of the action 1.0 in the training [N].

    Raises:
        ValueError: The shapes do not fit together or a number is out of range.
    """

    network: Mlp
    features: Float32Array
    mean: Float32Array
    std: Float32Array
    feature_clip: float
    action_clip: float
    force_scale: float

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
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}={value!r} must be finite and > 0")

    def save(self, path: Path | str) -> None:
        """Write the actor as safetensors, atomically."""
        tensors = {"features": self.features, "mean": self.mean, "std": self.std}
        layers = zip(self.network.weights, self.network.biases, strict=True)
        for index, (weight, bias) in enumerate(layers):
            tensors[f"layer{index}.weight"] = weight
            tensors[f"layer{index}.bias"] = bias
        metadata = {
            "format": _PPO_FORMAT,
            "activation": "tanh",
            "feature_clip": repr(self.feature_clip),
            "action_clip": repr(self.action_clip),
            "force_scale": repr(self.force_scale),
        }
        write_safetensors(path, tensors, metadata)

    @classmethod
    def load(cls, path: Path | str) -> PpoActor:
        """Read an actor; nothing in the file is executed.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or not such an actor.
        """
        tensors, metadata = read_safetensors(path)
        if metadata.get("format") != _PPO_FORMAT or metadata.get("activation") != "tanh":
            raise ValueError(
                f"{path} is not a PPO actor of this package: its metadata say {metadata!r}"
            )
        layers = sum(name.endswith(".weight") for name in tensors)
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
            )
        except KeyError as error:
            raise ValueError(f"{path} lacks the entry {error}") from error
        except ValueError as error:
            raise ValueError(f"{path} is damaged: {error}") from error


class PpoPolicy:
    """The PPO baseline, in NumPy: neither torch nor a pickle is loaded.

    Trained by `python -m lagros_benchmarks.train_ppo`; the record of the training lies beside the
    weights, as JSON.

    Args:
        settings: The task; None for the paper's. Where its `force_scale` differs from that of the
            training, the action is rescaled so that the force stays the same.
        weights: A file written by `PpoActor.save`, or the actor itself; None for the shipped one.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged.

    Attributes:
        actor: The arrays.
    """

    observes: Observes = "local"

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        weights: Path | str | PpoActor | None = None,
    ) -> None:
        """Load the actor; see the class for the arguments."""
        self.name = "ppo"
        self.settings = settings or task.CartPoleSettings()
        if not isinstance(weights, PpoActor):
            weights = PpoActor.load(PRETRAINED_PPO if weights is None else weights)
        self.actor = weights
        self._network = weights.network
        self._features = np.ascontiguousarray(weights.features.T)
        self._mean, self._std = weights.mean, weights.std
        self._feature_clip = np.float32(weights.feature_clip)
        self._action_clip = np.float32(weights.action_clip)
        self._scale = np.float32(weights.force_scale / self.settings.force_scale)

    @classmethod
    def load(cls, path: Path | str, settings: task.CartPoleSettings | None = None) -> PpoPolicy:
        """Return the policy of a file written by `PpoActor.save`; raises as the class does."""
        return cls(settings, path)

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Return the mean action, and the state as it came; see the module."""
        features = np.asarray(observation, np.float32) @ self._features
        features -= self._mean
        features /= self._std
        bound = self._feature_clip
        np.minimum(np.maximum(features, -bound, out=features), bound, out=features)
        bound = self._action_clip
        action = np.minimum(np.maximum(self._network(features), -bound), bound)
        return action * self._scale, state


class StableBaselines3Policy:
    """A stable-baselines3 model with the interface and the checks of this package.

    Args:
        model: The model; its observation must be the 13 numbers of the cart-pole task, its action
            one number.
        name: Name in tables.

    Raises:
        ValueError: The model was trained on other spaces.
    """

    observes: Observes = "local"

    def __init__(self, model: Any, name: str) -> None:
        """Wrap the model; see the class for the arguments."""
        spaces = model.observation_space.shape, model.action_space.shape
        if spaces != ((task.OBSERVATION_DIM,), (1,)):
            raise ValueError(
                f"{name} was trained on observations of shape {spaces[0]} and actions of shape "
                f"{spaces[1]}; lagros/CartPole-v0 has ({task.OBSERVATION_DIM},) and (1,). A model "
                "that was trained behind wrappers cannot be used without them"
            )
        self.name = name
        self.model = model

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Return the model's action and state; see the module."""
        action, state = self.model.predict(
            np.asarray(observation, np.float32), state, episode_start, deterministic
        )
        return np.asarray(action, np.float32), state


def load_stable_baselines3(
    path: Path | str, algorithm: str | None = None
) -> StableBaselines3Policy:
    """Load a model saved by stable-baselines3's `model.save(path)`.

    Such a zip holds pickles, which is to say code: loading it runs whatever its author put there.
    This package loads one only where the caller names it, ships none, and unpickles nothing in
    order to find out the algorithm. Load only files that you trust.

    Args:
        path: The zip file.
        algorithm: One of `ALGORITHMS`, in any case; None to detect it.

    Returns:
        The policy, on the CPU, named after the file.

    Raises:
        FileNotFoundError: There is no such file.
        ImportError: The extra `rl` is not installed.
        ValueError: The file is no such model, its algorithm is unknown or cannot be detected, or
            its spaces are not those of the task.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no stable-baselines3 model {path}")
    chosen = detect_algorithm(path) if algorithm is None else algorithm.upper()
    if chosen not in ALGORITHMS:
        raise ValueError(f"algorithm {algorithm!r} is not known; use one of {_known()}")
    try:
        library = importlib.import_module("stable_baselines3")
    except ImportError as error:
        raise ImportError(
            f"{path} needs stable-baselines3: pip install 'lagros[rl]' (or 'lagros[all]')"
        ) from error
    try:
        model = getattr(library, chosen).load(path, device="cpu")
    except Exception as error:  # a pickle can raise anything
        raise ValueError(
            f"{path} could not be loaded as a {chosen} model of stable-baselines3 "
            f"{library.__version__} ({type(error).__name__}: {error})"
        ) from error
    return StableBaselines3Policy(model, path.stem)


def detect_algorithm(path: Path | str) -> str:
    """Tell the algorithm of a stable-baselines3 zip from its JSON part, unpickling nothing.

    The zip does not name its class. Its entry `data` is a JSON object of the model's attributes,
    and these differ: only PPO has a `clip_range`, only SAC a `target_entropy`, only TD3 and DDPG a
    `target_policy_noise`. A2C shares its policy class with PPO alone. DDPG is the TD3 without
    delay and without clipped noise.

    Args:
        path: The zip file.

    Returns:
        One of `ALGORITHMS`.

    Raises:
        ValueError: The file is no stable-baselines3 zip, or of another algorithm.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
    except (zipfile.BadZipFile, KeyError, ValueError, OSError) as error:
        raise ValueError(
            f"{path} is not a model saved by stable-baselines3: it has no readable entry 'data' "
            f"({error})"
        ) from error
    if not isinstance(data, dict):
        raise _unclear(path)
    kind = data.get("policy_class")
    module = kind.get("__module__", "") if isinstance(kind, dict) else ""
    if not str(module).startswith("stable_baselines3."):
        raise _unclear(path)  # of sb3_contrib, or a policy class of the user's own
    if "target_policy_noise" in data:
        plain = data.get("policy_delay") == 1 and data.get("target_noise_clip") == 0.0
        return "DDPG" if plain else "TD3"
    if "target_entropy" in data:
        return "SAC"
    if "clip_range" in data and "n_epochs" in data:
        return "PPO"
    if "gae_lambda" in data and "normalize_advantage" in data:
        return "A2C"
    raise _unclear(path)


def _unclear(path: Path | str) -> ValueError:
    return ValueError(
        f"{path} does not tell which algorithm it is of; say so with a prefix, e.g. ppo:{path} "
        f"(one of {_known()})"
    )


def _known() -> str:
    return ", ".join(name.lower() for name in ALGORITHMS)
