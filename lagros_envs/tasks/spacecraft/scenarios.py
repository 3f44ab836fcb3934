"""Random tasks for spacecraft: starts, goals and obstacles, with a way for every agent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields, check_not_negative, check_whole, shown, suggestion
from lagros_envs.conventions import built_like
from lagros_envs.tasks.spacecraft.placement import (
    Room,
    clear,
    most_apart,
    most_apart_in_disc,
    scatter,
)
from lagros_envs.tasks.spacecraft.reachable import shut_in, way_exists
from lagros_envs.tasks.spacecraft.scenario import LARGEST, MOST_AGENTS, MOST_OBSTACLES, Scenario
from lagros_envs.values import use_plain_numbers

__all__ = ["MOST_AGENTS", "PRESETS", "Preset", "Scenario", "preset_named"]

ATTEMPTS = 1000  # of a whole scenario, before the density is called impossible
REPAIRS = 50  # of an attempt in which agents shut in others
GRID = 0.15  # cell of the grid on which a way is looked for [m]


@dataclass(frozen=True)
class Preset:
    """A law from which scenarios are drawn.

    Attributes:
        agents: Number of agents unless another is asked for.
        arena: Side of the square [0, arena]^2 in which everything is placed [m]; free outside.
        obstacle_count: Fewest and most obstacles.
        obstacle_radius: Radius of every obstacle [m].
        agent_radius: As in `Scenario` [m].
        core_radius: As in `Scenario` [m].
        margin: Room that every start, goal and passage keeps beside the radii [m].
        obstacle_margin: The same of starts and goals beside obstacles [m]; None takes `margin`.
        least_way: Least distance from a start to its goal [m].
        heading_range: phi at the start is uniform in plus or minus this [rad].
        open_passages: Whether an agent with its margin fits between any two obstacles.
        layout: "random", or "antipodal": on a circle, each goal opposite to its start.
        grows: Whether arena and obstacle count grow with the number of agents, at the density of
            `agents`.
        slows: Whether T and the time limit grow with the side of the arena, as the ways do.
        time_scale: By what T and the time limit of the task are multiplied; `for_agents` sets it.
        rectangle_sides: Least and largest side of rectangles, both sides uniform, of which each
            obstacle is the disc of the same area and which may overlap [m]; None for discs of
            `obstacle_radius`.
        parked: Whether every start can be left while all others are parked at theirs, and every
            goal reached while all others are at theirs, by a way from outside of everything.
        task: Names and values of `SpacecraftSettings` that are other than the paper's; what an
            environment is given goes before them.

    Raises:
        ValueError: A value is out of range.
    """

    agents: int = 6
    arena: float = 5.0
    obstacle_count: tuple[int, int] = (3, 6)
    obstacle_radius: float = 0.5
    agent_radius: float = 0.25
    core_radius: float | None = None
    margin: float = 0.15
    obstacle_margin: float | None = None
    least_way: float = 2.5
    heading_range: float = math.pi
    open_passages: bool = True
    layout: Literal["random", "antipodal"] = "random"
    grows: bool = False
    slows: bool = False
    time_scale: float = 1.0
    rectangle_sides: tuple[float, float] | None = None
    parked: bool = False
    task: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        check_fields(
            self,
            positive=("arena", "obstacle_radius", "agent_radius", "time_scale"),
            not_negative=("margin", "least_way", "heading_range"),
        )
        use_plain_numbers(self)
        if self.rectangle_sides is not None:
            least, largest = self.rectangle_sides
            if not 0.0 < least <= largest <= LARGEST:
                raise ValueError(
                    f"rectangle_sides={self.rectangle_sides!r} must be 0 < least <= largest <= "
                    f"{LARGEST:g}, or None for discs of obstacle_radius"
                )
        check_not_negative("core_radius", self.core, "or None for agent_radius")
        check_not_negative("obstacle_margin", self.aside, "or None for margin")
        if self.arena > LARGEST:
            raise ValueError(f"arena={self.arena!r} must be at most {LARGEST:g}")
        fewest, most = self.obstacle_count
        if not 0 <= fewest <= most <= MOST_OBSTACLES:
            raise ValueError(
                f"obstacle_count={self.obstacle_count!r} must be 0 <= fewest <= most <= "
                f"{MOST_OBSTACLES}"
            )
        check_whole("agents", self.agents, 1, MOST_AGENTS)

    @property
    def core(self) -> float:
        """The agents' radius against obstacles [m]."""
        return self.agent_radius if self.core_radius is None else self.core_radius

    @property
    def aside(self) -> float:
        """Room that starts and goals keep beside obstacles [m]."""
        return self.margin if self.obstacle_margin is None else self.obstacle_margin

    @property
    def ring(self) -> float:
        """Radius of the circle of "antipodal", wide enough for all [m]."""
        apart = 2.0 * (self.agent_radius + self.margin)
        least = 0.5 * apart / math.sin(math.pi / self.agents) if self.agents > 1 else 0.0
        return max(0.5 * self.arena - self.agent_radius - self.margin, least)

    @property
    def longest_way(self) -> float:
        """No goal is farther from its start [m]."""
        return 2.0 * self.ring if self.layout == "antipodal" else math.sqrt(2.0) * self.arena

    def most_neighbours(self, radius: float) -> int:
        """Return how many others fit around an agent, within a radius [m], while none touch."""
        return most_apart_in_disc(radius, 2.0 * self.agent_radius) - 1

    def most_obstacles(self, radius: float) -> int:
        """Return how many obstacles have a part within a radius [m] of an agent.

        Where they may overlap it is more than any draw has: 10 + 8 standard deviations beyond the
        mean number.
        """
        if self.rectangle_sides is None:
            passage = self.core + self.margin if self.open_passages else 0.0
            reach, apart = radius + self.obstacle_radius, 2.0 * (self.obstacle_radius + passage)
            return most_apart_in_disc(reach, apart)
        reach = radius + self.rectangle_sides[1] / math.sqrt(math.pi)
        mean = self.obstacle_count[1] * math.pi * (reach / self.arena) ** 2
        return math.ceil(mean + 8.0 * math.sqrt(mean) + 10.0)

    def for_agents(self, num_agents: int | None = None) -> Preset:
        """Return the preset with its sizes for this many agents.

        Raises:
            ValueError: The number is less than 1.
        """
        count = self.agents if num_agents is None else num_agents
        check_whole("num_agents", count, 1, MOST_AGENTS)
        if not self.grows:
            # As it is where nothing changes: to check it again takes a quarter of a reset.
            return self if count == self.agents else replace(self, agents=count)
        share = max(1.0, count / self.agents)
        fewest, most = (round(share * number) for number in self.obstacle_count)
        side = math.sqrt(share)
        return replace(
            self,
            agents=count,
            arena=self.arena * side,
            obstacle_count=(fewest, most),
            grows=False,
            time_scale=self.time_scale * side if self.slows else self.time_scale,
        )

    def sample(self, rng: np.random.Generator, num_agents: int | None = None) -> Scenario:
        """Draw a scenario in which every agent alone has a way to its goal.

        Args:
            rng: The scenario stream of the episode.
            num_agents: Number of agents; None for the preset's own.

        Raises:
            ValueError: No attempt met the density that is asked for.
        """
        preset = self.for_agents(num_agents)
        preset._check_room()
        for _ in range(ATTEMPTS):
            scenario = _attempt(preset, rng)
            if scenario is not None:
                return scenario
        raise preset._refusal(f"in {ATTEMPTS} attempts")

    def _refusal(self, why: str) -> ValueError:
        fewest, most = self.obstacle_count
        return ValueError(
            f"no scenario with {self.agents} agents and {fewest} to {most} obstacles in an arena "
            f"of {self.arena:g} m {why}: use fewer agents or obstacles, a larger arena, or a "
            f"smaller margin ({self.margin:g} m) or least_way ({self.least_way:g} m)"
        )

    def _check_room(self) -> None:
        """Refuse at once what no draw can give: more than fits, or a longer way than there is.

        Raises:
            ValueError: The arena cannot hold it.
        """
        fewest = self.obstacle_count[0]
        passage = self.core + self.margin if self.open_passages else 0.0
        gap = 2.0 * (self.obstacle_radius + passage)
        room = most_apart(self.arena, gap)
        if fewest > room:
            raise self._refusal(f"({gap:g} m apart no more than {room} obstacles fit)")
        if self.layout == "antipodal":
            return  # the circle is as wide as it must be
        apart = 2.0 * (self.agent_radius + self.margin)
        room = most_apart(self.arena, apart)
        if self.agents > room:
            raise self._refusal(f"({apart:g} m apart no more than {room} agents fit)")
        if self.least_way > math.sqrt(2.0) * self.arena * (1.0 + 1e-12):
            raise self._refusal("(least_way is longer than the diagonal)")


