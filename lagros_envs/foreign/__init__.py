"""Environments of anybody's: bounded, paired, searchable disturbance, and what the commands need.

`disturb(env, "uniform", bound=0.5)` wraps an environment of Gymnasium or PettingZoo whose state can
be read and set; `Foreign` describes one to `lagros bench` and `lagros attack`.
"""

from lagros_envs.foreign.adapters import Adapter
from lagros_envs.foreign.task import Foreign
from lagros_envs.foreign.wrapper import Disturb, disturb

__all__ = ["Adapter", "Disturb", "Foreign", "disturb"]
