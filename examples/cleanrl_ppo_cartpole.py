"""PPO in one file, in the style of CleanRL, on the vector form of `lagros/CartPole-v0`.

    pip install "lagros[train]"
    python examples/cleanrl_ppo_cartpole.py --updates 60

Nothing but Gymnasium and torch is between the loop below and the environment. Every update plays
`steps` control steps in all worlds at once; the worlds start anew in the step in which they end
(same-step autoreset) and hand over the last observation of the old episode in `info["final_obs"]`,
whose value stands for the rewards that the time limit cut off.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

import lagros_envs  # noqa: F401  (registers the environments)


@dataclass(frozen=True)
class Settings:
    """What is trained, and for how long."""

    updates: int = 60
    worlds: int = 64
    steps: int = 90  # control steps of each world between two updates; an episode has 90
    epochs: int = 10
    minibatches: int = 4
    learning_rate: float = 3e-4
    discount: float = 0.99
    trace: float = 0.95  # lambda of the generalised advantage estimate
    clip: float = 0.2
    value_weight: float = 0.5
    largest_gradient: float = 0.5
    seed: int = 0


class Agent(nn.Module):
    """Actor and critic."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.actor = self._network(inputs, outputs)
        self.critic = self._network(inputs, 1)
        # Small first actions, e^-2 of 40 N: from larger ones the pole is hardly ever up.
        self.log_std = nn.Parameter(torch.full((outputs,), -2.0))

    @staticmethod
    def _network(inputs: int, outputs: int) -> nn.Sequential:
        return nn.Sequential(
            nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
        )

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        """Return V(o), shape (...)."""
        return self.critic(observation).squeeze(-1)

    def distribution(self, observation: torch.Tensor) -> Normal:
        """Return the distribution of the action."""
        return Normal(self.actor(observation), self.log_std.exp())


def train(settings: Settings) -> tuple[Agent, list[float]]:
    """Train an agent and return it with the returns of the finished episodes, in their order."""
    torch.manual_seed(settings.seed)
    env = gym.make_vec(
        "lagros/CartPole-v0",
        num_envs=settings.worlds,
        disturbance="uniform",
        autoreset_mode="same_step",
    )
    agent = Agent(env.single_observation_space.shape[0], env.single_action_space.shape[0])
    optimiser = torch.optim.Adam(agent.parameters(), lr=settings.learning_rate, eps=1e-5)
    first, _ = env.reset(seed=settings.seed)
    observation = torch.from_numpy(first)
    running, returns = np.zeros(settings.worlds), []
    for update in range(1, settings.updates + 1):
        batch, observation = _play(env, agent, observation, settings, running, returns)
        _improve(agent, optimiser, batch, settings)
        if returns:
            print(
                f"update {update}: {len(returns)} episodes, last 100: {np.mean(returns[-100:]):.1f}"
            )
    env.close()
    return agent, returns


@torch.no_grad()
def _play(env, agent, observation, settings, running, returns):
    """Play `steps` control steps; return the samples, flat, and the observation to go on from."""
    shape = (settings.steps, settings.worlds)
    rewards, values, log_probs, going = (torch.zeros(shape) for _ in range(4))
    observations = torch.zeros(*shape, *env.single_observation_space.shape)
    actions = torch.zeros(*shape, *env.single_action_space.shape)
    for step in range(settings.steps):
        distribution = agent.distribution(observation)
        action = distribution.sample()
        observations[step], actions[step] = observation, action
        values[step] = agent.value(observation)
        log_probs[step] = distribution.log_prob(action).sum(-1)
        following, reward, terminated, truncated, info = env.step(action.numpy())
        ended = terminated | truncated
        running += reward
        returns.extend(running[ended].tolist())
        running[ended] = 0.0
        gained = torch.from_numpy(reward).float()
        cut = truncated & ~terminated
        if cut.any():
            last = torch.from_numpy(info["final_obs"][cut])
            gained[torch.from_numpy(cut)] += settings.discount * agent.value(last)
        rewards[step], going[step] = gained, torch.from_numpy(~ended).float()
        observation = torch.from_numpy(following)
    advantages = torch.zeros(shape)
    ahead, advantage = agent.value(observation), torch.zeros(settings.worlds)
    for step in reversed(range(settings.steps)):
        surprise = rewards[step] + settings.discount * going[step] * ahead - values[step]
        advantage = surprise + settings.discount * settings.trace * going[step] * advantage
        advantages[step], ahead = advantage, values[step]
    parts = (observations, actions, log_probs, advantages, advantages + values)
    return tuple(part.flatten(0, 1) for part in parts), observation


def _improve(agent, optimiser, batch, settings):
    """Take PPO's clipped gradient steps on the samples."""
    count = len(batch[0])
    for _ in range(settings.epochs):
        for part in torch.randperm(count).chunk(settings.minibatches):
            observation, action, log_prob, advantage, target = (each[part] for each in batch)
            distribution = agent.distribution(observation)
            ratio = (distribution.log_prob(action).sum(-1) - log_prob).exp()
            scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
            gain = torch.minimum(ratio * scaled, clipped * scaled).mean()
            miss = 0.5 * (agent.value(observation) - target).square().mean()
            optimiser.zero_grad()
            (settings.value_weight * miss - gain).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), settings.largest_gradient)
            optimiser.step()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for field in fields(Settings):
        parser.add_argument(
            f"--{field.name.replace('_', '-')}", type=type(field.default), default=field.default
        )
    train(Settings(**vars(parser.parse_args())))
