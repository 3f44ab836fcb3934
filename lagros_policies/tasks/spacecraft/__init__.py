"""What is special to the spacecraft: its policies, and what they are told of an environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Names of the policies, and where each is; imported when it is asked for.
POLICIES = {
    "learned": "lagros_policies.tasks.spacecraft.network_policy:SpacecraftLearnedPolicy",
    "tube-mpc": "lagros_policies.tasks.spacecraft.distributed:DistributedTubeMpcPolicy",
    "tube-mpc:least-norm": "lagros_policies.tasks.spacecraft.distributed:LeastNormTubeMpcPolicy",
    "lagros": "lagros_policies.tasks.spacecraft.network_policy:SpacecraftLagrosPolicy",
    "centralized": "lagros_policies.tasks.spacecraft.centralized:CentralizedPolicy",
    "centralized:firm": "lagros_policies.tasks.spacecraft.centralized:FirmCentralizedPolicy",
    "centralized:ellipsoid": (
        "lagros_policies.tasks.spacecraft.centralized:EllipsoidCentralizedPolicy"
    ),
    "centralized:least-norm": (
        "lagros_policies.tasks.spacecraft.centralized:LeastNormCentralizedPolicy"
    ),
    "lqr-plan": "lagros_policies.tasks.spacecraft.centralized:LqrPlanPolicy",
    "ppo": "lagros_policies.tasks.spacecraft.ppo:SpacecraftPpoPolicy",
}
SPACECRAFT_NAMES = tuple(POLICIES)  # the older name of `policy_names`
SPACES = "lagros_policies.tasks.spacecraft.setup:spaces"
# What takes one of them apart for `lagros export`.
EXPORT = "lagros_policies.tasks.spacecraft.export:exported"


def told(world: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a policy is built with besides the settings: the preset of its environment.

    Args:
        world: An environment of spacecraft.
        given: What the caller gives.

    Raises:
        ValueError: The caller gives another preset or number of agents.
    """
    from lagros_envs.tasks.spacecraft.scenarios import preset_named

    preset = preset_named(given.get("preset", world.preset))
    if preset.for_agents(given.get("num_agents")) != world.preset:
        what = "preset" if "preset" in given else "num_agents"
        raise ValueError(
            f"{what}: a policy takes those of the environment; make the environment with them, or "
            "build the class of the policy yourself"
        )
    return {"preset": world.preset, **given}