# The double integrator of GCBF+ (arXiv 2401.14554, defaults of github.com/MIT-REALM/gcbfplus), with
# lengths and times five times its own. So speeds stay as they are, 0.5 m/s along each axis, and
# accelerations become 2 m/s^2 along each axis: two thrusters of 1 N at 1 kg. Its own numbers:
# radius 0.05, sensing 0.5, arrived within 0.1, starts and goals 0.2 apart and from obstacles,
# rectangles with sides of 0.1 to 0.5, eight agents in a square of side 4 at its density. Its
# episodes have 256 steps of 0.03 s unless told otherwise, less than it takes to cross that square
# at its speed, and are to be longer in larger ones: here twice as long, times the side (77 s is
# 512 steps, in whole half seconds). T is two thirds of that, as in the paper.
_GCBF = Preset(
    agents=8,
    arena=20.0,
    obstacle_count=(8, 8),
    obstacle_radius=1.5 / math.sqrt(math.pi),
    margin=0.25,
    obstacle_margin=0.75,
    least_way=0.0,
    heading_range=0.0,
    open_passages=False,
    grows=True,
    slows=True,
    rectangle_sides=(0.5, 2.5),
    parked=True,
    task=(
        ("goal_radius", 0.5),
        ("horizon", 51.0),
        ("sensing_radius", 2.5),
        ("speed_limit", 0.5),
        ("thrust_limit", 1.0),
        ("time_limit", 77.0),
    ),
)

