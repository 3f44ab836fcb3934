"""A task's experiment from nothing: what the runs of all tasks have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from lagros_benchmarks.run.experiment import Progress
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.registry import find_task
from lagros_policies.learning.shards import claim

# Takes a line after each stage.
Say = Callable[[str], None]
Made = TypeVar("Made")


class Reproduction(Protocol):
    """All that the weights and the table of a task depend on; a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the settings that may change when a run goes on: they change no file of it."""

    @classmethod
    def for_task(cls, task: str, episodes: int | None, **asked: Any) -> Reproduction:
        """Return the settings of a run, with the usual number of episodes if None."""

    def make(self, folder: Path, progress: Progress, say: Say) -> None:
        """Make what is not yet in the folder."""

    def benchmark(self, folder: Path | None) -> BenchmarkSettings:
        """Return the benchmark of what lies in the folder; None takes what is shipped."""


def made_before(read: Callable[[], Made], say: Say) -> Made | None:
    """Return what a stage has left behind; None if it is not there, or damaged, which is said."""
    try:
        return read()
    except FileNotFoundError:
        return None
    except ValueError as error:
        say(f"{error}; it is made again")
        return None


def reproduce(
    folder: Path,
    settings: Reproduction,
    progress: Progress | None = None,
    say: Say | None = None,
) -> BenchmarkSettings:
    """Make all that the policies of a task need in a folder; a run that was interrupted goes on.

    `progress` is called with a title, the units done and the units in all, `say` with a line after
    each stage. The benchmark of what was made is returned, ready to run.

    Raises:
        ValueError: The folder holds a run of other settings.
    """
    folder = folder.absolute()
    record = {name: value for name, value in asdict(settings).items() if name not in settings.free}
    if "task" in record:
        # However it was called: ./puck.py or puck.py.
        record["task"] = find_task(record["task"]).name
    folder.mkdir(parents=True, exist_ok=True)
    claim(folder / "settings.json", record, "a run")
    settings.make(folder, progress or (lambda *_: None), say or (lambda _: None))
    return settings.benchmark(folder)
