"""Modules of this package that have moved, from and to; see `lagros_envs.aliases`."""

_MOVED = {
    "cartpole": "tasks.cartpole.env",
    "cartpole_task": "tasks.cartpole.task",
    "cartpole_vector": "tasks.cartpole.vector",
    "dynamics.cartpole": "tasks.cartpole.physics",
    "dynamics.spacecraft": "tasks.spacecraft.physics",
    "rendering": "tasks.cartpole.draw",
    "spacecraft": "tasks.spacecraft.parallel",
    "spacecraft_episode": "tasks.spacecraft.episode",
    "spacecraft_rendering": "tasks.spacecraft.draw",
    "spacecraft_single": "tasks.spacecraft.single",
    "spacecraft_task": "tasks.spacecraft.task",
    "spacecraft_vector": "tasks.spacecraft.vector",
    "spacecraft_world": "tasks.spacecraft.world",
    "scenarios": "tasks.spacecraft.scenarios",
    "placement": "tasks.spacecraft.placement",
    "reachable": "tasks.spacecraft.reachable",
    "observation": "tasks.spacecraft.sensing",
}
MOVED = {f"lagros_envs.{old}": f"lagros_envs.{new}" for old, new in _MOVED.items()}
# Names that have left a module, and where they are now; a text stands for all of them.
NAMES = {
    "lagros_envs.dynamics": {
        "CartPole": "lagros_envs.tasks.cartpole.physics",
        "Spacecraft": "lagros_envs.tasks.spacecraft.physics",
    }
}
