"""The rows of a benchmark as a terminal table of at most 80 columns, as CSV and as LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from lagros_benchmarks.report.formats import (
    by_condition,
    condition_title,
    markdown_rows,
    names_lines,
    raised_lines,
)
from lagros_benchmarks.run.experiment import Row
from lagros_benchmarks.run.room import room_named

if TYPE_CHECKING:
    from rich.table import Table

    from lagros_benchmarks.report.formats import Column


_WIDTH = 80  # of a terminal


class _Texts(Protocol):
    """What a module that words the tables of a task has."""

    def framed(self, row: Row) -> bool: ...
    def legend(self, row: Row) -> str: ...
    def columns(self, row: Row) -> tuple[Column, ...]: ...
    def title(self, row: Row) -> str: ...
    def ordered(self, group: Sequence[Row]) -> Sequence[Row]: ...
    def comparison_lines(self, group: Sequence[Row]) -> Iterator[str]: ...
    def markdown_grids(self, groups: Sequence[Sequence[Row]]) -> list[str]: ...
    def sweeps(self, rows: Sequence[Row]) -> Iterator[tuple[str, list[str], list[list[str]]]]: ...


def texts(row: Row) -> _Texts:
    """Return what words the tables of a row's task."""
    found: _Texts = room_named(row["task"]).part("tables")
    return found


def legend(rows: Sequence[Row]) -> str:
    """Return what the columns mean."""
    return texts(rows[0]).legend(rows[0])


def terminal_table(group: Sequence[Row]) -> Table:
    """Return the rich table of the rows of one condition."""
    words = texts(group[0])
    shown = words.columns(group[0])
    headings = [f"{heading}\n{unit}".strip() for heading, unit, _ in shown]
    contents = [[content(row) for _, _, content in shown] for row in words.ordered(group)]
    return plain_table(headings, contents, words.title(group[0]), words.framed(group[0]))


def comparison_lines(group: Sequence[Row]) -> Iterator[str]:
    """Yield how the policies of one condition differ on the same episodes."""
    return texts(group[0]).comparison_lines(group)


def sweep_tables(rows: Sequence[Row]) -> Iterator[tuple[str, Table]]:
    """Yield title and rich table of several conditions side by side, where there are several."""
    for title, headings, contents in texts(rows[0]).sweeps(rows):
        yield title, plain_table(headings, contents)


def plain_table(
    headings: Sequence[str],
    contents: Sequence[Sequence[str]],
    title: str | None = None,
    framed: bool = False,
) -> Table:
    """Return a table as all are printed: its first column to the left, no cell wrapped."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=title,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        show_edge=framed,
        # Columns come nearer to each other before one of them is cut.
        collapse_padding=not framed or _width(headings, contents) > _WIDTH,
    )
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="right" if index else "left", no_wrap=True)
    for line in contents:
        # As text: the name of a file may hold what rich takes for markup.
        table.add_row(*map(Text, line))
    return table


def _width(headings: Sequence[str], contents: Sequence[Sequence[str]]) -> int:
    """Return how wide a table is with a space on both sides of each cell and a gap between."""
    cells = [
        [part for heading in column[:1] for part in heading.splitlines()] + list(column[1:])
        for column in zip(headings, *contents, strict=True)
    ]
    return sum(2 + max(map(len, column)) for column in cells) + len(cells) - 1


def error_lines(rows: Sequence[Row], most: int = 5) -> Iterator[str]:
    """Yield which policies share a label and what raised: how many episodes, the first texts."""
    yield from names_lines(rows)
    for row in rows:
        yield from raised_lines([row])
        errors = row["errors"]
        for error in errors[:most]:
            yield f"  seed {error['seed']}: {error['text']}"
        if len(errors) > most:
            yield f"  and {len(errors) - most} more; --json lists them all"


def csv_text(rows: Sequence[Row]) -> str:
    """Return the scalar figures of the rows as CSV, intervals as two columns."""
    flat = scalar_figures(rows)
    stream = io.StringIO()
    # Rows may differ in what is null: an interval that is none has no two columns.
    names = list(dict.fromkeys(name for row in flat for name in row))
    writer = csv.DictWriter(stream, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return stream.getvalue()


def scalar_figures(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the scalar figures of each row, intervals as two; "" for what is null."""
    return [dict(_scalars(row)) for row in rows]


