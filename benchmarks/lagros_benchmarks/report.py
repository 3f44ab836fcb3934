"""What a run leaves behind: the printed tables, and the files that were asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lagros_benchmarks.experiment import BenchmarkRun, Row


@dataclass(frozen=True)
class Outputs:
    """Where the results of a run go; None leaves one out.

    Attributes:
        json: All figures of the run, a list with one object per policy and condition.
        csv: The scalar ones.
        latex: The table.
        markdown: The table; success by condition if there are several.
        figure: What is apt: the error or the success and effort of one condition, success and
            effort of several, or success and time against the number of agents.
        episodes: Every episode (of the spacecraft every agent), one JSON object a line.
        scene: Trajectories of every policy in one world of spacecraft.
        scene_world: Which world of the run that is, from 0.
    """

    json: Path | None = None
    csv: Path | None = None
    latex: Path | None = None
    markdown: Path | None = None
    figure: Path | None = None
    episodes: Path | None = None
    scene: Path | None = None
    scene_world: int = 0

    def check(self, task: str = "cartpole", episodes: int | None = None) -> None:
        """Check the files before the run and not after it.

        Args:
            task: The task of the run.
            episodes: Its number of episodes; None leaves the scene's world unchecked.

        Raises:
            ValueError: A folder cannot be made, a figure has an unknown suffix, or the task has no
                such scene.
        """
        for path in (self.figure, self.scene):
            if path is not None:
                from lagros_benchmarks.figures import check_figure_path

                check_figure_path(path)
        if self.scene is not None:
            if task != "spacecraft":
                raise ValueError(f"scene: {task} has none; leave out --scene, or take spacecraft")
            if episodes is not None and not 0 <= self.scene_world < episodes:
                raise ValueError(
                    f"scene_world={self.scene_world!r} must be one of the run's worlds, 0 to "
                    f"{episodes - 1}"
                )
        files = (self.json, self.csv, self.latex, self.markdown, self.figure, self.episodes)
        for path in (*files, self.scene):
            if path is None:
                continue
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ValueError(f"cannot write {str(path)!r}: {error.strerror}") from error

    def write(self, run: BenchmarkRun, rows: list[Row]) -> Iterator[Path]:
        """Write the files, and yield the path of each."""
        from lagros_benchmarks import figures, files, records, tables

        if self.json is not None:
            yield files.write_json(self.json, rows)
        if self.csv is not None:
            yield files.write_atomic(self.csv, tables.csv_text(rows))
        if self.latex is not None:
            yield files.write_atomic(self.latex, tables.latex_text(rows))
        if self.markdown is not None:
            yield files.write_atomic(self.markdown, tables.markdown_text(rows))
        if self.episodes is not None:
            yield files.write_json_lines(self.episodes, records.episode_objects(run))
        if self.figure is not None:
            yield figures.draw(rows, self.figure)
        if self.scene is not None:
            from lagros_benchmarks.runner import fly_scene
            from lagros_benchmarks.scene_figure import scene_figure

            yield scene_figure(fly_scene(run.settings, self.scene_world), self.scene)


def print_report(rows: Sequence[Row]) -> None:
    """Print the tables, the paired differences and what raised."""
    from rich.console import Console
    from rich.text import Text

    from lagros_benchmarks import tables
    from lagros_benchmarks.formats import by_condition

    console = Console(highlight=False)
    for group in by_condition(rows):
        console.print(tables.terminal_table(group))
        if group[0]["task"] == "spacecraft":
            console.print()  # its tables have no frame, which ends in an empty line
        for line in tables.comparison_lines(group):
            console.print(line)
        console.print()
    for title, table in tables.sweep_tables(rows):
        # As text: "[ms]" is markup to rich.
        console.print(Text(title))
        console.print(table)
        console.print()
    for line in (tables.legend(rows), *tables.error_lines(rows)):
        # As text: the message of an exception may hold what rich takes for markup.
        console.print(Text(line))
