"""The tasks, a folder each; registration names them and nothing else does."""

from typing import NamedTuple


class Shipped(NamedTuple):
    """A task of this package, as module:attribute each; imported when it is asked for.

    Attributes:
        task: What gives the task with its default settings.
        title: As in `gym.make("lagros/TITLE-v0")`.
        steps: Control steps of an episode of the default settings, after which Gymnasium ends it;
            None where its worlds have limits of their own, which they keep by themselves.
        env: Its environment.
        vector: Its vector form.
    """

    task: str
    title: str
    steps: int | None
    env: str = "lagros_envs.env:TaskEnv"
    vector: str = "lagros_envs.vector:TaskVectorEnv"


SHIPPED = {
    "cartpole": Shipped(
        "lagros_envs.tasks.cartpole.task:CartPoleSettings",
        "CartPole",
        90,
        "lagros_envs.tasks.cartpole.env:CartPoleEnv",
        "lagros_envs.tasks.cartpole.vector:CartPoleVectorEnv",
    ),
    "spacecraft": Shipped(
        "lagros_envs.tasks.spacecraft.task:SpacecraftSettings",
        "Spacecraft",
        None,
        "lagros_envs.tasks.spacecraft.single:SpacecraftEnv",
        "lagros_envs.tasks.spacecraft.vector:SpacecraftVectorEnv",
    ),
    "docking": Shipped("lagros_envs.tasks.docking.task:DockingSettings", "Docking", 120),
    "segway": Shipped("lagros_envs.tasks.segway.task:SegwaySettings", "Segway", 60),
    "pvtol": Shipped("lagros_envs.tasks.pvtol.task:PvtolSettings", "Pvtol", 60),
    "car": Shipped("lagros_envs.tasks.car.task:CarSettings", "Car", 60),
    "quadrotor": Shipped("lagros_envs.tasks.quadrotor.task:QuadrotorSettings", "Quadrotor", 60),
    "quadrotor-10": Shipped(
        "lagros_envs.tasks.quadrotor.task:HeadingQuadrotorSettings", "Quadrotor10", 60
    ),
    "arm": Shipped("lagros_envs.tasks.arm.task:ArmSettings", "Arm", 40),
}