def _scalars(row: Row) -> Iterator[tuple[str, Any]]:
    for name, value in row.items():
        if name.endswith("_ci95"):
            low, high = value if value is not None else ("", "")
            yield f"{name}_low", low
            yield f"{name}_high", high
        elif name == "errors":
            yield name, len(value)
        elif value is None:
            if name not in _NESTED:
                yield name, ""
        elif isinstance(value, str | int | float):
            yield name, value


_NESTED = (
    "mean_tracking_error",
    "tracking_error_p10",
    "tracking_error_p90",
    "certified_tube",
    "step_time_while_contended",
    "filter_effect",
)
_LATEX = {"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "–": "--", "Δ": r"$\Delta$"}
_LATEX |= {"\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$"}
_LATEX |= {"^": r"\^{}", "~": r"\~{}"}
_LATEX |= {"²": r"$^2$", "…": r"\ldots{}", "<": "$<$", "∫": r"$\int$", "‖": r"$\|$"}


def latex_text(rows: Sequence[Row]) -> str:
    r"""Return LaTeX tables (package booktabs), one tabular per condition.

    The command that made the run is in a comment above them.
    """
    # A newline in the command would end the comment.
    blocks = ["% " + " ".join(rows[0]["command"].split()) if rows else "% no rows"]
    for group in by_condition(rows):
        shown = texts(group[0]).columns(group[0])
        units = [f"{heading} ({unit})" if unit else heading for heading, unit, _ in shown]
        blocks += [
            f"% {condition_title(group[0])}, {group[0]['episodes']} episodes",
            r"\begin{tabular}{l" + "r" * (len(shown) - 1) + "}",
            r"\toprule",
            " & ".join(map(_escape, units)) + r" \\",
            r"\midrule",
            *(
                " & ".join(_escape(content(row)) for _, _, content in shown) + r" \\"
                for row in texts(group[0]).ordered(group)
            ),
            r"\bottomrule",
            r"\end{tabular}",
            *(rf"\par {_escape(line)}" for line in (*names_lines(group), *raised_lines(group))),
        ]
    return "\n".join(blocks) + "\n"


def markdown_text(rows: Sequence[Row]) -> str:
    """Return Markdown tables: one per condition, or success by condition where there are many."""
    groups = by_condition(rows)
    blocks = [f"    {' '.join(rows[0]['command'].split())}"] if rows else []
    if len(groups) > 1:
        grids = texts(rows[0]).markdown_grids(groups)
        return "\n\n".join([*blocks, *grids, *names_lines(rows), *raised_lines(rows)]) + "\n"
    for group in groups:
        words = texts(group[0])
        blocks.append(markdown_rows(words.columns(group[0]), words.ordered(group)))
        blocks += _markdown_lines(comparison_lines(group))
        blocks += [*names_lines(group), *raised_lines(group)]
    return "\n\n".join(blocks) + "\n"


def _markdown_lines(lines: Iterable[str]) -> Iterator[str]:
    """Yield headings and the lists below them; what is indented twice goes on with its line."""
    items: list[str] = []
    for line in lines:
        if line.startswith("    ") and items:
            items[-1] += f" {line.strip()}"
        elif line.startswith(" "):
            items.append(f"- {line.strip()}")
        else:
            if items:
                yield "\n".join(items)
            items = []
            yield line
    if items:
        yield "\n".join(items)


def _escape(text: str) -> str:
    indent = r"\quad " if text.startswith("  ") else ""
    return indent + "".join(_LATEX.get(letter, letter) for letter in text.strip())
