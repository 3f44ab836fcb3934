"""The tasks, a folder each; registration names them and nothing else does."""

# Name of each shipped task, and where its settings are; imported when they are asked for.
SHIPPED = {
    "cartpole": "lagros_envs.tasks.cartpole.task:CartPoleSettings",
    "spacecraft": "lagros_envs.tasks.spacecraft.task:SpacecraftSettings",
}
