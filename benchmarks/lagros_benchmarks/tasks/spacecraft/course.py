"""How spacecraft are learned: the settings of a run, and what is shown of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from lagros_benchmarks.report.formats import number, percent
from lagros_benchmarks.training.course import Column, Panel, disturbance, success
from lagros_benchmarks.training.settings import Algorithm, Ppo, Training
from lagros_envs.checks import (
    check_disturbance_bound,
    check_each,
    check_name,
    check_several,
    check_whole,
)
from lagros_envs.tasks.spacecraft.scenarios import MOST_AGENTS, PRESETS
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, settings_for


@dataclass(frozen=True)
class SpacecraftTraining(Training):
    """A run with spacecraft, one policy for all; attributes as in `Training`, and these.

    Attributes:
        effort_weight: Higher than that of the task, as the weight of progress is.
        preset: Preset of the scenarios.
        agents: Agents in each world.
        time_limit: Of an episode in training [s]: most of the 45 s of the task are spent at the
            goal, where there is little left to learn.
        progress_weight: Replaces that of the task's reward in training.
        goal_weight: Reward per second within the goal's radius.
        nearness_weight: Reward per second at a touch of another agent, negative sign applied.
        nearness_range: Distance beyond touching at which that has fallen to nothing [m].
        obstacle_weight: The same at a touch of an obstacle.
        obstacle_range: Its distance [m].
        first_share: Share of both weights that counts in the first segment.
        growth: Share of the run after which they count in full.
        final_agents: Numbers of agents in the evaluation at the end.
        final_bounds: Their d_bar.
        final_presets: Their presets.

    Raises:
        ValueError: A value is out of range.
    """

    task = "spacecraft"
    positive: ClassVar[tuple[str, ...]] = (
        "time_limit",
        "nearness_range",
        "obstacle_range",
        "first_share",
        "growth",
    )
    not_negative: ClassVar[tuple[str, ...]] = (
        *Training.not_negative,
        "progress_weight",
        "goal_weight",
        "nearness_weight",
        "obstacle_weight",
    )
    counts: ClassVar[tuple[str, ...]] = (*Training.counts, "agents")
    algorithm: Algorithm = field(
        default_factory=lambda: Ppo(
            rollout_steps=128,
            batch_size=4608,
            epochs=5,
            learning_rate=7e-4,
            discount=0.995,
            initial_log_std=-1.5,
        )
    )
    segments: int = 20
    segment_steps: int = 2560
    worlds: int = 24
    effort_weight: float = 0.05
    disturbance_bound: float = 0.4
    curve_episodes: int = 20
    final_episodes: int = 200
    preset: str = "paper"
    agents: int = 6
    time_limit: float = 20.0
    progress_weight: float = 1.5
    goal_weight: float = 0.5
    nearness_weight: float = 12.0
    nearness_range: float = 0.25
    obstacle_weight: float = 12.0
    obstacle_range: float = 0.15
    first_share: float = 0.4
    growth: float = 0.6
    final_agents: tuple[int, ...] = (6,)
    final_bounds: tuple[float, ...] = (0.4,)
    final_presets: tuple[str, ...] = ("paper", "open")

    def __post_init__(self) -> None:
        super().__post_init__()
        for preset in (self.preset, *self.final_presets):
            check_name("preset", preset, PRESETS)
        check_each("final_agents", self.final_agents, 1, MOST_AGENTS)
        check_whole("agents", self.agents, 1, MOST_AGENTS)
        for name in ("final_bounds", "final_presets"):
            check_several(name, getattr(self, name), "a tuple with something in it")
        for bound in self.final_bounds:
            check_disturbance_bound("final_bounds", bound)

    @property
    def rows(self) -> int:
        """Agents that learn side by side."""
        return self.worlds * self.agents

    @property
    def label(self) -> str:
        """Name of the runs that differ in the seed alone."""
        usual = (self.preset, self.agents) == (type(self).preset, type(self).agents)
        return super().label if usual else f"{super().label}-{self.preset}-{self.agents}"

    def in_worlds(self, preset: str | None, agents: int | None) -> SpacecraftTraining:
        """Return the run in worlds of another preset or number of agents, judged in them alone.

        As many agents learn, in episodes of the same share of the time limit.

        Args:
            preset: Name of the preset; None for that of this run.
            agents: N; None for that of the preset.

        Raises:
            ValueError: There is no such preset, or it has no worlds of so many.
        """
        name = self.preset if preset is None else preset
        check_name("preset", name, PRESETS)
        count = PRESETS[name].agents if agents is None else agents
        check_whole("agents", count, 1, MOST_AGENTS)
        new = settings_for(PRESETS[name].for_agents(count)).time_limit
        old = settings_for(PRESETS[self.preset].for_agents(self.agents)).time_limit
        return replace(
            self,
            preset=name,
            agents=count,
            worlds=max(1, round(self.rows / count)),
            time_limit=float(round(self.time_limit * new / old)),
            final_agents=(count,),
            final_presets=(name,),
            # As many agents are judged.
            final_episodes=max(1, round(self.final_episodes * self.agents / count)),
            curve_episodes=max(1, round(self.curve_episodes * self.agents / count)),
        )


class SpacecraftCourse:
    """Learning to fly many agents by one policy; see `training.course.SingleCourse`."""

    takes_parallel = True
    abscissa = "control steps of all agents [millions]"

    def trainings(self, task: SpacecraftSettings) -> Mapping[str, Training]:
        """Return the settings of every algorithm, by its name."""
        return {"ppo": SpacecraftTraining()}

    def panels(self, task: SpacecraftSettings) -> tuple[Panel, ...]:
        """Return what is drawn of the learning curves."""
        return (
            ("success", "success [%]", 100.0),
            ("strict_success", "strict success [%]", 100.0),
            ("collided", "collided [%]", 100.0),
        )

    def columns(self, task: SpacecraftSettings) -> tuple[Column, ...]:
        """Return what is told of the end."""
        return (
            ("disturbance", "", disturbance),
            ("preset,", "agents", lambda row: f"{row['preset']}, {row['agents']}"),
            ("worlds", "", lambda row: str(row["worlds"])),
            ("success", "%", success),
            ("strict", "%", lambda row: percent(row["strict_success"])),
            ("coll.", "%", lambda row: percent(row["collided"])),
            ("effort", "N²s", lambda row: number(row["effort_to_success"])),
            ("time", "s", lambda row: number(row["success_time"])),
        )

    def lesson(self, training: SpacecraftTraining, parallel_env: bool = False) -> Any:
        """Return the part of a run, a `run.Lesson`."""
        from lagros_benchmarks.tasks.spacecraft.training import SpacecraftLesson

        return SpacecraftLesson(training, parallel_env)


COURSE = SpacecraftCourse()
