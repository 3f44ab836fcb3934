"""PPO of skrl on the vector form of `lagros/CartPole-v0`.

    pip install "lagros[skrl]"
    python examples/skrl_ppo_cartpole.py --updates 60

skrl's Gymnasium wrapper takes our vector environment as it is. The worlds start anew on the step
after the one in which they end (next-step autoreset, Gymnasium's default): skrl takes the value
beyond a time limit from the observation that came with it, which is then still of the old episode.
"""

from __future__ import annotations

import argparse

import gymnasium as gym
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from torch import nn

import lagros_envs  # noqa: F401  (registers the environments)

STEPS = 90  # control steps of each world between two updates; an episode has 90


def _network(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    )


class Policy(GaussianMixin, Model):
    """Mean of the action from a network, one spread for all observations."""

    def __init__(self, env) -> None:
        Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space)
        GaussianMixin.__init__(self)
        self.net = _network(self.num_observations, self.num_actions)
        # Small first actions, e^-2 of 40 N: from larger ones the pole is hardly ever up.
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -2.0))

    def compute(self, inputs, role=""):
        """Return the mean, and the spread under skrl's name."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """V(o)."""

    def __init__(self, env) -> None:
        Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space)
        DeterministicMixin.__init__(self)
        self.net = _network(self.num_observations, 1)

    def compute(self, inputs, role=""):
        """Return the value."""
        return self.net(inputs["observations"]), {}


def train(updates: int = 60, worlds: int = 64, seed: int = 0) -> tuple[Policy, list[float]]:
    """Train a policy and return it with the returns of the last finished episodes."""
    torch.manual_seed(seed)
    counted = RecordEpisodeStatistics(
        gym.make_vec("lagros/CartPole-v0", num_envs=worlds, disturbance="uniform"),
        buffer_length=1000,
    )
    # skrl resets without a seed, or with its own; this first one fixes the worlds that follow.
    counted.reset(seed=seed)
    env = wrap_env(counted, wrapper="gymnasium")
    models = {"policy": Policy(env), "value": Value(env)}
    settings = PPO_CFG(
        rollouts=STEPS,
        learning_epochs=10,
        mini_batches=4,
        discount_factor=0.99,
        gae_lambda=0.95,
        learning_rate=3e-4,
        value_loss_scale=0.5,
        time_limit_bootstrap=True,
        # No files; give a directory to have tensorboard's curves and checkpoints.
        experiment={"write_interval": 0, "checkpoint_interval": 0},
    )
    agent = PPO(
        models=models,
        memory=RandomMemory(memory_size=STEPS, num_envs=worlds, device=env.device),
        observation_space=env.observation_space,
        action_space=env.action_space,
        device=env.device,
        cfg=settings,
    )
    trainer = SequentialTrainer(
        env=env,
        agents=agent,
        cfg={
            "timesteps": updates * STEPS,
            "headless": True,
            "disable_progressbar": True,
            "close_environment_at_exit": False,
        },
    )
    trainer.train()
    returns = list(counted.return_queue)
    env.close()
    return models["policy"], returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("updates", 60), ("worlds", 64), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    _, last = train(**vars(parser.parse_args()))
    print(f"mean return of the last 100 episodes: {sum(last[-100:]) / len(last[-100:]):.1f}")
