"""The spacecraft as they are watched: the world, the policy that flies it, and their pictures."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lagros_benchmarks.report.video import Frame
from lagros_benchmarks.report.watched import efforts
from lagros_benchmarks.run import library
from lagros_benchmarks.run.flying import Attempt, ask, counted, rehearse, reseed
from lagros_benchmarks.tasks.spacecraft.episodes import is_global, make_filter, shapes_of
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.draw import SpacecraftRenderer
from lagros_envs.tasks.spacecraft.scenarios import Preset, Scenario, preset_named

if TYPE_CHECKING:
    from lagros_benchmarks.report.playback import WatchSettings


class SpacecraftGame:
    """Spacecraft and the policy that flies all of them."""

    divisible = False

    def __init__(self, settings: WatchSettings) -> None:
        self._settings, self._seed = settings, settings.seed
        self._scenario = None if settings.scenario is None else Scenario.load(settings.scenario)
        preset = _preset(settings, self._scenario)
        bound = settings.disturbance_bound
        self.env: Any = spacecraft_v0.parallel_env(
            preset=preset,
            disturbance=settings.disturbance,
            disturbance_bound=bound,
        )
        self._options: dict[str, Any] = (
            {} if self._scenario is None else {"scenario": self._scenario}
        )
        # What is seen at the start, for the plan of the whole episode.
        self._still: Any = spacecraft_v0.parallel_env(preset=preset, settings=self.env.settings)
        observations, _ = self._still.reset(seed=self._seed, options=self._options)
        _, policy = self._built()
        seen = self._seen(policy, self._still, observations)
        shapes = shapes_of(policy, 1, preset.agents)
        rehearse(f"policy {settings.policy!r}", policy, seen, np.ones(len(seen), bool), *shapes)
        # Others fly: a policy may count its calls without being told.
        self._planner, self._policy = self._built()
        self.error: str | None = None
        self._state: Any = None
        self._observations: dict[str, Any] = {}
        self._infos: dict[str, dict[str, Any]] = {}
        self._first = True
        self._pictures: Any = None

    def start(self, render_mode: str, rate: float) -> None:
        """Begin the episode, with its plan, and open the window or what draws without one."""
        nominal = self._nominal()
        options = {} if nominal is None else {"nominal": nominal}
        self._observations, self._infos = self.env.reset(
            seed=self._seed, options=self._options | options
        )
        # Only now: a window would stand still while this plans.
        fps = max(1, round(rate))
        self._pictures = SpacecraftRenderer(render_mode, fps, self.env.preset.arena)

    def step(self) -> bool:
        """Take a control step; return whether the episode is over."""
        # One world, or one row for each agent.
        agents = self.env.agents
        rows: Any = None
        with Attempt() as attempt:
            if self._first:
                reseed(self._policy, self._seed)
            rows, self._state = self._ask(
                self._policy, self.env, self._observations, self._state, self._first
            )
        self.error = attempt.error
        if self.error is not None:
            return True
        self._first = False
        self._observations, _, _, _, self._infos = self.env.step(
            dict(zip(agents, rows, strict=True))
        )
        return not self.env.agents

    def draw(self, part: float) -> Frame | None:
        """Draw the world: a frame, or None in a window; of whole control steps only."""
        frame: Frame | None = self._pictures.draw(self.env.episode.world)
        return frame

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._pictures is not None:
            self._pictures.close()

    def counters(self) -> dict[str, int]:
        """Return what the policy counts."""
        return counted(self._policy, self._state)

    def outcome(self) -> str:
        """Return what the episode came to, in one line."""
        infos = self._infos.values()
        count = len(self._infos)
        arrived = sum(info["success"] for info in infos)
        collided = sum(info["collided"] for info in infos)
        to_success = sum(info["effort_to_success"] for info in infos) / count
        to_end = sum(info["effort"] for info in infos) / count
        return (
            f"{arrived} of {count} arrived, {collided} collided, in {self.env.time:.1f} s; "
            + efforts("mean effort of an agent", to_success, to_end, "N")
        )

    def _nominal(self) -> Any:
        """Return x_d (steps + 1, agents, 6) if the policy plans it at the start, else None."""
        if not is_global(self._policy):
            return None
        with Attempt():  # what it raises, it will raise in the episode
            _, memories = self._ask(self._planner, self._still, {}, None, True)
            return memories[0].nominal
        return None

    def _ask(
        self, policy: Any, env: Any, observations: dict[str, Any], state: Any, first: bool
    ) -> tuple[Any, Any]:
        """Return the actions, a row for each agent, and the policy's memory."""
        seen = self._seen(policy, env, observations)
        starts = np.full(len(seen), first)
        shapes = shapes_of(policy, 1, env.num_agents)
        action, state, _ = ask(policy, seen, state, starts, *shapes)
        return action, state

    def _built(self) -> tuple[Any, Any]:
        """Return the policy, and again as it flies, with the filter that it may wear."""
        settings, name = self._settings, f"policy {self._settings.policy!r}"
        policy: Any = library.make_single_policy(settings.policy, self.env)
        if not settings.safety_filter:
            return policy, policy
        with library.building(f"{name} with the safety filter"):
            return policy, make_filter(policy, self.env, settings.disturbance_bound)

    def _seen(self, policy: Any, env: Any, observations: dict[str, Any]) -> Any:
        if is_global(policy):
            return env.state()[None]
        return np.stack([observations[agent] for agent in env.agents])


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
