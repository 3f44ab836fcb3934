"""The figures at the end of a training run as a terminal table of at most 80 columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from lagros_benchmarks.report.formats import number, percent, with_interval

if TYPE_CHECKING:
    from rich.table import Table

_Column = tuple[str, str, Callable[[dict[str, Any]], str]]


def _disturbance(row: dict[str, Any]) -> str:
    return "none" if row["disturbance"] == "none" else f"{row['disturbance']} {row['bound']:g}"


def _success(row: dict[str, Any]) -> str:
    return with_interval(row["success"], row["success_ci95"])


# Heading (two lines) and content of each column.
_COLUMNS: dict[str, tuple[_Column, ...]] = {
    "cartpole": (
        ("disturbance", "", _disturbance),
        ("episodes", "", lambda row: str(row["episodes"])),
        ("success", "%", _success),
        ("strict", "%", lambda row: percent(row["strict"])),
        ("fallen", "%", lambda row: percent(row["fallen"])),
        ("effort", "N²s", lambda row: number(row["effort_to_success"])),
        ("reward", "", lambda row: number(row["reward"])),
    ),
    "spacecraft": (
        ("disturbance", "", _disturbance),
        ("preset,", "agents", lambda row: f"{row['preset']}, {row['agents']}"),
        ("worlds", "", lambda row: str(row["worlds"])),
        ("success", "%", _success),
        ("strict", "%", lambda row: percent(row["strict_success"])),
        ("coll.", "%", lambda row: percent(row["collided"])),
        ("effort", "N²s", lambda row: number(row["effort_to_success"])),
        ("time", "s", lambda row: number(row["success_time"])),
    ),
}


def final_table(record: dict[str, Any]) -> Table:
    """Return the figures at the end of a run, one line for each condition.

    Args:
        record: As `run.train` returns it. Its efforts are those to the first success, else to the
            end of the episode, as in the tables of `lagros bench`; the record has more figures.
    """
    from rich import box
    from rich.table import Table

    columns = _COLUMNS[record["training"]["task"]]
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    for index, (heading, unit, _) in enumerate(columns):
        justify: Any = "right" if index else "left"
        table.add_column(f"{heading}\n{unit}".strip(), justify=justify, no_wrap=True)
    rows: Sequence[dict[str, Any]] = record["final"]
    for row in rows:
        table.add_row(*(content(row) for _, _, content in columns))
    return table
