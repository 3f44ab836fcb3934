"""PPO on Gymnasium's pendulum, trained calm and under disturbance, for `lagros bench` and `attack`.

    python examples/disturbed_pendulum.py runs/pendulum
    lagros bench gym:Pendulum-v1 --policies runs/pendulum/calm.zip,runs/pendulum/disturbed.zip \
        --disturbance none,uniform,constant,switching --bound 1 --episodes 50
    lagros attack gym:Pendulum-v1 --policy runs/pendulum/calm.zip --bound 1

Needs stable-baselines3 (`pip install "lagros[rl]"`), and some minutes. Settings of PPO as in
RL Baselines3 Zoo for this environment.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from lagros_envs import disturb

BOUND = 1.0  # d̄, in rad/s and rad/s²
# A constant push of another direction in every episode.
TRAINED_UNDER = "constant"


def pendulum(bound: float) -> gym.Env[Any, Any]:
    """Return the pendulum under disturbance."""
    env: gym.Env[Any, Any] = disturb(gym.make("Pendulum-v1"), TRAINED_UNDER, bound=bound)
    return env


def train(bound: float, steps: int, seed: int) -> PPO:
    """Return PPO trained for so many steps."""
    model = PPO(
        "MlpPolicy",
        make_vec_env(partial(pendulum, bound), n_envs=4, seed=seed),
        n_steps=1024,
        gamma=0.9,
        learning_rate=1e-3,
        use_sde=True,
        sde_sample_freq=4,
        seed=seed,
        device="cpu",
    )
    return model.learn(steps)


def main() -> None:
    """Train both and save them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=_Lines)
    parser.add_argument("folder", type=Path, help="where calm.zip and disturbed.zip go")
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for name, bound in (("calm", 0.0), ("disturbed", BOUND)):
        path = options.folder / name
        train(bound, options.steps, options.seed).save(path)
        print(f"wrote {path}.zip")


_Lines = argparse.RawDescriptionHelpFormatter

if __name__ == "__main__":
    main()
