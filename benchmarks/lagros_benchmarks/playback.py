"""One episode with frames of it, for `lagros watch`."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import lagros_envs  # noqa: F401  (registers the environments)
from lagros_benchmarks import library
from lagros_benchmarks.episodes import ACTION
from lagros_benchmarks.flying import Attempt, ask, check_interface, counted, rehearse, reseed
from lagros_benchmarks.settings import unknown_name
from lagros_benchmarks.spacecraft_episodes import is_global, shapes_of
from lagros_benchmarks.video import FRAME_RATES, Frame, check_video_path, video_bytes
from lagros_envs import spacecraft_v0
from lagros_envs.checks import (
    check_fields,
    check_not_negative,
    check_positive,
    check_seed,
    check_whole,
)
from lagros_envs.disturbances import KINDS
from lagros_envs.scenarios import MOST_AGENTS, PRESETS, Preset, Scenario, preset_named

TASKS = ("cartpole", "spacecraft")
BOUNDS = {"cartpole": 0.75, "spacecraft": 0.4}
# "worst" needs a metric and a plan, which not every policy has.
WATCHED_KINDS = tuple(kind for kind in KINDS if kind != "worst")
_USE_VIDEO = "write a file with --video out.gif"
_PAUSE = 1.5  # The last frame stays so long [s of the video].


@dataclass(frozen=True)
class WatchSettings:
    """What to watch.

    Attributes:
        task: One of `TASKS`.
        policy: A name of the task's policies, a stable-baselines3 zip, or module:Class.
        agents: Number of spacecraft; None takes the scenario's or the preset's own.
        preset: Of `lagros_envs.scenarios.PRESETS`; None takes "paper".
        disturbance: Of `WATCHED_KINDS`.
        bound: d_bar, in units of the state per second; None takes that of `BOUNDS`.
        seed: Seed of the episode, as for `env.reset`.
        scenario: File that `Scenario.save` has written; None draws one from the preset.
        safety_filter: Whether the policy wears the safety filter.
        video: File to write; None opens a window.
        speed: How much faster than real time it plays.
        seconds: End after so much time of the episode [s]; None plays to its end.

    Raises:
        ValueError: A value is not valid, or is of the other task.
        ImportError: What writes the video is not installed.
    """

    task: str = "spacecraft"
    policy: str = "lagros"
    agents: int | None = None
    preset: str | None = None
    disturbance: str = "uniform"
    bound: float | None = None
    seed: int = 0
    scenario: Path | None = None
    safety_filter: bool = False
    video: Path | None = None
    speed: float = 4.0
    seconds: float | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        if self.task not in TASKS:
            raise ValueError(unknown_name("task", self.task, TASKS))
        if self.disturbance not in WATCHED_KINDS:
            raise ValueError(unknown_name("disturbance", self.disturbance, WATCHED_KINDS))
        if self.preset is not None and self.preset not in PRESETS:
            raise ValueError(unknown_name("preset", self.preset, PRESETS))
        if self.agents is not None:
            check_whole("agents", self.agents, 1, MOST_AGENTS)
        check_seed(self.seed)
        if self.bound is not None:
            check_not_negative("bound", self.bound)
        check_positive("speed", self.speed)
        if self.seconds is not None:
            check_positive("seconds", self.seconds)
        if self.task == "cartpole":
            for name in ("agents", "preset", "scenario", "safety_filter"):
                if getattr(self, name):
                    option = name.replace("_", "-")
                    raise ValueError(f"--{option} is of the spacecraft; leave it out for cartpole")
        if self.video is not None:
            check_video_path(self.video)

    @property
    def disturbance_bound(self) -> float:
        """d_bar, given or the task's own."""
        return BOUNDS[self.task] if self.bound is None else self.bound


