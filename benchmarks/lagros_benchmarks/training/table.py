"""The figures at the end of a training run as a terminal table of at most 80 columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

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
    from rich import box
    from rich.table import Table

    task = find_task(record["training"]["task"])
    columns = course_of(task).columns(task)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    for index, (heading, unit, _) in enumerate(columns):
        justify: Any = "right" if index else "left"
        table.add_column(f"{heading}\n{unit}".strip(), justify=justify, no_wrap=True)
    rows: Sequence[dict[str, Any]] = record["final"]
    for row in rows:
        table.add_row(*(content(row) for _, _, content in columns))
    return table
