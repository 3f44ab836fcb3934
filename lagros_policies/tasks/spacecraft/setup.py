"""Which spacecraft a policy is for: what its policies share of settings, preset and state."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.physics import HEADING, SPIN
from lagros_envs.tasks.spacecraft.scenarios import Preset, preset_named
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import THRUSTERS, SpacecraftSettings, settings_for
from lagros_policies.sb3_model import Spaces
from lagros_policies.trained_for import Range, body_values

if TYPE_CHECKING:
    from lagros_policies.planning.joint.plan import JointPlan

# Position and velocity in the state: plans lie in the plane, at a heading that rests.
PLANE = [0, 1, 3, 4]
# Two agents err independently, so that their distance errs sqrt(2) times as far.
PAIR_SHARE = math.sqrt(2.0)
# Presets whose bodies the shipped networks met in training or in what is published about them.
PUBLISHED = ("paper", "released")
# The same of the network that has flown crowds.
CROWDED = (*PUBLISHED, "gcbf")


def task_and_preset(
    settings: SpacecraftSettings | None, preset: str | Preset, num_agents: int | None
) -> tuple[SpacecraftSettings, Preset]:
    """Return what the first three arguments of every policy of the spacecraft mean.

    Args:
        settings: The task; None for that of the preset.
        preset: The preset, or its name.
        num_agents: Number of agents; None for the preset's own.

    Returns:
        The task, and the preset with that many agents.

    Raises:
        ValueError: The settings are none, there is no such preset, or the number of agents is less
            than 1.
    """
    chosen = preset_named(preset).for_agents(num_agents)
    return settings_for(chosen, settings), chosen


def spaces(task: SpacecraftSettings, preset: str | Preset) -> Spaces:
    """Return what a policy of one agent observes and answers; see `sb3_model.single_spaces`."""
    chosen = preset_named(preset)
    where = (
        f"worlds of {chosen.agents} agents and at most {chosen.obstacle_count[1]} obstacles, for "
        "which it must be trained, have"
    )
    return Spaces((Layout.for_preset(chosen, task).size,), (THRUSTERS,), 0.0, where)


def spacecraft_range(task: SpacecraftSettings, presets: Iterable[str | Preset]) -> Range:
    """Return what a network that was trained for a task may fly.

    It looks at what one agent senses, so that it is not tied to a number of agents or obstacles.

    Args:
        task: The task.
        presets: Those whose bodies it has met.
    """
    chosen = [preset_named(preset) for preset in presets]
    equal = {name: getattr(task, name) for name in ("control_period", "horizon")}
    radii = [radii_of(preset)["radii"] for preset in chosen]
    one_of: dict[str, Any] = {"radii": radii}
    for name in ("sensing_radius", "thrust_limit"):
        usual = getattr(task, name)
        met = [getattr(settings_for(preset), name) for preset in chosen]
        values = list(dict.fromkeys([usual, *met]))
        if len(values) == 1:
            equal[name] = usual
        else:
            one_of[name] = values
    return {
        "equal": body_values(task.system) | equal,
        "at_most": {"time_limit": task.time_limit},
        "one_of": one_of,
    }


def radii_of(preset: Preset) -> Mapping[str, Any]:
    """Return the radii of an agent against others and against obstacles, and of an obstacle."""
    return {"radii": [preset.agent_radius, preset.core, preset.obstacle_radius]}


def write_plan(
    plan: JointPlan,
    first: int,
    headings: FloatArray,
    period: float,
    nominal: FloatArray,
    accelerations: FloatArray,
) -> int:
    """Write what is to be followed from a control step on: a plan, and rest at its end.

    Least effort never turns a body, and with opposing thrusters the effort of a force is
    ||u||^2 = ||F||^2 / 2 whatever the heading: the plan of points is exact for the spacecraft with
    their headings at rest.

    Args:
        plan: The plan, from that step on.
        first: The step.
        headings: Of the agents, which rest, shape (n,) [rad].
        period: Control period; divides the plan's node step [s].
        nominal: x_d at the control instants, shape (steps + 1, n, 6); written.
        accelerations: Of x, y and heading under u_d, shape (steps, n, 3); written.

    Returns:
        The step at which the plan, or the episode, ends.
    """
    motion, forces = (part.transpose(1, 0, 2) for part in plan.resample(period))
    count = min(len(forces), len(accelerations) - first)
    end = first + count
    nominal[first : end + 1, :, PLANE] = motion[: count + 1]
    nominal[end + 1 :, :, :2] = motion[count, :, :2]
    nominal[end + 1 :, :, 3:] = 0.0
    nominal[first:, :, HEADING] = headings
    nominal[first:, :, SPIN] = 0.0
    accelerations[first:] = 0.0
    accelerations[first:end, :, :2] = forces[:count] / plan.mass
    return end


def plan_force_limit(settings: SpacecraftSettings, disturbance_bound: float) -> float | None:
    """Return the largest force per axis of the world that plans may use [N], at any heading.

    Two thrusters push along each axis of the body. Of their force, what a disturbance can take is
    left to u*; the rest is a disc of forces, and this the square within it.

    Args:
        settings: The task.
        disturbance_bound: d_bar to prepare for, in units of the state per second.

    Returns:
        The force; None where the task has no thrust limit.

    Raises:
        ValueError: Nothing is left.
    """
    if settings.thrust_limit is None:
        return None
    whole, reserve = 2.0 * settings.thrust_limit, settings.system.mass * disturbance_bound
    if whole <= reserve:
        raise ValueError(
            f"thrust_limit={settings.thrust_limit!r} N leaves plans no force: two thrusters push "
            f"with {whole:g} N, and disturbance_bound={disturbance_bound!r} can take {reserve:g} N;"
            " raise the limit, or prepare for a smaller bound"
        )
    return (whole - reserve) / math.sqrt(2.0)


def check_planner_force(force_limit: float | None, allowed: float | None) -> None:
    """Check the force limit of a planner that the user gives against what the thrusters leave.

    Raises:
        ValueError: The planner may use more.
    """
    if allowed is not None and (force_limit is None or force_limit > allowed):
        raise ValueError(
            f"the planner has force_limit={force_limit!r} N; the task's thrust_limit leaves plans "
            f"{allowed:g} N"
        )