class Playback:
    """An environment and a policy in it, ready to play one episode.

    What the policy raises ends the episode as a failure; what was flown until then is shown.

    Args:
        settings: What to watch.

    Raises:
        ValueError: The policy's name is unknown, or the scenario is not valid or does not fit.
        OSError: The scenario cannot be read, or the policy has no weights.
        ImportError: An extra that the policy needs is not installed.
        SetupError: The constructor of a class of the user's own raises, or it cannot run.
    """

    def __init__(self, settings: WatchSettings) -> None:
        """Build environment and policy."""
        self.settings = settings
        self.frames = 0
        mode = "human" if settings.video is None else "rgb_array"
        self._game: _CartPoleGame | _SpacecraftGame = (
            _CartPoleGame(settings, mode)
            if settings.task == "cartpole"
            else _SpacecraftGame(settings, mode)
        )
        task = self._game.env.settings
        whole: int = task.steps
        self._period: float = task.control_period
        self._steps = whole
        if settings.seconds is not None and settings.seconds < whole * self._period:
            self._steps = max(1, math.ceil(settings.seconds / self._period - 1e-9))
        per_second = settings.speed / self._period  # control steps that a second shows
        highest = FRAME_RATES[settings.video.suffix.lower()] if settings.video else per_second
        self._stride = max(1, math.ceil(per_second / highest - 1e-9))
        self._rate = per_second / self._stride
        # What "human" plays at; an attribute of this environment alone.
        self._game.env.metadata = {
            **self._game.env.metadata,
            "render_fps": max(1, round(self._rate)),
        }

    def play(self) -> bytes | None:
        """Play the episode: film it, or show it in the window until it is closed.

        Returns:
            The content of the video, or None.

        Raises:
            ImportError: pygame is not installed.
            RuntimeError: No window can be opened here.
        """
        if self.settings.video is not None:
            kind = self.settings.video.suffix.lower()
            return video_bytes(kind, self._drawn(), self._rate)
        self._show()
        return None

    @property
    def error(self) -> str | None:
        """What the policy raised; None if nothing."""
        return self._game.error

    def close(self) -> None:
        """Close the window, if there is one."""
        self._game.env.close()

    def summary(self) -> list[str]:
        """Return what happened up to now, a line each."""
        settings = self.settings
        title = f"{settings.policy} on seed {settings.seed}"
        if settings.scenario is not None:
            title += f" in {settings.scenario}"
        title += f", {settings.disturbance}"
        if settings.disturbance != "none":
            title += f" d̄ = {settings.disturbance_bound:g}"
        lines = [f"{title}: {self._game.outcome()}"]
        counts: dict[str, int] = {}
        with Attempt():
            counts = self._game.counters()
        if counts:
            lines.append(", ".join(f"{name} {count}" for name, count in counts.items()))
        if self.error is not None:
            lines.append(f"the policy raised, which counts as a failure: {self.error}")
        return lines

    def _drawn(self) -> Iterator[Frame]:
        self._game.start()
        frame = self._game.env.render()
        self.frames = 1
        yield frame
        for step in range(1, self._steps + 1):
            over = self._game.step()
            if step % self._stride == 0 or over or step == self._steps:
                frame = self._game.env.render()
                self.frames += 1
                yield frame
            if over:
                break
        for _ in range(round(_PAUSE * self._rate)):
            yield frame

    def _show(self) -> None:
        from lagros_envs.canvas import import_pygame

        pygame = import_pygame()
        try:
            self._game.start()  # opens the window, and every step draws into it
        except pygame.error as error:
            raise RuntimeError(f"no window can be opened here ({error}); {_USE_VIDEO}") from error
        # Without a display SDL draws where nobody sees it, and says so in the driver's name alone.
        if pygame.display.get_driver() == "offscreen" and "SDL_VIDEODRIVER" not in os.environ:
            raise RuntimeError(f"no window can be opened here; {_USE_VIDEO}")
        for _ in range(self._steps):
            over = self._game.step()
            self.frames += 1
            if over or pygame.event.get(pygame.QUIT):
                break


