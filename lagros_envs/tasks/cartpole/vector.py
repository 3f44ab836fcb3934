"""The vectorised twin of `CartPoleEnv`."""

from __future__ import annotations

from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.vector import TaskVectorEnv


class CartPoleVectorEnv(TaskVectorEnv):
    """Worlds of `CartPoleEnv` side by side, see `TaskVectorEnv`."""

    task_name = "cartpole"
    settings: CartPoleSettings
