"""What training runs with stable-baselines3's PPO share: settings, segments, checkpoints.

A run is cut into segments, each with random streams of its own and each followed by a checkpoint,
so that a run that was killed and started again ends with the same weights.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from lagros_policies.imitation.networks import Mlp

_LOG = logging.getLogger(__name__)
# Seed of the held-out episodes of the learning curve. They are not those of `lagros bench`, which
# have a namespace of their own.
CURVE_SEED = 910_001


@dataclass(frozen=True)
class PpoTraining:
    """Everything that a training run depends on, besides the task's physics.

    Attributes:
        seed: Seed of the run.
        segments: Number of segments: the budget is the product of the next three with it.
        rollouts: Rollouts, each followed by an update, in a segment.
        rollout_steps: Control steps of a rollout in every world.
        worlds: Worlds side by side.
        batch_size: Samples of one gradient step.
        epochs: Passes over a rollout.
        learning_rate: At the start; it falls linearly, by segments, to a tenth.
        discount: gamma per control step.
        gae_decay: lambda of the generalised advantage estimate.
        clip_range: Clip of the probability ratio.
        initial_log_std: Logarithm of the spread of the first actions. -2 is 5.4 N: the usual 0
            explores with 40 N, which makes every action costly and the pole fall at once.
        hidden: Widths of the hidden tanh layers, of actor and critic each.
        effort_weight: Replaces that of `CartPoleSettings` in training, where 0.01 makes for an
            agent that balances at twice the effort.
        disturbance: Kind of disturbance in training.
        disturbance_bound: Its bound d_bar.
        curve_episodes: Held-out episodes after every segment.
        final_episodes: Held-out episodes at the end, others than those of the curve.
    """

    seed: int = 0
    segments: int = 40
    rollouts: int = 20
    rollout_steps: int = 90
    worlds: int = 64
    batch_size: int = 1440
    epochs: int = 10
    learning_rate: float = 3e-4
    discount: float = 0.99
    gae_decay: float = 0.95
    clip_range: float = 0.2
    initial_log_std: float = -2.0
    hidden: tuple[int, ...] = (64, 64)
    effort_weight: float = 0.1
    disturbance: str = "uniform"
    disturbance_bound: float = 0.75
    curve_episodes: int = 500
    final_episodes: int = 2000

    @property
    def segment_steps(self) -> int:
        """Control steps of a segment, over all worlds."""
        return self.rollouts * self.rollout_steps * self.worlds


def agent(training: PpoTraining, normalised: VecNormalize) -> PPO:
    """Return the untrained agent of a training run."""
    return PPO(
        "MlpPolicy",
        normalised,
        n_steps=training.rollout_steps,
        batch_size=training.batch_size,
        n_epochs=training.epochs,
        learning_rate=training.learning_rate,
        gamma=training.discount,
        gae_lambda=training.gae_decay,
        clip_range=training.clip_range,
        policy_kwargs={
            "net_arch": list(training.hidden),
            "activation_fn": torch.nn.Tanh,
            "log_std_init": training.initial_log_std,
        },
        seed=training.seed,
        device="cpu",
    )


def actor_network(model: PPO) -> Mlp:
    """Return the network that gives the mean action, before any clipping.

    Raises:
        ValueError: The policy is not a plain network of tanh layers.
    """
    policy: Any = model.policy
    hidden = list(policy.mlp_extractor.policy_net)
    linear, other = hidden[::2], hidden[1::2]
    plain = (
        not list(policy.features_extractor.parameters())
        and all(isinstance(layer, torch.nn.Linear) for layer in linear)
        and all(isinstance(layer, torch.nn.Tanh) for layer in other)
    )
    if not plain:
        raise ValueError(f"only a plain network of tanh layers can be exported, not {policy}")
    if model.use_sde or policy.squash_output:
        raise ValueError("an agent with state-dependent exploration cannot be exported")
    layers = [*linear, policy.action_net]
    return Mlp(
        [layer.weight.detach().numpy().T for layer in layers],
        [layer.bias.detach().numpy() for layer in layers],
    )


def run_segments(
    training: PpoTraining,
    model: PPO,
    normalised: VecNormalize,
    checkpoint: Path,
    figures: Callable[[], dict[str, float]],
) -> list[dict[str, float]]:
    """Train segment by segment, each followed by a checkpoint, or go on from the last one.

    Args:
        training: The run.
        model: The agent, untrained.
        normalised: What it looks through.
        checkpoint: The state of the run.
        figures: Evaluates the agent as it is now.

    Returns:
        The learning curve: steps, seconds and figures after every segment.

    Raises:
        ValueError: The checkpoint is damaged or belongs to another run.
    """
    curve: list[dict[str, float]] = []
    if checkpoint.exists():
        curve = _restore(checkpoint, training, model, normalised)
        _LOG.info("going on after segment %d of %d", len(curve), training.segments)
    for segment in range(len(curve), training.segments):
        begun = time.perf_counter()
        _learn_segment(model, normalised, training, segment)
        reached = rounded(figures())
        seconds = time.perf_counter() - begun + (curve[-1]["seconds"] if curve else 0.0)
        steps = (segment + 1) * training.segment_steps
        curve.append({"steps": steps, "seconds": round(seconds, 1), **reached})
        _save(checkpoint, training, model, normalised, curve)
        _LOG.info("%s", json.dumps(curve[-1]))
    return curve


def _learn_segment(
    model: PPO, normalised: VecNormalize, training: PpoTraining, segment: int
) -> None:
    # Fresh episodes and fresh streams: nothing but the checkpoint is carried over.
    words = np.random.SeedSequence(training.seed, spawn_key=(segment,)).generate_state(1)
    model.set_env(normalised, force_reset=True)
    model.set_random_seed(int(words[0]))
    rate = training.learning_rate * (1.0 - 0.9 * segment / training.segments)
    model.lr_schedule = lambda _: rate
    model.learn(training.segment_steps, reset_num_timesteps=False)


def _statistics(normalised: VecNormalize) -> dict[str, Any]:
    features = {"features": normalised.obs_rms} if normalised.norm_obs else {}
    return {**features, "returns": normalised.ret_rms}


def _state(training: PpoTraining) -> str:
    return json.dumps(asdict(training), sort_keys=True)


def _save(
    path: Path,
    training: PpoTraining,
    model: PPO,
    normalised: VecNormalize,
    curve: list[dict[str, float]],
) -> None:
    statistics = {
        name: [torch.as_tensor(np.float64(value)) for value in (rms.mean, rms.var, rms.count)]
        for name, rms in _statistics(normalised).items()
    }
    content = {
        "training": _state(training),
        "policy": model.policy.state_dict(),
        "optimizer": model.policy.optimizer.state_dict(),
        "statistics": statistics,
        "timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "curve": curve,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    torch.save(content, temporary)
    os.replace(temporary, path)


def _restore(
    path: Path, training: PpoTraining, model: PPO, normalised: VecNormalize
) -> list[dict[str, float]]:
    try:
        content = torch.load(path, weights_only=True)  # tensors and plain values: no pickled code
        stored = content["training"]
    except Exception as error:
        raise ValueError(f"the checkpoint {path} is damaged ({error}); delete it") from error
    if stored != _state(training):
        raise ValueError(
            f"the checkpoint {path} belongs to another run ({stored}); delete it, or give "
            "--checkpoint another path"
        )
    model.policy.load_state_dict(content["policy"])
    model.policy.optimizer.load_state_dict(content["optimizer"])
    for name, rms in _statistics(normalised).items():
        mean, var, count = content["statistics"][name]
        rms.mean, rms.var, rms.count = mean.numpy(), var.numpy(), float(count)
    model.num_timesteps = content["timesteps"]
    model._n_updates = content["updates"]
    curve: list[dict[str, float]] = content["curve"]
    return curve


def rounded(figures: dict[str, float]) -> dict[str, float]:
    """Return figures as they are written down, to four decimals."""
    return {key: round(value, 4) for key, value in figures.items()}


def versions() -> dict[str, str]:
    """Return the versions of what a training run depends on."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "gymnasium": gymnasium.__version__,
        "stable_baselines3": stable_baselines3.__version__,
        "torch": torch.__version__,
    }
