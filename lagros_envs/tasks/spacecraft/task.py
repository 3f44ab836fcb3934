"""The spacecraft task of the paper: settings, forces and rewards.

Every definition works on arrays of any leading shape, so that one agent and many worlds share it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import (
    LARGEST,
    MOST_STEPS,
    check_at_most,
    check_fields,
    check_multiple,
    check_not_negative,
    check_positive,
    check_whole,
)
from lagros_envs.conventions import settings_of
from lagros_envs.options import nominal_option
from lagros_envs.task import Defaults, Described
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_envs.tasks.spacecraft.scenarios import MOST_AGENTS, PRESETS, Preset
from lagros_envs.tube import PaperTube
from lagros_envs.values import use_plain_numbers

STATE_DIM = 6
THRUSTERS = 8
RATES = (False, False, False, True, True, True)
# Beyond this, in units of the state, the integration has diverged under an enormous force.
LARGEST_STATE = 1e12
# No force is larger [N], whatever the action: the effort of an episode stays a number, in single
# precision as well.
LARGEST_FORCE = 1e16
# What an action is, for messages.
ACTION = "one per thruster"
# What `reset(options=...)` of one world may hold.
OPTIONS = ("scenario", "nominal")


@dataclass(frozen=True)
class SpacecraftSettings(Described):
    """Everything that defines the task except the scenario, with the values of the paper.

    Attributes:
        system: The spacecraft.
        control_period: Zero-order hold, the largest admissible control interval [s].
        horizon: T, nominal duration of a plan [s].
        time_limit: The end of an episode [s].
        sensing_radius: How far an agent senses [m].
        goal_radius: Distance from the goal at which an agent has arrived [m].
        tube: The published tube; its radius is the threshold of `paper_success`.
        thrust_scale: Force of the action 1.0 of one thruster [N].
        speed_limit: Largest speed along each axis of the world [m/s], beyond which nothing pushes;
            None for none.
        thrust_limit: Saturation of one thruster [N]; None leaves it unlimited, and actions beyond 1
            are applied as they are. Thrusters cannot pull: negative actions count as zero.
        progress_weight: Reward per metre of approach to the goal.
        effort_weight: Reward per N^2 s of effort, negative sign applied.
        success_bonus: Reward at the first success.
        collision_penalty: Reward at the first collision, negative sign applied.

    Raises:
        ValueError: A value is out of range or a duration is not a whole number of periods.
    """

    system: Spacecraft = field(default_factory=Spacecraft)
    control_period: float = 0.1
    horizon: float = 30.0
    time_limit: float = 45.0
    sensing_radius: float = 2.0
    goal_radius: float = 0.2
    tube: PaperTube = field(default_factory=lambda: PaperTube(0.125, 0.3))
    thrust_scale: float = 1.0
    thrust_limit: float | None = None
    speed_limit: float | None = None
    progress_weight: float = 1.0
    effort_weight: float = 0.02
    success_bonus: float = 5.0
    collision_penalty: float = 5.0

    name, title, room = "spacecraft", "Spacecraft", "spacecraft"
    most_agents, presets = MOST_AGENTS, tuple(PRESETS)
    defaults = Defaults(
        policies=("learned", "tube-mpc", "lagros", "centralized"),
        bounds=(0.2, 0.4, 0.6, 0.8, 1.0),
        bound=0.4,
        agents=(6,),
        preset="paper",
        safety_filter="both",
        attack_episodes=3,
        attack_budget=100,
        certify_policies=(
            *("centralized", "centralized:firm", "centralized:ellipsoid", "lqr-plan", "lagros"),
        ),
        certify_episodes=20,
        speed=4.0,
    )

    def __post_init__(self) -> None:
        check_fields(self)
        use_plain_numbers(self)
        for item in fields(self):
            if item.type == "float":
                check_not_negative(item.name, getattr(self, item.name))
                most = LARGEST_FORCE if item.name.startswith("thrust") else LARGEST
                check_at_most(item.name, getattr(self, item.name), most)
        for name in ("control_period", "horizon", "time_limit", "goal_radius", "thrust_scale"):
            check_positive(name, getattr(self, name))
        if self.thrust_limit is not None:
            check_positive("thrust_limit", self.thrust_limit, "or None for no limit")
            check_at_most("thrust_limit", self.thrust_limit, LARGEST_FORCE, "or None for no limit")
        if self.speed_limit is not None:
            check_positive("speed_limit", self.speed_limit, "or None for no limit")
        for name in ("horizon", "time_limit"):
            check_multiple(name, getattr(self, name), "control_period", self.control_period, 1e-6)

    def defaults_in(self, preset: str | None) -> Defaults:
        """Return what the commands take in the worlds of a preset; None for the usual one."""
        usual = self.defaults
        if preset not in PRESETS:
            return usual
        own = PRESETS[preset]
        # (a) has learned no other limits; PPO has.
        learned = "ppo" if own.task else usual.policies[0]
        return replace(usual, agents=(own.agents,), policies=(learned, *usual.policies[1:]))

    @property
    def steps(self) -> int:
        """Control steps of an episode that runs to its limit."""
        return round(self.time_limit / self.control_period)


def settings_for(
    preset: Preset, given: SpacecraftSettings | Mapping[str, Any] | None = None
) -> SpacecraftSettings:
    """Return the task of the worlds of a preset.

    Args:
        preset: The preset, with its number of agents.
        given: Settings, which are taken as they are; a dictionary of those fields that differ from
            the preset's; None for the preset's.

    Raises:
        ValueError: A field is unknown, or a value is out of range.
    """
    if isinstance(given, SpacecraftSettings):
        return given
    own = settings_of(SpacecraftSettings(), dict(preset.task))
    return settings_of(_slower(own, preset.time_scale), given)


def before_growth(settings: SpacecraftSettings, preset: Preset) -> SpacecraftSettings:
    """Return the settings with T and the time limit of as few agents as the preset is made for.

    Where they are not those of the preset they stay: somebody has chosen them.
    """
    usual = settings_of(SpacecraftSettings(), dict(preset.task))
    grown = _slower(usual, preset.time_scale)
    if (settings.horizon, settings.time_limit) != (grown.horizon, grown.time_limit):
        return settings
    return replace(settings, horizon=usual.horizon, time_limit=usual.time_limit)


def _slower(settings: SpacecraftSettings, scale: float) -> SpacecraftSettings:
    """Return the settings with T and the time limit times a factor, in whole half seconds.

    Plans have their nodes there; where the control period does not divide it, the nearest that it
    divides.
    """
    if scale == 1.0:
        return settings
    step = settings.control_period * max(1, round(0.5 / settings.control_period))
    horizon, limit = (
        round(math.ceil(scale * time / step - 1e-6) * step, 9)
        for time in (settings.horizon, settings.time_limit)
    )
    return replace(settings, horizon=horizon, time_limit=limit)


def limited(settings: SpacecraftSettings, steps: int | None) -> SpacecraftSettings:
    """Return the settings with an episode of this many control steps; None leaves them.

    Raises:
        ValueError: The number is less than 1, or enormous.
    """
    if steps is None:
        return settings
    check_whole("max_cycles", steps, most=MOST_STEPS)
    return replace(settings, time_limit=steps * settings.control_period)


def applied_forces(settings: SpacecraftSettings, actions: Any) -> FloatArray:
    """Return the forces of the thrusters [N], of the actions' shape: scaled, then clipped."""
    with np.errstate(over="ignore"):
        forces = settings.thrust_scale * np.asarray(actions, dtype=np.float64)
    limit = settings.thrust_limit
    # `np.clip` takes twice as long for a few agents.
    return np.minimum(np.maximum(forces, 0.0), LARGEST_FORCE if limit is None else limit)


