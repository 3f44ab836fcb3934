"""One episode with frames of it, for `lagros watch`."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lagros_envs  # noqa: F401  (registers the environments)
from lagros_benchmarks.report.video import FRAME_RATES, Frame, check_video_path, video_bytes
from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.run.room import room_of
from lagros_benchmarks.run.settings import check_policy, unknown_name
from lagros_benchmarks.run.workers import Progress, untold
from lagros_envs.canvas import import_pygame
from lagros_envs.checks import (
    check_disturbance_bound,
    check_fields,
    check_positive,
    check_seed,
    check_whole,
)
from lagros_envs.disturbances import KINDS
from lagros_envs.registry import find_task, first_task
from lagros_envs.task import Described

# Slower films would have pictures without end, faster ones none.
SLOWEST, FASTEST = 0.05, 1000.0
# "worst" needs a metric and a plan, which not every policy has.
WATCHED_KINDS = tuple(kind for kind in KINDS if kind != "worst")
_USE_VIDEO = "write a file with --video out.gif"
_PAUSE = 1.5  # The last frame stays so long [s of the video].


@dataclass(frozen=True)
class WatchSettings:
    """What to watch.

    Attributes:
        task: As in `lagros watch TASK`.
        policy: A name of the task's policies, a stable-baselines3 zip, or module:Class.
        agents: Number of agents; None takes the scenario's or the preset's own.
        preset: Of the task's presets; None takes its default.
        disturbance: Of `WATCHED_KINDS`.
        bound: d_bar, in units of the state per second; None takes the task's own.
        seed: Seed of the episode, as for `env.reset`.
        scenario: File that `Scenario.save` has written; None draws one from the preset.
        safety_filter: Whether the policy uses the safety filter.
        video: File to write; None opens a window, unless a page is made.
        page: Whether it is played in a page for a browser.
        speed: How much faster than real time it plays; None takes the task's own.
        seconds: End after so much time of the episode [s]; None plays to its end.

    Raises:
        ValueError: A value is not valid, or is for worlds of many agents and the task is of one
            body.
        ImportError: What writes the video is not installed.
    """

    task: str = field(default_factory=first_task)
    policy: str = "lagros"
    agents: int | None = None
    preset: str | None = None
    disturbance: str = "uniform"
    bound: float | None = None
    seed: int = 0
    scenario: Path | None = None
    safety_filter: bool = False
    video: Path | None = None
    page: bool = False
    speed: float | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        presets, most = self.described.presets, self.described.most_agents
        check_policy(self.policy, self.task)
        if self.disturbance not in WATCHED_KINDS:
            raise ValueError(unknown_name("disturbance", self.disturbance, WATCHED_KINDS))
        for name in ("agents", "preset", "scenario", "safety_filter") if most == 1 else ():
            if getattr(self, name):
                option = name.replace("_", "-")
                raise ValueError(
                    f"--{option} is for worlds of many agents; leave it out for {self.task}"
                )
        if self.preset is not None and self.preset not in presets:
            raise ValueError(unknown_name("preset", self.preset, presets))
        if self.agents is not None:
            check_whole("agents", self.agents, 1, most)
        check_seed(self.seed)
        if self.bound is not None:
            check_disturbance_bound("bound", self.bound)
        if self.speed is not None:
            check_positive("speed", self.speed)
            if not SLOWEST <= self.speed <= FASTEST:
                raise ValueError(
                    f"speed={self.speed!r} must be between {SLOWEST:g} and {FASTEST:g}"
                )
        if self.seconds is not None:
            check_positive("seconds", self.seconds)
        if self.video is not None:
            if self.page:
                raise ValueError(
                    f"video={str(self.video)!r}: a page is asked for, too; leave one of them out"
                )
            check_video_path(self.video)

    @property
    def described(self) -> Described:
        """The task."""
        return find_task(self.task)

    @property
    def disturbance_bound(self) -> float:
        """d_bar, given or the task's own."""
        return self.described.defaults.bound if self.bound is None else self.bound

    @property
    def playing_speed(self) -> float:
        """How much faster than real time it plays, given or the task's own."""
        return self.described.defaults.speed if self.speed is None else self.speed


