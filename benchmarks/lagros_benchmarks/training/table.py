"""The figures at the end of a training run as a terminal table of at most 80 columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lagros_benchmarks.report.tables import plain_table
from lagros_benchmarks.training.course import course_of
from lagros_envs.registry import find_task

if TYPE_CHECKING:
    from rich.table import Table


def final_table(record: dict[str, Any]) -> Table:
    """Return the figures at the end of a run, one line for each condition.

    Args:
        record: As `run.train` returns it. Its efforts are those to the first success, else to the
            end of the episode, as in the tables of `lagros bench`; the record has more figures.
    """
    task = find_task(record["training"]["task"])
    columns = course_of(task).columns(task)
    headings = [f"{heading}\n{unit}".strip() for heading, unit, _ in columns]
    rows = [[content(row) for _, _, content in columns] for row in record["final"]]
    return plain_table(headings, rows)
