"""What the tables of an environment of somebody else's say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lagros_benchmarks.report.formats import (
    LONGEST_LABEL,
    Column,
    condition_title,
    mark,
    markdown_table,
    milliseconds,
    number,
    percent,
    policy_label,
    row_label,
)
from lagros_benchmarks.run.experiment import Row

_LEGEND = (
    "Return: mean of the undiscounted sum of the rewards, with 95 % interval; worst: the least of "
    "an episode; length: mean steps; ended: episodes that the environment ended before the limit "
    "of steps; Δt: time of one call of predict. There is no plan here, hence no tube, and nothing "
    "is proved."
)
_SUCCESS = " Success is what the environment itself says at the end of an episode."


def framed(row: Row) -> bool:
    """Return whether the terminal table has room for a frame in 80 columns."""
    return False


def legend(row: Row) -> str:
    """Return what the columns mean."""
    return _LEGEND if row["success_rate"] is None else _LEGEND + _SUCCESS


def columns(row: Row) -> tuple[Column, ...]:
    """Return heading (two lines) and content of each column of the terminal and LaTeX tables."""
    begin: tuple[Column, ...] = (
        ("policy", "", row_label),
        ("return", "mean", _with_interval),
        ("return", "worst", lambda row: number(row["return_worst"])),
        ("length", "steps", lambda row: number(row["length_mean"])),
        ("ended", "%", lambda row: percent(row["terminated_rate"])),
    )
    end: tuple[Column, ...] = (
        ("Δt ms", "median", lambda row: milliseconds(row["step_time_median_s"])),
        ("Δt ms", "p99", lambda row: milliseconds(row["step_time_p99_s"])),
    )
    if row["success_rate"] is None:
        return (*begin, *end)
    return (*begin, ("success", "%", lambda row: percent(row["success_rate"])), *end)


def sweeps(rows: Sequence[Row]) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Yield the tables of several conditions side by side: none, the grid of Markdown apart."""
    yield from ()


def title(row: Row) -> str:
    """Return the title of the table of a condition."""
    return f"{condition_title(row)}, {row['episodes']} episodes, seed {row['seed']}"


def ordered(group: Sequence[Row]) -> Sequence[Row]:
    """Return the rows of a condition as the table lists them."""
    return group


def comparison_lines(group: Sequence[Row]) -> Iterator[str]:
    """Yield a line per policy: its paired difference in return from the first."""
    if len(group) < 2:
        return
    first = group[0]["policy"]
    yield f"Against {policy_label(first)} on the same episodes:"
    for row in group[1:]:
        versus, name = row["versus"][first], f"{policy_label(row['policy']):<{LONGEST_LABEL}}"
        interval = versus["return_difference_ci95"]
        between = "" if interval is None else f" ({number(interval[0])} to {number(interval[1])})"
        gain = number(versus["return_difference"])
        yield f"  {name} return {gain if gain.startswith(('-', '–')) else f'+{gain}'}{between}"


def markdown_grids(groups: Sequence[Sequence[Row]]) -> list[str]:
    """Return the mean return by condition."""
    headings = ["disturbance", "d̄", *(policy_label(row["policy"]) for row in groups[0])]
    contents = [
        [
            group[0]["disturbance"],
            f"{group[0]['bound']:g}",
            *(number(row["return_mean"]) + mark(row) for row in group),
        ]
        for group in groups
    ]
    return [markdown_table(headings, contents)]


def _with_interval(row: Row) -> str:
    mean, interval = number(row["return_mean"]), row["return_ci95"]
    return mean if interval is None else f"{mean} ({number(interval[0])} to {number(interval[1])})"
