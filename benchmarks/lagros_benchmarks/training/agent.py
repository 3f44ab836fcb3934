"""Agents of stable-baselines3 from our settings, and the network that is left of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv

from lagros_benchmarks.training.settings import Ppo, Sac, Training
from lagros_policies.learning.networks import Mlp


def make_agent(training: Training, venv: VecEnv) -> BaseAlgorithm:
    """Return the untrained agent of a training run in its worlds, one row for each agent."""
    algorithm = training.algorithm
    common: dict[str, Any] = {
        "learning_rate": algorithm.learning_rate,
        "batch_size": algorithm.batch_size,
        "gamma": algorithm.discount,
        "seed": training.seed,
        "device": "cpu",
    }
    network = {"net_arch": list(algorithm.hidden), "activation_fn": torch.nn.Tanh}
    if isinstance(algorithm, Ppo):
        return PPO(
            "MlpPolicy",
            venv,
            n_steps=algorithm.rollout_steps,
            n_epochs=algorithm.epochs,
            gae_lambda=algorithm.gae_decay,
            clip_range=algorithm.clip_range,
            policy_kwargs={**network, "log_std_init": algorithm.initial_log_std},
            **common,
        )
    common |= {
        "buffer_size": algorithm.buffer_size,
        "learning_starts": algorithm.warm_up,
        "tau": algorithm.averaging,
        "train_freq": 1,
        "gradient_steps": algorithm.gradient_steps,
        "policy_kwargs": network,
    }
    if isinstance(algorithm, Sac):
        weight = f"auto_{algorithm.initial_entropy_weight}"
        return SAC("MlpPolicy", venv, ent_coef=weight, **common)
    count = int(np.prod(venv.action_space.shape or ()))
    noise = NormalActionNoise(np.zeros(count), np.full(count, algorithm.action_noise))
    delay = algorithm.policy_delay
    return TD3("MlpPolicy", venv, action_noise=noise, policy_delay=delay, **common)


def actor_network(model: BaseAlgorithm) -> Mlp:
    """Return the network of the mean action, before it is clipped or squashed.

    Raises:
        ValueError: The model is no PPO, SAC or TD3, or its actor no plain network of tanh layers.
    """
    policy: Any = model.policy
    if getattr(model, "use_sde", False):
        raise ValueError("an agent with state-dependent exploration cannot be exported")
    if isinstance(model, PPO):
        if policy.squash_output:
            raise ValueError("a PPO agent with a squashed action cannot be exported")
        extractor, modules = policy.features_extractor, [*policy.mlp_extractor.policy_net]
        modules.append(policy.action_net)
    elif isinstance(model, SAC):
        extractor, modules = policy.actor.features_extractor, [*policy.actor.latent_pi]
        modules.append(policy.actor.mu)
    elif isinstance(model, TD3):
        # The last module is the tanh that squashes the action.
        extractor, modules = policy.actor.features_extractor, [*policy.actor.mu][:-1]
    else:
        raise ValueError(f"{type(model).__name__} is not one of PPO, SAC and TD3")
    layers, others = modules[::2], modules[1::2]
    plain = (
        not list(extractor.parameters())
        and all(isinstance(layer, torch.nn.Linear) for layer in layers)
        and all(isinstance(other, torch.nn.Tanh) for other in others)
    )
    if not plain:
        raise ValueError(f"only a plain network of tanh layers can be exported, not {policy}")
    return Mlp(
        [layer.weight.detach().numpy().T for layer in layers],
        [layer.bias.detach().numpy() for layer in layers],
    )
