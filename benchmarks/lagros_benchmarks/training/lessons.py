"""Which part a task has in a training run."""

from __future__ import annotations

from lagros_benchmarks.tasks.cartpole.training import CartPoleLesson
from lagros_benchmarks.tasks.spacecraft.training import SpacecraftLesson
from lagros_benchmarks.training.run import Lesson
from lagros_benchmarks.training.settings import CartPoleTraining, SpacecraftTraining, Training


def lesson_of(training: Training, parallel_env: bool = False) -> Lesson:
    """Return the part of the run's task.

    Args:
        training: The run.
        parallel_env: See `SpacecraftLesson`.

    Raises:
        TypeError: The run is of no task.
    """
    if isinstance(training, CartPoleTraining):
        return CartPoleLesson(training)
    if isinstance(training, SpacecraftTraining):
        return SpacecraftLesson(training, parallel_env)
    raise TypeError(f"{type(training).__name__} is of no task; use a class derived from Training")
