"""The spacecraft as they are watched: the world, the policy that flies it, and their pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lagros_benchmarks.report.video import Frame
from lagros_benchmarks.report.watched import SingleGame, efforts
from lagros_benchmarks.run import library
from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.tasks.spacecraft.episodes import make_filter, shapes_of
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.draw import SpacecraftRenderer
from lagros_envs.tasks.spacecraft.scenarios import Preset, Scenario, preset_named

if TYPE_CHECKING:
    from lagros_benchmarks.report.playback import WatchSettings


class _World(ClosedLoop):
    """A policy in one of PettingZoo's worlds."""

    def move(self) -> None:
        """Hold the actions of all agents for one control step."""
        actions = dict(zip(self.env.agents, self.action, strict=True))
        self.observation, _, _, _, self.info = self.env.step(actions)
        self.ended = not self.env.agents
        self.step += 1

    def seen(self) -> Any:
        """Return one world, or one row for each agent."""
        if self.policy.observes == "global":
            return self.env.state()[None]
        return np.stack([self.observation[agent] for agent in self.env.agents])

    def shapes(self) -> Sequence[tuple[int, ...]]:
        """Return the shapes that its action may have."""
        return shapes_of(self.policy, 1, self.env.num_agents)


class SpacecraftGame(SingleGame):
    """Spacecraft and the policy that flies all of them."""

    divisible = False

    def __init__(self, settings: WatchSettings) -> None:
        self._settings, self._seed = settings, settings.seed
        scenario = None if settings.scenario is None else Scenario.load(settings.scenario)
        self._options = {} if scenario is None else {"scenario": scenario}
        preset = _preset(settings, scenario)
        self.env = spacecraft_v0.parallel_env(
            preset=preset,
            disturbance=settings.disturbance,
            disturbance_bound=settings.disturbance_bound,
        )
        # What is seen at the start, for the plan of the whole episode.
        self._still = spacecraft_v0.parallel_env(preset=preset, settings=self.env.settings)
        first = _World(self._still, self._built()[1])
        first.rehearse(f"policy {settings.policy!r}", self._seed, self._options)
        # Others fly: a policy may count its calls without being told.
        self._planner, policy = self._built()
        self.loop = _World(self.env, policy)

    def begin(self) -> None:
        """Begin the episode, with its plan."""
        nominal = self._nominal()
        options = {} if nominal is None else {"nominal": nominal}
        self.loop.begin(self._seed, self._options | options)

    def open(self, render_mode: str, rate: float) -> None:
        """Open the window, or what draws without one."""
        fps = max(1, round(rate))
        self._pictures = SpacecraftRenderer(render_mode, fps, self.env.preset.arena)

    def draw(self, part: float) -> Frame | None:
        """Draw the world: a frame, or None in a window; of whole control steps only."""
        frame: Frame | None = self._pictures.draw(self.env.episode.world)
        return frame

    def outcome(self) -> str:
        """Return what the episode came to, in one line."""
        infos = self.loop.info.values()
        count = len(infos)
        arrived = sum(info["success"] for info in infos)
        collided = sum(info["collided"] for info in infos)
        to_success = sum(info["effort_to_success"] for info in infos) / count
        to_end = sum(info["effort"] for info in infos) / count
        return (
            f"{arrived} of {count} arrived, {collided} collided, in {self.env.time:.1f} s; "
            + efforts("mean effort of an agent", to_success, to_end, "N²")
        )

    def _nominal(self) -> Any:
        """Return x_d (steps + 1, agents, 6) if the policy plans it at the start, else None."""
        if self.loop.policy.observes == "local":
            return None
        with Attempt():  # what it raises, it will raise in the episode
            plan = _World(self._still, self._planner)
            plan.begin(self._seed, self._options)
            plan.decide()
            return plan.memory[0].nominal
        return None

    def _built(self) -> tuple[Any, Any]:
        """Return the policy, and again as it flies, with the filter that it may use."""
        settings, name = self._settings, f"policy {self._settings.policy!r}"
        policy: Any = library.make_single_policy(settings.policy, self.env)
        if not settings.safety_filter:
            return policy, policy
        with library.building(f"{name} with the safety filter"):
            return policy, make_filter(policy, self.env, settings.disturbance_bound)


def _preset(settings: WatchSettings, scenario: Scenario | None) -> Preset:
    """Return the preset with room for the scenario, whose radii it takes.

    Raises:
        ValueError: The scenario has another number of agents than was asked for.
    """
    preset = preset_named(settings.preset or "paper")
    if scenario is None:
        return preset.for_agents(settings.agents)
    if settings.agents not in (None, scenario.num_agents):
        raise ValueError(
            f"agents={settings.agents} but {settings.scenario} has {scenario.num_agents}; leave "
            "--agents out"
        )
    sized = preset.for_agents(scenario.num_agents)
    most = max(sized.obstacle_count[1], len(scenario.obstacles))
    return replace(
        sized,
        obstacle_count=(0, most),
        agent_radius=scenario.agent_radius,
        core_radius=scenario.core_radius,
    )
