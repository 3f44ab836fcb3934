"""What a task brings to its training by reinforcement: settings, a lesson, what is shown of it.

Nothing here needs torch; the lesson does, and is imported when it begins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lagros_benchmarks.report.formats import number, percent, with_interval
from lagros_benchmarks.run.room import room_of
from lagros_benchmarks.training.settings import Ppo, Sac, SingleTraining, Td3, Training
from lagros_envs.checks import shown, suggestion
from lagros_envs.registry import find_task
from lagros_envs.task import Described, Task

# Name in the curves, title, factor.
Panel = tuple[str, str, float]
# Heading (two lines) and content of a column of the table at the end.
Column = tuple[str, str, Callable[[dict[str, Any]], str]]


class SingleCourse:
    """Learning to control one body.

    Attributes:
        takes_parallel: Whether the rows may come from a parallel environment of PettingZoo.
        abscissa: What the curves are drawn over.
    """

    takes_parallel = False
    abscissa = "control steps [millions]"

    def trainings(self, task: Task) -> Mapping[str, Training]:
        """Return the settings of every algorithm, by its name."""
        shared: dict[str, Any] = {
            "disturbance_bound": task.defaults.bound,
            "task": task.name,
        }
        # A rollout is an episode of every world; a segment is three of them.
        rollout: dict[str, Any] = {"rollout_steps": task.steps, "batch_size": 16 * task.steps}
        buffered: dict[str, Any] = {"segments": 24, "segment_steps": 125, "worlds": 128}
        return {
            "ppo": SingleTraining(Ppo(**rollout), segment_steps=3 * task.steps, **shared),
            "sac": SingleTraining(Sac(), **buffered, **shared),
            "td3": SingleTraining(Td3(), **buffered, **shared),
        }

    def panels(self, task: Task) -> tuple[Panel, ...]:
        """Return what is drawn of the learning curves."""
        unit = f" [{task.squared_unit} s]" if task.squared_unit else ""
        collided = (("collided", "collided [%]", 100.0),) if task.most_discs else ()
        return (
            ("success", "success [%]", 100.0),
            ("strict", "strict success [%]", 100.0),
            *collided,
            ("reward", "reward of the task", 1.0),
            ("effort", f"effort of whole episodes{unit}", 1.0),
        )

    def columns(self, task: Task) -> tuple[Column, ...]:
        """Return what is told of the end."""
        unit = task.squared_unit and f"{task.squared_unit}s"
        collided: tuple[Column, ...] = ()
        if task.most_discs:
            collided = (("coll.", "%", lambda row: percent(row["collided"])),)
        return (
            ("disturbance", "", disturbance),
            ("episodes", "", lambda row: str(row["episodes"])),
            ("success", "%", success),
            ("strict", "%", lambda row: percent(row["strict"])),
            ("fallen", "%", lambda row: percent(row["fallen"])),
            *collided,
            ("effort", unit, lambda row: number(row["effort_to_success"])),
            ("reward", "", lambda row: number(row["reward"])),
        )

    def lesson(self, training: Any, parallel_env: bool = False) -> Any:
        """Return the task's part of a run, a `run.Lesson`."""
        from lagros_benchmarks.training.single import SingleLesson

        return SingleLesson(training)


COURSE = SingleCourse()


def disturbance(row: dict[str, Any]) -> str:
    """Return the disturbance of a row."""
    return "none" if row["disturbance"] == "none" else f"{row['disturbance']} {row['bound']:g}"


def success(row: dict[str, Any]) -> str:
    """Return the success of a row with its interval."""
    return with_interval(row["success"], row["success_ci95"])


def course_of(task: Described) -> Any:
    """Return how a task is learned."""
    return room_of(task).part("train")


def lesson_of(training: Training, parallel_env: bool = False) -> Any:
    """Return the task's part of a run, a `run.Lesson`, with PettingZoo's rows or ours."""
    return course_of(find_task(training.task)).lesson(training, parallel_env)


def default_training(task: str, algorithm: str, others: Sequence[str] = ()) -> Training:
    """Return the settings of a task and algorithm.

    Args:
        task: Name of the task.
        algorithm: Of reinforcement learning.
        others: What else the command takes in its place, for the message.

    Raises:
        ValueError: There are none.
    """
    described = find_task(task)
    known: Mapping[str, Training] = course_of(described).trainings(described)
    if algorithm not in known:
        raise ValueError(
            f"--algo {shown(algorithm)} is not known for {task}."
            f"{suggestion(algorithm, (*known, *others))} Use one of {', '.join((*known, *others))}"
        )
    return known[algorithm]