class Playback:
    """An environment and a policy in it, ready to play one episode.

    What the policy raises ends the episode as a failure; what was flown until then is shown.

    Raises:
        ValueError: The policy's name is unknown, or the scenario is not valid or does not fit.
        OSError: The scenario cannot be read, or the policy has no weights.
        ImportError: An extra that the policy needs is not installed.
        SetupError: The constructor of a class of the user's own raises, or it cannot run.
    """

    def __init__(self, settings: WatchSettings) -> None:
        if not settings.page:
            import_pygame()
        self.settings = settings
        self.frames = 0
        self._game: Any = room_of(settings.described).part("game")(settings)
        task = self._game.env.settings
        whole: int = task.steps
        self._period: float = task.control_period
        self._steps = whole
        if settings.seconds is not None and settings.seconds < whole * self._period:
            self._steps = max(1, math.ceil(settings.seconds / self._period - 1e-9))
        per_second = settings.playing_speed / self._period  # control steps that a second shows
        wanted = FRAME_RATES[".mp4" if settings.video is None else settings.video.suffix.lower()]
        # Frames of a control step, or control steps of a frame.
        self._parts = math.ceil(wanted / per_second - 1e-9) if self._game.divisible else 1
        self._stride = max(1, math.floor(per_second / wanted + 1e-9))
        self._rate = per_second * self._parts / self._stride

    def play(self, tell: Progress = untold) -> bytes | None:
        """Play the episode: film it, or show it in the window until it is closed.

        Args:
            tell: Called with the control steps that are filmed, and those of the whole episode.

        Returns:
            The content of the video, or None.

        Raises:
            ImportError: pygame is not installed.
            RuntimeError: No window can be opened here.
        """
        if self.settings.video is not None:
            kind = self.settings.video.suffix.lower()
            return video_bytes(kind, self._drawn(tell), self._rate)
        self._show()
        return None

    def page(self) -> str:
        """Play the episode to its end, and return it as a page for a browser."""
        from lagros_benchmarks.report.page.assemble import page_text
        from lagros_benchmarks.report.page.contents import of_episode

        settings, game = self.settings, self._game
        camera = room_of(settings.described).part("camera")()
        game.begin()
        camera.note(game.loop)
        for _ in range(self._steps):
            over = game.step()
            if game.error is None:
                camera.note(game.loop)
            if over:
                break
        condition: dict[str, Any] = {
            "disturbance": settings.disturbance,
            "bound": settings.disturbance_bound,
        }
        if settings.described.most_agents > 1:
            condition["agents"] = game.env.num_agents
        reel = camera.reel(game.error)
        content = of_episode(settings.described, settings.policy, condition, settings.seed, reel)
        return page_text({**content, "speed": settings.playing_speed})

    @property
    def error(self) -> str | None:
        """What the policy raised; None if nothing."""
        error: str | None = self._game.error
        return error

    def close(self) -> None:
        """Close the window, if there is one."""
        self._game.close()

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

    def _drawn(self, tell: Progress) -> Iterator[Frame]:
        self._game.begin()
        self._game.open("rgb_array", self._rate)
        for frame in self._frames(tell):
            yield frame
        for _ in range(round(_PAUSE * self._rate)):
            yield frame

    def _show(self) -> None:
        pygame = import_pygame()
        # First: a window would stand still while this plans.
        self._game.begin()
        try:
            self._game.open("human", self._rate)
        except pygame.error as error:
            raise RuntimeError(f"no window can be opened here ({error}); {_USE_VIDEO}") from error
        # Without a display SDL draws where nobody sees it, and says so in the driver's name alone.
        if pygame.display.get_driver() == "offscreen" and "SDL_VIDEODRIVER" not in os.environ:
            raise RuntimeError(f"no window can be opened here; {_USE_VIDEO}")
        for _ in self._frames():
            if pygame.event.get(pygame.QUIT):
                break

    def _frames(self, tell: Progress = untold) -> Iterator[Any]:
        """Play the episode, and yield what is drawn of it: frames, or None from a window."""
        self.frames = 1
        yield self._game.draw(1.0)
        for step in range(1, self._steps + 1):
            over = self._game.step()
            tell("film", self._steps if over else step, self._steps)
            if step % self._stride == 0 or over or step == self._steps:
                for part in range(1, self._parts + 1):
                    self.frames += 1
                    yield self._game.draw(part / self._parts)
            if over:
                break
