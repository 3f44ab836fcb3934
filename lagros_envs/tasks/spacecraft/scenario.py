"""One task for spacecraft: starts, goals and obstacles, and the file that keeps it."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_not_negative, check_positive, check_whole, shown
from lagros_envs.files import write_atomic
from lagros_envs.options import real_numbers
from lagros_envs.reading import Record
from lagros_envs.values import ByValue

FORMAT = "lagros-scenario-1"
# Of a coordinate and a radius [m]: planners look for ways in time, and no thruster gets farther.
LARGEST = 1e4
MOST_AGENTS, MOST_OBSTACLES = 4096, 10_000
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
