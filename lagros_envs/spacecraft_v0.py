"""The multi-agent spacecraft environment, named as PettingZoo's environments are.

`parallel_env(num_agents=6, disturbance="uniform", disturbance_bound=0.4)` steps all agents at once;
`env(...)` steps one after the other. Both take the arguments of `SpacecraftParallelEnv`.
"""

from __future__ import annotations

from typing import Any, cast

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec

from lagros_envs.arrays import Float32Array
from lagros_envs.tasks.spacecraft.parallel import SpacecraftParallelEnv

__all__ = ["env", "parallel_env", "raw_env"]

parallel_env = SpacecraftParallelEnv


def env(**arguments: Any) -> AECEnv[str, Float32Array, Float32Array | None]:
    """Return the environment in PettingZoo's agent-environment-cycle form."""
    # The conversion asks for None as an action, which is how an agent that is done steps out.
    return parallel_to_aec(cast(Any, parallel_env(**arguments)))


raw_env = env