PRESETS: dict[str, Preset] = {
    "paper": Preset(),
    # The authors' released code: centres of agents 1 m apart, agents that are points to obstacles,
    # a planning margin of 0.125 m, starts facing along the axes.
    "released": Preset(
        obstacle_count=(6, 6),
        agent_radius=0.5,
        core_radius=0.0,
        margin=0.125,
        least_way=5.0,
        heading_range=0.0,
    ),
    "crossing": Preset(obstacle_count=(0, 0), least_way=0.0, layout="antipodal"),
    "open": Preset(obstacle_count=(0, 0)),
    # Ways grow with the side of the arena, and the time for them as well.
    "swarm": Preset(grows=True, slows=True, parked=True),
    # However many there are and however long their ways, T = 30 s and 45 s to arrive.
    "swarm-45": Preset(grows=True),
    "gcbf": _GCBF,
    "gcbf-free": replace(_GCBF, obstacle_count=(0, 0)),
}


def preset_named(preset: str | Preset | Mapping[str, Any]) -> Preset:
    """Return a preset by its name, or from a dictionary of its fields; a preset stays as it is.

    Raises:
        ValueError: The name or a field is unknown, or a value is out of range.
    """
    if not isinstance(preset, str):
        return built_like(PRESETS["paper"], preset, "preset")
    if preset not in PRESETS:
        raise ValueError(
            f"preset={shown(preset)} is not known; use one of {', '.join(PRESETS)}, or a "
            f"lagros_envs.tasks.spacecraft.scenarios.Preset.{suggestion(preset, PRESETS)}"
        )
    return PRESETS[preset]


