"""Environments with bounded disturbance; importing this package registers their ids.

`gym.make("lagros/TITLE-v0")` and `gym.make_vec("lagros/TITLE-v0", num_envs=1024)` for each task in
`lagros_envs.tasks`, and for a `Task` of your own after `register_task(task)`.
"""

from lagros_envs import aliases
from lagros_envs.foreign import Foreign, disturb
from lagros_envs.registry import find_task, register_env, register_task
from lagros_envs.task import Scenario, Task
from lagros_envs.tasks import SHIPPED
from lagros_envs.tasks.moved import MOVED

__version__ = "0.1.0"
__all__ = ["Foreign", "Scenario", "Task", "disturb", "find_task", "register_task"]

aliases.install(MOVED)
for _name, _shipped in SHIPPED.items():
    register_env(_name, _shipped)
