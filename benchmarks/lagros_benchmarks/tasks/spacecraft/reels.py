"""Worlds of spacecraft for the page: who was where, who arrived and who collided."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_benchmarks.report.page.packed import packed
from lagros_benchmarks.report.page.reels import Reel, box_of, flight, kept_instants, within
from lagros_benchmarks.report.page.worthy import Merit
from lagros_benchmarks.run.library import Toolbox
from lagros_benchmarks.run.settings import BenchmarkSettings, Case
from lagros_benchmarks.tasks.spacecraft.episodes import Trace, WorldRecord, WorldsLoop, fly
from lagros_benchmarks.tasks.spacecraft.experiment import SpacecraftExperiment, SpacecraftRun
from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.world import SpacecraftWorld

_X, _Y, _HEADING = 0, 1, 2
_LARGEST = 1e4  # no measure is followed farther


class SpacecraftCamera:
    """Notes the states of all agents of a loop of one world; see `reels.Camera`."""

    def __init__(self) -> None:
        self._world: SpacecraftWorld | None = None
        self._states: list[FloatArray] = []
        self._pushes: list[FloatArray] = []
        self._plan: FloatArray | None = None
        self._arena = 0.0

    def note(self, loop: Any) -> None:
        """Note this control instant."""
        world = self._world = loop.env.episode.world
        self._arena = loop.env.preset.arena
        bound = world.disturbance.bound
        self._states.append(world.states[0])
        pushed = world.push[:, 0].T
        self._pushes.append(pushed / bound if bound > 0.0 else 0.0 * pushed)
        given = world.nominal if world.nominal is not None else getattr(loop, "nominal", None)
        self._plan = None if given is None else np.asarray(given[0])

    def reel(self, error: str | None, proved: FloatArray | None = None) -> Reel:
        """Return what was noted."""
        world = self._world
        if world is None:
            raise ValueError("nothing was noted; begin the episode first")
        states = np.clip(np.array(self._states), -_LARGEST, _LARGEST)
        times = world.settings.control_period * np.arange(len(states), dtype=np.float64)
        scene = _scene(world, self._arena, states[0])
        box = np.array(scene["box"])
        places = np.concatenate(
            [within(states[..., :2], box), -states[..., _HEADING : _HEADING + 1]], axis=-1
        )
        parts: dict[str, FloatArray | None] = {
            "places": places,
            "push": np.array(self._pushes)[..., [0, 1, 3, 4]],
        }
        flown = flight(
            _text(world, error),
            error,
            _ending(world, error, float(times[-1])),
            _events(world),
            times,
            parts,
            self._measures(world, states, times),
            box_of(places[..., :2]),
        )
        if self._plan is not None:
            kept = kept_instants(len(self._plan))
            flown["plan"] = {
                "times": packed(world.settings.control_period * kept),
                "places": packed(self._plan[kept][..., :2]),
            }
        return Reel(scene, flown)

    def _measures(
        self, world: SpacecraftWorld, states: FloatArray, times: FloatArray
    ) -> dict[str, FloatArray | None]:
        """Return those of the agent that is farthest off, at every instant."""
        off = np.linalg.norm(states[..., :2] - world.goals[:, 0].T, axis=-1)
        measures: dict[str, FloatArray | None] = {
            "distance": off.max(axis=-1),
            "radius": np.full(len(times), world.settings.goal_radius),
            "tube": np.asarray(world.settings.tube.radius(times)),
        }
        if self._plan is None:
            return measures
        error = states - self._plan[: len(states)]
        return measures | {"error": np.linalg.norm(error, axis=-1).max(axis=-1)}


def _scene(world: SpacecraftWorld, arena: float, start: FloatArray) -> dict[str, Any]:
    goals = world.goals[:, 0].T
    radii = world.obstacle_radii[0]
    there = np.isfinite(radii)
    discs = np.column_stack([world.obstacle_centres[:, 0].T, radii])[there]
    corners = np.array([[0.0, 0.0], [arena, arena]])
    radius = world.settings.goal_radius
    return {
        "discs": np.round(discs, 4).tolist(),
        "goals": [[*np.round(goal, 4).tolist(), radius] for goal in goals],
        "radius": float(world.agent_radius[0]),
        "outline": None,
        "plan": None,
        "box": np.round(box_of(np.concatenate([corners, goals, start[:, :2]])), 4).tolist(),
    }


def _text(world: SpacecraftWorld, error: str | None) -> str:
    arrived = 0 if error is not None else int(np.isfinite(world.success_time[0]).sum())
    effort = float(world.effort_to_success[0].mean())
    return (
        f"{arrived} of {world.agents} arrived, {int(world.collided[0].sum())} collided, "
        f"mean effort to success {effort:.2f} N²s"
    )


def _events(world: SpacecraftWorld) -> list[dict[str, Any]]:
    """Return who arrived and who collided, when."""
    found = []
    for kind, when in (("arrival", world.success_time), ("collision", world.collision_time)):
        for agent, time in enumerate(when[0]):
            if np.isfinite(time):
                found.append({"time": float(time), "body": agent, "kind": kind})
    return sorted(found, key=lambda event: event["time"])


def _ending(world: SpacecraftWorld, error: str | None, time: float) -> dict[str, Any] | None:
    """Return what made the world a failure first."""
    if error is not None:
        return {"time": time, "label": "the policy raised", "body": 0}
    collided = world.collision_time[0]
    first = int(np.argmin(collided))
    if np.isfinite(collided[first]):
        label = f"agent {first} collided"
        return {"time": float(collided[first]), "label": label, "body": first}
    missing = np.flatnonzero(~np.isfinite(world.success_time[0]))
    if not missing.size:
        return None
    late = f"agent {missing[0]}" if missing.size == 1 else f"{missing.size} agents"
    return {"time": time, "label": f"{late} not at the goal in time", "body": int(missing[0])}


@dataclass
class _Watched(Trace):
    """A trace that shows a camera what it notes."""

    camera: SpacecraftCamera = field(default_factory=SpacecraftCamera)

    def note(self, loop: WorldsLoop) -> None:
        """Note this control instant."""
        super().note(loop)
        self.camera.note(loop)


class SpacecraftReels:
    """Flies worlds of a benchmark again, for the page."""

    @staticmethod
    def merit(record: WorldRecord) -> Merit:
        """Return how a world went: who collided after arriving, then the effort."""
        failed = not all(agent.success for agent in record.agents)
        collided = sum(agent.collided for agent in record.agents)
        return Merit(failed, 1e3 * collided + sum(agent.effort for agent in record.agents))

    @staticmethod
    def units(run: SpacecraftRun) -> Sequence[int]:
        """Return the seed of every world."""
        return run.settings.episode_seeds()

    @staticmethod
    def fly(
        settings: BenchmarkSettings,
        toolbox: Toolbox,
        case: Case,
        units: Sequence[int],
        records: Sequence[WorldRecord],
    ) -> list[Reel | None]:
        """Fly worlds again, one by one; None where not even the reset comes to an end."""
        experiment = SpacecraftExperiment(settings, toolbox, 0.0)
        env = experiment.environment(case, 1)
        policy = experiment.policy(case, env)
        loop = WorldsLoop(env, policy)
        return [_again(loop, seed, record) for seed, record in zip(units, records, strict=True)]


def _again(loop: WorldsLoop, seed: int, record: WorldRecord) -> Reel | None:
    trace = _Watched()
    (again,) = fly(loop, [seed], None, trace).worlds
    try:
        reel = trace.camera.reel(again.error)
    except ValueError:
        return None
    names = ("success", "strict_success", "collided")
    reel.flight["as_recorded"] = again.error == record.error and all(
        all(getattr(mine, name) == getattr(theirs, name) for name in names)
        and bool(np.isclose(mine.effort, theirs.effort, 1e-3))
        for mine, theirs in zip(again.agents, record.agents, strict=True)
    )
    return reel