class _CartPoleGame:
    """A cart-pole and its policy."""

    def __init__(self, settings: WatchSettings, render_mode: str) -> None:
        self._seed = settings.seed
        self.env: Any = gym.make(
            "lagros/CartPole-v0",
            disturbance=settings.disturbance,
            disturbance_bound=settings.disturbance_bound,
            render_mode=render_mode,
            disable_env_checker=True,
        ).unwrapped
        # On an environment without a window, which would stand still while this plans.
        self._planned: Any = gym.make("lagros/CartPole-v0", disable_env_checker=True).unwrapped
        seen, _ = self._planned.reset(seed=settings.seed)
        name, build = f"policy {settings.policy!r}", library.make_single_policy
        rehearse(name, build(settings.policy, self.env), seen, [True], ACTION)
        # Another one flies: a policy may count its calls without being told.
        self._policy: Any = build(settings.policy, self.env)
        self.error: str | None = None
        self._state: Any = None
        self._info: dict[str, Any] = {}
        self._observation: Any = None
        self._first = True

    def start(self) -> None:
        scenario = self._planned.scenario
        plan = library.make_planner().plan(scenario.initial_state, scenario.goal)
        options = {"nominal": np.asarray(plan.states)} if plan.solved else {}
        self._observation, self._info = self.env.reset(seed=self._seed, options=options)

    def step(self) -> bool:
        action: Any = None
        with Attempt() as attempt:
            if self._first:
                reseed(self._policy, self._seed)
            action, self._state, _ = ask(
                self._policy, self._observation, self._state, [self._first], ACTION
            )
        self.error = attempt.error
        if self.error is not None:
            return True
        self._first = False
        self._observation, _, terminated, truncated, self._info = self.env.step(action)
        return bool(terminated or truncated)

    def counters(self) -> dict[str, int]:
        return counted(self._policy, self._state)

    def outcome(self) -> str:
        info = self._info
        success = info["success"] and self.error is None
        reached = f"success at {info['success_time']:.1f} s" if success else "no success"
        return f"{reached}, {'fallen' if info['fallen'] else 'upright'}, " + _efforts(
            "effort", info["effort_to_success"], info["effort"]
        )


class _SpacecraftGame:
    """Spacecraft and the policy that flies all of them."""

    def __init__(self, settings: WatchSettings, render_mode: str) -> None:
        self._settings, self._seed = settings, settings.seed
        self._scenario = None if settings.scenario is None else Scenario.load(settings.scenario)
        preset = _preset(settings, self._scenario)
        bound = settings.disturbance_bound
        self.env: Any = spacecraft_v0.parallel_env(
            preset=preset,
            disturbance=settings.disturbance,
            disturbance_bound=bound,
            render_mode=render_mode,
        )
        self._options: dict[str, Any] = (
            {} if self._scenario is None else {"scenario": self._scenario}
        )
        # An environment without a window, which would stand still while this plans.
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

    def start(self) -> None:
        nominal = self._nominal()
        options = {} if nominal is None else {"nominal": nominal}
        self._observations, self._infos = self.env.reset(
            seed=self._seed, options=self._options | options
        )

    def step(self) -> bool:
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

    def counters(self) -> dict[str, int]:
        return counted(self._policy, self._state)

    def outcome(self) -> str:
        infos = self._infos.values()
        count = len(self._infos)
        arrived = sum(info["success"] for info in infos)
        collided = sum(info["collided"] for info in infos)
        to_success = sum(info["effort_to_success"] for info in infos) / count
        to_end = sum(info["effort"] for info in infos) / count
        return (
            f"{arrived} of {count} arrived, {collided} collided, in {self.env.time:.1f} s; "
            + _efforts("mean effort of an agent", to_success, to_end)
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
        check_interface(name, policy)
        with library.building(f"{name} with the safety filter"):
            return policy, library.make_filter(policy, self.env, settings.disturbance_bound)

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


def _efforts(what: str, to_success: float, to_end: float) -> str:
    """Return the effort as tables have it, and to the end of the episode where that is more."""
    text = f"{what} to success {to_success:.2f} N²s"
    return text if to_end == to_success else f"{text} (to the end {to_end:.2f} N²s)"
