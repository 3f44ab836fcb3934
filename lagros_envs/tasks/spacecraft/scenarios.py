"""Random tasks for spacecraft: starts, goals and obstacles, with a way for every agent."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import (
    check_fields,
    check_not_negative,
    check_positive,
    check_whole,
    shown,
    suggestion,
)
from lagros_envs.conventions import built_like
from lagros_envs.files import write_atomic
from lagros_envs.options import real_numbers
from lagros_envs.reading import Record
from lagros_envs.tasks.spacecraft.placement import clear, most_apart, scatter, scatter_pairs
from lagros_envs.tasks.spacecraft.reachable import way_exists
from lagros_envs.values import ByValue, use_plain_numbers

FORMAT = "lagros-scenario-1"
ATTEMPTS = 1000  # of a whole scenario, before the density is called impossible
# Of a coordinate and a radius [m]: planners look for ways in time, and no thruster gets farther.
LARGEST = 1e4
MOST_AGENTS, MOST_OBSTACLES = 1000, 10_000  # all pairs of them are looked at
GRID = 0.15  # cell of the grid on which a way is looked for [m]
# Shapes of a scenario's arrays, for n agents and k obstacles.
_SHAPES: dict[str, tuple[Any, ...]] = {
    "starts": ("n", 2),
    "headings": ("n",),
    "goals": ("n", 2),
    "obstacles": ("k", 2),
    "obstacle_radii": ("k",),
}


@dataclass(frozen=True, eq=False)
class Scenario(ByValue):
    """One task: who starts where, wants to go where, and what stands in between.

    Attributes:
        starts: Positions at the start, shape (n, 2) [m]; every agent starts at rest.
        headings: phi at the start, shape (n,) [rad].
        goals: Positions to reach, shape (n, 2) [m].
        obstacles: Centres, shape (k, 2) [m].
        obstacle_radii: Shape (k,) [m].
        agent_radius: Two agents collide when their centres come closer than twice this [m].
        core_radius: An agent collides with an obstacle when its centre comes closer to the
            obstacle's rim than this [m]; None takes `agent_radius`.

    Raises:
        ValueError: A shape is wrong, a value is not finite, a radius is out of range, or agents
            start in collision.
    """

    starts: FloatArray
    headings: FloatArray
    goals: FloatArray
    obstacles: FloatArray
    obstacle_radii: FloatArray
    agent_radius: float = 0.25
    core_radius: float | None = None

    def __post_init__(self) -> None:
        """Take read-only copies in double precision and check them."""
        arrays = {name: _numbers(name, getattr(self, name)) for name in _SHAPES}
        sizes = {"n": arrays["starts"].shape[:1], "k": arrays["obstacle_radii"].shape[:1]}
        for name, (whose, *rest) in _SHAPES.items():
            value, shape = arrays[name], (*sizes[whose], *rest)
            if value.size == 0:
                value = value.reshape(shape if 0 in shape else value.shape)
            if value.shape != shape or not np.all(np.abs(value) <= LARGEST):
                raise ValueError(
                    f"{name} has shape {value.shape}; it must be finite, at most {LARGEST:g}, and "
                    f"of shape {shape}, for {len(arrays['starts'])} agents and "
                    f"{arrays['obstacle_radii'].size} obstacles"
                )
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        check_whole("agents", self.num_agents, 1, MOST_AGENTS)
        check_whole("obstacles", len(self.obstacles), 0, MOST_OBSTACLES)
        check_positive("agent_radius", self.agent_radius)
        if self.core_radius is None:
            object.__setattr__(self, "core_radius", self.agent_radius)
        check_not_negative("core_radius", self.core, "or None for agent_radius")
        if np.any(self.obstacle_radii <= 0.0):
            raise ValueError(f"obstacle_radii={self.obstacle_radii.tolist()} must be > 0")
        self._check_starts()

    @classmethod
    def placed(cls, *values: FloatArray | float) -> Scenario:
        """Return the scenario of these fields without a check, for who has just placed them.

        Args:
            values: All fields in their order; the arrays become the scenario's own, read-only.
        """
        scenario = object.__new__(cls)
        for item, value in zip(fields(cls), values, strict=True):
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(scenario, item.name, value)
        return scenario

    @property
    def num_agents(self) -> int:
        """Number n of agents."""
        return len(self.starts)

    @property
    def core(self) -> float:
        """The agents' radius against obstacles [m]."""
        return self.agent_radius if self.core_radius is None else self.core_radius

    def _check_starts(self) -> None:
        apart = np.linalg.norm(self.starts[:, None] - self.starts, axis=-1)
        np.fill_diagonal(apart, np.inf)
        first, second = np.unravel_index(np.argmin(apart), apart.shape)
        if apart[first, second] < 2.0 * self.agent_radius:
            raise ValueError(
                f"agents {first} and {second} start {apart[first, second]:.3f} m apart; they need "
                f"{2.0 * self.agent_radius:g} m"
            )
        gaps = np.linalg.norm(self.starts[:, None] - self.obstacles, axis=-1) - self.obstacle_radii
        agents, obstacles = np.nonzero(gaps < self.core)
        if agents.size:
            raise ValueError(
                f"agent {agents[0]} starts {gaps[agents[0], obstacles[0]]:.3f} m from the rim of "
                f"obstacle {obstacles[0]}; it needs {self.core:g} m"
            )

    def to_dict(self) -> dict[str, Any]:
        """Return the scenario as plain numbers and lists."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in values.items()
        }

    def save(self, path: str | Path) -> None:
        """Write the scenario as JSON, atomically; numbers keep every bit."""
        write_atomic(path, json.dumps({"format": FORMAT, **self.to_dict()}, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """Read a scenario that `save` has written.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is not a scenario, or describes one that cannot be.
        """
        record = Record.load(path, "a scenario")
        record.must("format", FORMAT)
        record.only(["format", *(item.name for item in fields(cls))])
        core = record["core_radius"]
        try:
            return cls(
                **{name: record.array(name, (None, *rest)) for name, (_, *rest) in _SHAPES.items()},
                agent_radius=record.number("agent_radius"),
                core_radius=None if core is None else record.number("core_radius"),
            )
        except ValueError as error:
            text = str(error)
            raise ValueError(text if record.name in text else f"{record.name}: {text}") from None


def _numbers(name: str, value: Any) -> FloatArray:
    """Return a copy of an array of real numbers, or refuse what is none."""
    array = real_numbers(value)
    if array is None:
        raise ValueError(f"{name}={shown(value)} must be numbers in lists of equal lengths")
    return array


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
        least_way: Least distance from a start to its goal [m].
        heading_range: phi at the start is uniform in plus or minus this [rad].
        open_passages: Whether an agent with its margin fits between any two obstacles.
        layout: "random", or "antipodal": on a circle, each goal opposite to its start.
        grows: Whether arena and obstacle count grow with the number of agents, at the density of
            `agents`.

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
    least_way: float = 2.5
    heading_range: float = math.pi
    open_passages: bool = True
    layout: Literal["random", "antipodal"] = "random"
    grows: bool = False

    def __post_init__(self) -> None:
        check_fields(
            self,
            positive=("arena", "obstacle_radius", "agent_radius"),
            not_negative=("margin", "least_way", "heading_range"),
        )
        use_plain_numbers(self)
        check_not_negative("core_radius", self.core, "or None for agent_radius")
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
        return replace(
            self,
            agents=count,
            arena=self.arena * math.sqrt(share),
            obstacle_count=(fewest, most),
            grows=False,
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
    "swarm": Preset(grows=True),
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
    fewest, most = preset.obstacle_count
    count = int(rng.integers(fewest, most, endpoint=True))
    passage = preset.core + preset.margin if preset.open_passages else 0.0
    gap = 2.0 * (preset.obstacle_radius + passage)
    obstacles = scatter(rng, preset.arena, count, gap)
    if obstacles is None:
        return None
    clearance = preset.obstacle_radius + preset.core + preset.margin
    if preset.layout == "antipodal":
        ends = _opposite_ends(preset, rng)
        if not all(np.all(clear(points, obstacles, clearance)) for points in ends):
            return None
    else:
        found = scatter_pairs(
            rng,
            preset.arena,
            preset.agents,
            2.0 * (preset.agent_radius + preset.margin),
            preset.least_way,
            obstacles,
            clearance,
        )
        if found is None:
            return None
        ends = found
    starts, goals = ends
    inflated = np.full(count, clearance)
    if not way_exists(starts, goals, obstacles, inflated, GRID):
        return None
    headings = preset.heading_range * rng.uniform(-1.0, 1.0, preset.agents)
    radii = np.full(count, preset.obstacle_radius)
    # What was placed with a margin needs no second look, which takes as long as placing it.
    make = Scenario.placed if preset.margin > 0.0 else Scenario
    return make(starts, headings, goals, obstacles, radii, preset.agent_radius, preset.core)


def _opposite_ends(preset: Preset, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Place the agents on a circle in the middle of the arena, wide enough for all of them."""
    apart = 2.0 * (preset.agent_radius + preset.margin)
    least = 0.5 * apart / math.sin(math.pi / preset.agents) if preset.agents > 1 else 0.0
    radius = max(0.5 * preset.arena - preset.agent_radius - preset.margin, least)
    angles = 2.0 * math.pi * (rng.random() + np.arange(preset.agents) / preset.agents)
    arms = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    middle = np.full(2, 0.5 * preset.arena)
    return middle + arms, middle - arms
