"""What a joint plan and its tube guarantee of one world, whatever the disturbance does.

The environment looks for collisions along the straight pieces between the ends of its substeps, and
counts as contact how far a path may leave them. So a world is free of collisions if, on every
piece, the plan's own straight piece keeps the two bounds of the error and that bulge; the true path
lies within it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.scenarios import Scenario
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.world import SUBSTEPS
from lagros_policies.planning.joint.plan import swept_distances
from lagros_policies.tasks.spacecraft.gain_control import GainTracking
from lagros_policies.tasks.spacecraft.world_tube import Planned, WorldTube

# Above what doubles lose in a distance of an arena [m].
_ROUNDING = 1e-9


@dataclass(frozen=True)
class WorldGuarantee:
    """What is proved of one world, for its whole episode and every disturbance of norm <= d_bar.

    Attributes:
        clearance: Least room that is left between bodies after all bounds [m]; not proved to be
            free of collisions where it is not positive.
        arrival: Bound of every agent's distance from its goal at the instant where it is least,
            shape (n,) [m].
        at_end: Likewise at the end of the episode, shape (n,) [m].
        position_error: Bound of ||p - p_d|| of any agent at any time [m].
        collision_free: Whether no agent touches anything until the time limit.
        arriving: Whether every agent comes within the goal radius, too.
    """

    clearance: float
    arrival: FloatArray
    at_end: FloatArray
    position_error: float
    collision_free: bool
    arriving: bool


def guarantee(
    scenario: Scenario,
    settings: SpacecraftSettings,
    tracking: GainTracking,
    nominal: FloatArray,
    accelerations: FloatArray,
    disturbance_bound: float,
) -> WorldGuarantee:
    """Return what is proved of a world whose agents track a joint plan with a gain.

    Args:
        scenario: The world.
        settings: The task; its thrusters have no limit.
        tracking: The law.
        nominal: x_d at the control instants of the episode, shape (steps + 1, n, 6).
        accelerations: Of x, y and heading under u_d, shape (steps, n, 3).
        disturbance_bound: d_bar, in units of the state per second.

    Raises:
        ValueError: The thrusters have a limit, or the bound is out of range.
    """
    if settings.thrust_limit is not None:
        raise ValueError(
            f"thrust_limit={settings.thrust_limit!r}: nothing is proved of thrusters that saturate"
        )
    planned = Planned.of(nominal, accelerations, settings.control_period)
    tube = tracking.tube(planned, disturbance_bound, len(accelerations))
    clearance = _clearance(scenario, settings, tube, nominal, accelerations, disturbance_bound)
    off = np.linalg.norm(nominal[..., :2] - scenario.goals, axis=-1) + tube.instants.T + _ROUNDING
    free, arrival = clearance > 0.0, off[1:].min(axis=0)
    return WorldGuarantee(
        clearance,
        arrival,
        off[-1],
        tube.largest,
        free,
        free and bool(np.all(arrival <= settings.goal_radius)),
    )


def _clearance(
    scenario: Scenario,
    settings: SpacecraftSettings,
    tube: WorldTube,
    nominal: FloatArray,
    accelerations: FloatArray,
    bound: float,
) -> float:
    """Return the least room between bodies after the bounds of the errors [m]."""
    step = settings.control_period / SUBSTEPS
    # The plan at the ends of the substeps, (n, steps * SUBSTEPS + 1, 2), and the bounds there.
    time = (step * np.arange(SUBSTEPS))[:, None, None]
    place, speed = nominal[:-1, None, :, :2], nominal[:-1, None, :, 3:5]
    inner = place + time * speed + 0.5 * time**2 * accelerations[:, None, :, :2]
    count = nominal.shape[1]
    path = np.concatenate([inner.reshape(-1, count, 2), nominal[-1:, :, :2]]).transpose(1, 0, 2)
    held = np.concatenate([tube.instants[:, :-1, None], tube.inside], axis=2).reshape(count, -1)
    error = np.concatenate([held, tube.instants[:, -1:]], axis=1)
    wide = np.maximum(error[:, :-1], error[:, 1:])
    wide = wide + (tube.acceleration[:, None] * (1.0 + 1e-6) + bound) * (step**2 / 8.0)
    gaps, apart = swept_distances(path, scenario.obstacles)
    first, second = np.triu_indices(count, 1)
    room = gaps - (scenario.obstacle_radii + scenario.core) - wide.T[..., None]
    between = apart - 2.0 * scenario.agent_radius - (wide[first] + wide[second]).T
    least = min(float(np.min(part, initial=np.inf)) for part in (room, between))
    return least - _ROUNDING
