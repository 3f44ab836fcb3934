"""What a run leaves behind: the files that were asked for, and the printed tables."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from lagros_benchmarks.commands.outputs import Delivery, Paths, check_outputs
from lagros_benchmarks.run.process import undone
from lagros_benchmarks.run.room import room_of

if TYPE_CHECKING:
    from rich.console import Console

    from lagros_benchmarks.run.experiment import BenchmarkRun, Row
    from lagros_benchmarks.run.workers import Progress
    from lagros_envs.task import Described


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
        episodes: Every episode (of worlds of agents every agent), one JSON object a line.
        scene: Trajectories of every policy in one world of agents.
        scene_world: Which world of the run that is, from 0.
        html: The table, figures and episodes to play, as one page for a browser.
    """

    json: Path | None = None
    csv: Path | None = None
    latex: Path | None = None
    markdown: Path | None = None
    figure: Path | None = None
    episodes: Path | None = None
    scene: Path | None = None
    scene_world: int = 0
    html: Path | None = None

    def check(
        self,
        task: Described | None = None,
        episodes: int | None = None,
        inputs: Paths | None = None,
        folders: Paths | None = None,
        kept: Path | None = None,
    ) -> None:
        """Check the files before the run and not after it.

        Args:
            task: The task of the run; None for one without scenes.
            episodes: Its number of episodes; None leaves the scene's world unchecked.
            inputs: Files that the run reads, by the option that names them.
            folders: Where it writes files of its own choice, likewise.
            kept: Where it keeps its work if it can.

        Raises:
            ValueError: A file cannot be written, two are one, a figure has an unknown suffix, or
                the task has no such figure, scene or page.
        """
        for option in ("--figure", "--scene"):
            path = self._paths[option]
            if path is not None:
                from lagros_benchmarks.report.figures import check_figure_path

                try:
                    check_figure_path(path)
                except ValueError as error:
                    raise ValueError(f"{option}: {error}") from None
        if self.figure is not None and task is not None and room_of(task).figures is None:
            raise ValueError(f"--figure: there is no figure of {task.name}; leave it out")
        if self.html is not None and task is not None and room_of(task).reels is None:
            raise ValueError(f"--html: there is no page of {task.name}; leave it out")
        if self.scene is not None:
            if task is None or room_of(task).scene is None:
                name = "the task" if task is None else task.name
                raise ValueError(f"--scene: {name} has no worlds of agents to draw; leave it out")
            if episodes is not None and not 0 <= self.scene_world < episodes:
                raise ValueError(
                    f"scene_world={self.scene_world!r} must be one of the run's worlds, 0 to "
                    f"{episodes - 1}"
                )
        check_outputs(self._paths, inputs, folders, kept)

    @property
    def _paths(self) -> dict[str, Path | None]:
        return {
            "--json": self.json,
            "--csv": self.csv,
            "--latex": self.latex,
            "--markdown": self.markdown,
            "--episodes-file": self.episodes,
            "--figure": self.figure,
            "--scene": self.scene,
            "--html": self.html,
        }

    def write(
        self, run: BenchmarkRun, rows: list[Row], progress: Progress | None = None
    ) -> Delivery:
        """Write the files, each on its own, and return what came of it.

        Args:
            run: The run.
            rows: Its rows.
            progress: Called while the episodes of the page fly.
        """
        from lagros_benchmarks.report import figures, records, tables
        from lagros_benchmarks.run import files

        delivery = Delivery()
        delivery.write_text(self.json, lambda: files.json_text(rows))
        delivery.write_text(self.csv, lambda: tables.csv_text(rows))
        delivery.write_text(self.latex, lambda: tables.latex_text(rows))
        delivery.write_text(self.markdown, lambda: tables.markdown_text(rows))
        delivery.write_text(
            self.episodes, lambda: files.json_lines_text(records.episode_objects(run))
        )
        delivery.write(self.figure, lambda path: figures.draw(rows, path))
        delivery.write(self.scene, lambda path: _draw_scene(run, self.scene_world, path))
        # Once, also where it is kept elsewhere: its episodes are flown for it.
        page = cache(lambda: _page(run, rows, progress))
        delivery.write(self.html, lambda path: files.write_atomic(path, page()))
        return delivery


def _draw_scene(run: BenchmarkRun, world: int, path: Path) -> None:
    # As in the run: what policies print is not ours, and where they go is no matter.
    with redirect_stdout(sys.stderr), undone():
        room_of(run.settings.description).part("scene")(run.settings, world, path)


def _page(run: BenchmarkRun, rows: Sequence[Row], progress: Progress | None) -> str:
    from lagros_benchmarks.report.page.assemble import bench_page

    with redirect_stdout(sys.stderr), undone():
        return bench_page(run, rows, progress)


def print_report(rows: Sequence[Row], console: Console | None = None) -> None:
    """Print the tables, the paired differences and what raised."""
    from rich.console import Console
    from rich.text import Text

    from lagros_benchmarks.report import tables
    from lagros_benchmarks.report.formats import by_condition

    console = console or Console(highlight=False)
    for group in by_condition(rows):
        console.print(tables.terminal_table(group))
        if not tables.texts(group[0]).framed(group[0]):
            console.print()  # where a frame would end in an empty line
        for line in tables.comparison_lines(group):
            # As text, here and below: names and units may hold what rich takes for markup.
            console.print(Text(line))
        console.print()
    for title, table in tables.sweep_tables(rows):
        console.print(Text(title))
        console.print(table)
        console.print()
    for line in (tables.legend(rows), *tables.error_lines(rows)):
        console.print(Text(line))