def _attempt(preset: Preset, rng: np.random.Generator) -> Scenario | None:
    """Draw once; None if something found no place or a goal cannot be reached."""
    found = _obstacles(preset, rng)
    if found is None:
        return None
    obstacles, radii = found
    clearance = radii + preset.core + preset.aside
    apart = 2.0 * (preset.agent_radius + preset.margin)
    if preset.layout == "antipodal":
        ends = _opposite_ends(preset, rng)
        if not all(np.all(clear(points, obstacles, clearance)) for points in ends):
            return None
    else:
        room = Room(preset.arena, apart, preset.least_way, obstacles, clearance)
        pairs = room.scatter(rng, preset.agents)
        if pairs is not None and preset.parked:
            pairs = _let_out(preset, rng, room, pairs, radii)
        if pairs is None:
            return None
        ends = pairs[:, :2].copy(), pairs[:, 2:].copy()
    starts, goals = ends
    inflated = radii + preset.core + preset.margin
    if not preset.parked and not way_exists(starts, goals, obstacles, inflated, GRID):
        return None
    headings = preset.heading_range * rng.uniform(-1.0, 1.0, preset.agents)
    # What was placed with a margin needs no second look, which takes as long as placing it.
    make = Scenario.placed if preset.margin > 0.0 else Scenario
    return make(starts, headings, goals, obstacles, radii, preset.agent_radius, preset.core)


def _obstacles(preset: Preset, rng: np.random.Generator) -> tuple[FloatArray, FloatArray] | None:
    """Draw centres (k, 2) and radii (k,) of obstacles; None if one found no place."""
    fewest, most = preset.obstacle_count
    count = int(rng.integers(fewest, most, endpoint=True))
    if preset.rectangle_sides is not None:
        sides = rng.uniform(*preset.rectangle_sides, (2, count))
        radii = np.sqrt(sides[0] * sides[1] / math.pi)
        return rng.uniform(0.0, preset.arena, (count, 2)), radii
    passage = preset.core + preset.margin if preset.open_passages else 0.0
    gap = 2.0 * (preset.obstacle_radius + passage)
    centres = scatter(rng, preset.arena, count, gap)
    return None if centres is None else (centres, np.full(count, preset.obstacle_radius))


def _let_out(
    preset: Preset, rng: np.random.Generator, room: Room, pairs: FloatArray, radii: FloatArray
) -> FloatArray | None:
    """Place those anew who are shut in by others that are parked; None if some stay so.

    Args:
        preset: The preset.
        rng: Source of the draws.
        room: Where pairs find a place.
        pairs: Starts and goals side by side, shape (n, 4) [m].
        radii: Of the obstacles, shape (k,) [m].
    """
    blocked = radii + preset.core
    for _ in range(REPAIRS):
        shut = np.zeros(len(pairs), bool)
        for points in (pairs[:, :2], pairs[:, 2:]):
            touch = 2.0 * preset.agent_radius
            shut |= shut_in(points, touch, room.obstacles, blocked, max(GRID, preset.margin))
        if not shut.any():
            return pairs
        for agent in np.flatnonzero(shut):
            others = np.delete(pairs, agent, axis=0)
            anew = room.place(rng, others)
            if anew is None:
                return None
            pairs[agent] = anew
    return None


def _opposite_ends(preset: Preset, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Place the agents on a circle in the middle of the arena."""
    angles = 2.0 * math.pi * (rng.random() + np.arange(preset.agents) / preset.agents)
    arms = preset.ring * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    middle = np.full(2, 0.5 * preset.arena)
    return middle + arms, middle - arms