def nominal_from_options(
    options: dict[str, Any],
    settings: SpacecraftSettings,
    batch: tuple[int, ...],
    looked_at: BoolArray | None = None,
) -> FloatArray | None:
    """Return x_d of every agent at every control instant, if the options hold it.

    Args:
        options: As given to reset.
        settings: The task.
        batch: Leading axes, then the number of agents.
        looked_at: Which of a leading axis have to be finite; all of them if left out.

    Returns:
        Shape (*leading, steps + 1, agents, 6), or None.

    Raises:
        ValueError: The trajectory has the wrong shape or is not finite.
    """
    *leading, agents = batch
    shape = (*leading, settings.steps + 1, agents, STATE_DIM)
    return nominal_option(options, shape, "the nominal state of every agent", looked_at)


def reward(
    settings: SpacecraftSettings,
    effort: FloatArray,
    approach: FloatArray,
    first_success: BoolArray,
    first_collision: BoolArray,
) -> FloatArray:
    """Return each agent's reward of one control step.

    Args:
        settings: The task.
        effort: ||u||^2 dt of the step [N^2 s].
        approach: How much closer to its goal the step brought the agent [m].
        first_success: Whether the step brought the first success.
        first_collision: Whether the step brought the first collision.

    Returns:
        w_p approach - w_e ||u||^2 dt + b_s [first success] - b_c [first collision]. Approach adds
        up to the way made good, so that neither hurrying nor dithering pays.
    """
    rewards: FloatArray = (
        settings.progress_weight * approach
        - settings.effort_weight * effort
        + settings.success_bonus * first_success
        - settings.collision_penalty * first_collision
    )
    return rewards
