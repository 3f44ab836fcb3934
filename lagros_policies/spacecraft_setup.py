"""Which spacecraft a policy is for: the settings, preset and number of agents that all take."""

from __future__ import annotations

from lagros_envs.scenarios import Preset, preset_named
from lagros_envs.spacecraft_task import SpacecraftSettings


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
