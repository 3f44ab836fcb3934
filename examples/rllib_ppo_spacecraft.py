"""PPO of Ray RLlib on the multi-agent spacecraft, through RLlib's PettingZoo wrapper.

    pip install "lagros[rllib]"
    python examples/rllib_ppo_spacecraft.py --updates 50

`ParallelPettingZooEnv` takes `spacecraft_v0.parallel_env()` as it is; every agent is mapped to one
policy, which all of them share. `--runners 4` lets four processes of the Ray cluster play.
"""

from __future__ import annotations

import argparse
import logging
from typing import Any

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from lagros_envs import spacecraft_v0

POLICY = "shared"


def make_env(settings: dict[str, Any]) -> ParallelPettingZooEnv:
    """Return the environment; RLlib calls this in each of its processes."""
    return ParallelPettingZooEnv(spacecraft_v0.parallel_env(**settings))


def train(
    updates: int = 50, agents: int = 3, cycles: int = 200, runners: int = 0, steps: int = 1000
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Train; return the weights before and after, and RLlib's reports on the episodes."""
    register_env("spacecraft_v0", make_env)
    config = (
        PPOConfig()
        .environment(
            "spacecraft_v0",
            env_config={
                "num_agents": agents,
                "preset": "open",
                "disturbance": "uniform",
                "disturbance_bound": 0.4,
                "max_cycles": cycles,
            },
        )
        .multi_agent(policies={POLICY}, policy_mapping_fn=lambda agent, *_, **__: POLICY)
        .env_runners(num_env_runners=runners)
        .training(
            train_batch_size_per_learner=steps,
            minibatch_size=min(250, steps),
            num_epochs=8,
            lr=3e-4,
            gamma=0.99,
            lambda_=0.95,
        )
        .debugging(seed=0)
    )
    algorithm = config.build_algo()
    weights = [algorithm.get_module(POLICY).get_state()]
    reports = []
    for update in range(1, updates + 1):
        report = algorithm.train()["env_runners"]
        reports.append(report)
        print(f"update {update}: return {report.get('episode_return_mean', float('nan')):.1f}")
    weights.append(algorithm.get_module(POLICY).get_state())
    algorithm.stop()
    return weights, reports


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("updates", 50), ("agents", 3), ("cycles", 200), ("runners", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    ray.init(include_dashboard=False, logging_level=logging.ERROR)
    train(**vars(parser.parse_args()))
