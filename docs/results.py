"""Every published row of `benchmarks/results` in one table: the site's results page shows it.

    python docs/results.py          # as Markdown

A row is one policy under one condition. Where two files hold the same, the one of more episodes
is taken.
"""

from __future__ import annotations

import html
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from lagros_benchmarks.report.formats import number, percent, policy_label

RESULTS = Path(__file__).resolve().parents[1] / "benchmarks" / "results"
Row = dict[str, Any]
_NEEDED = {"task", "policy", "disturbance", "bound", "episodes", "success_rate", "effort_mean"}


class Column(NamedTuple):
    """A column: its heading, its text, and what it is to the reader: `choice` or `number`."""

    heading: str
    text: Callable[[Row], str]
    kind: str


def _system(row: Row) -> str:
    preset = row.get("preset")
    return f"{row['task']}, {preset}" if preset else str(row["task"])


def _policy(row: Row) -> str:
    return policy_label(row["policy"], 40) + (" + filter" if row.get("safety_filter") else "")


def _microseconds(row: Row) -> str:
    time = row.get("step_time_median_s")
    return "–" if time is None else number(1e6 * float(time))


COLUMNS = (
    Column("system", _system, "choice"),
    Column("policy", _policy, "choice"),
    Column("disturbance", lambda row: str(row["disturbance"]), "choice"),
    Column("d̄", lambda row: f"{row['bound']:g}", "number"),
    Column("agents", lambda row: str(row.get("agents") or 1), "number"),
    Column("episodes", lambda row: str(row["episodes"]), "number"),
    Column("success [%]", lambda row: percent(row["success_rate"]), "number"),
    Column("strict [%]", lambda row: percent(row.get("strict_success_rate")), "number"),
    Column("proved [%]", lambda row: percent(row.get("guaranteed_rate")), "number"),
    Column("effort", lambda row: number(row["effort_mean"]), "number"),
    Column("Δt [µs]", _microseconds, "number"),
    Column("file", lambda row: row["file"], "text"),
)


def rows(folder: Path = RESULTS) -> list[Row]:
    """Return the rows of all files of a folder, in the order of system, kind, bound and policy."""
    kept: dict[tuple[Any, ...], Row] = {}
    for path in sorted(folder.glob("*.json")):
        for row in _rows_of(json.loads(path.read_text(encoding="utf-8"))):
            row["file"] = path.stem
            names = ("channels", "preset", "agents", "safety_filter", "initial_error")
            key = (
                *(row[name] for name in ("task", "policy", "disturbance", "bound")),
                *(row.get(name) or None for name in names),
            )
            if key not in kept or row["episodes"] > kept[key]["episodes"]:
                kept[key] = row
    # An error at the start is another question: `lagros suite` has a page for it.
    found = [row for row in kept.values() if not row.get("initial_error")]
    return sorted(
        found,
        key=lambda row: (
            _system(row),
            row["disturbance"],
            row["bound"],
            row.get("agents") or 1,
            _policy(row),
        ),
    )


def _rows_of(held: Any) -> Iterator[Row]:
    listed = held.get("rows", []) if isinstance(held, dict) else held
    for row in listed if isinstance(listed, list) else []:
        if isinstance(row, dict) and row.keys() >= _NEEDED:
            yield row


def markdown(found: list[Row]) -> str:
    """Return the table as Markdown."""
    lines = [
        [column.heading for column in COLUMNS],
        ["---:" if column.kind == "number" else "---" for column in COLUMNS],
        *([column.text(row) for column in COLUMNS] for row in found),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(column: Column, row: Row) -> str:
    place = ' class="text-right"' if column.kind == "number" else ""
    return f"<td{place}>{html.escape(column.text(row))}</td>"


def page(found: list[Row]) -> str:
    """Return the table as HTML, which `_static/filter.js` lets a reader filter and sort."""
    heads = "".join(
        f'<th scope="col" data-kind="{column.kind}">{html.escape(column.heading)}</th>'
        for column in COLUMNS
    )
    body = "\n".join(
        f"<tr>{''.join(_cell(column, row) for column in COLUMNS)}</tr>" for row in found
    )
    return (
        '<div class="table-wrapper filterable"><table class="docutils">'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


if __name__ == "__main__":
    print(markdown(rows()))  # noqa: T201 - what it is for
