"""Which spacecraft a policy is for: what its policies share of settings, preset and state."""

from __future__ import annotations

import math

from lagros_envs.scenarios import Preset, preset_named
from lagros_envs.spacecraft_task import SpacecraftSettings

# Position and velocity in the state: plans lie in the plane, at a heading that rests.
PLANE = [0, 1, 3, 4]
# Two agents err independently, so that their distance errs sqrt(2) times as far.
PAIR_SHARE = math.sqrt(2.0)


def task_and_preset(
    settings: SpacecraftSettings | None, preset: str | Preset, num_agents: int | None
) -> tuple[SpacecraftSettings, Preset]:
    """Return what the first three arguments of every policy of the spacecraft mean.

    Args:
        settings: The task; None for the paper's.
        preset: The preset, or its name.
        num_agents: Number of agents; None for the preset's own.

    Returns:
        The task, and the preset with that many agents.

    Raises:
        ValueError: There is no such preset, or the number of agents is less than 1.
    """
    return settings or SpacecraftSettings(), preset_named(preset).for_agents(num_agents)
