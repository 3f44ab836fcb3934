"""Environments with bounded disturbance; importing this package registers their ids.

`gym.make("lagros/CartPole-v0")` and `gym.make_vec("lagros/CartPole-v0", num_envs=1024)`; the same
for "lagros/Spacecraft-v0", whose multi-agent form is `lagros_envs.spacecraft_v0.parallel_env()`.
"""

from gymnasium.envs.registration import register

__version__ = "0.1.0"

register(
    id="lagros/CartPole-v0",
    entry_point="lagros_envs.tasks.cartpole.env:CartPoleEnv",
    vector_entry_point="lagros_envs.tasks.cartpole.vector:CartPoleVectorEnv",
    max_episode_steps=90,  # of the default settings, as below; the environment itself truncates
)

register(
    id="lagros/Spacecraft-v0",
    entry_point="lagros_envs.tasks.spacecraft.single:SpacecraftEnv",
    vector_entry_point="lagros_envs.tasks.spacecraft.vector:SpacecraftVectorEnv",
    max_episode_steps=450,
)
