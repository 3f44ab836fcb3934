"""The rows of a benchmark as a terminal table of at most 80 columns, as CSV and as LaTeX."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lagros_benchmarks.records import Row

if TYPE_CHECKING:
    from rich.table import Table

# The letters that the paper gives its methods.
_LETTERS = {"learned": "(a)", "tube-mpc": "(b)", "lagros": "(c)", "centralized": "(d)"}
_REFERENCES = ("tube-mpc", "lagros")
_LONGEST_LABEL = 12

LEGEND = (
    "Success and strict success (inside the tube at the time limit, never fell) with 95 % "
    "intervals; effort: integral of u² to success, else to the end; Δt: time of one call of "
    "predict; left tube: episodes whose error x - x_d ever left the paper's tube."
)


def policy_label(policy: str, longest: int = _LONGEST_LABEL) -> str:
    """Return the name of a policy in tables and figures: letter and name, or the file's name."""
    if policy in _LETTERS:
        return f"{_LETTERS[policy]} {policy}"
    name = Path(policy).name if policy.endswith(".zip") else policy
    return name if len(name) <= longest else name[: longest - 1] + "…"


def condition_title(row: Row) -> str:
    """Return what a table or figure of this row's condition is about."""
    if row["disturbance"] == "none":
        return f"{row['task']}, no disturbance"
    channels = "" if row["channels"] == "all" else f" on {row['channels']}"
    return f"{row['task']}, {row['disturbance']} disturbance{channels}, d̄ = {row['bound']:g}"


def by_condition(rows: Sequence[Row]) -> list[list[Row]]:
    """Group rows that follow each other and share kind and bound."""
    groups = itertools.groupby(rows, key=lambda row: (row["disturbance"], row["bound"]))
    return [list(group) for _, group in groups]


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits and no exponent; a dash for none."""
    if value is None or value != value:
        return "–"
    if value == 0:
        return "0"
    if not 1e-6 < abs(value) < 10**7:
        return f"{value:.0e}".replace("+0", "").replace("+", "")
    decimals = max(digits - len(str(int(abs(value)))), 0)
    if abs(value) < 1:
        decimals = digits - 1 - _exponent(value)
    return f"{value:.{decimals}f}"


def _exponent(value: float) -> int:
    return int(f"{abs(value):e}".partition("e")[2])


def percent(rate: float | None) -> str:
    """Return a rate in percent with one decimal, 100 only if it is exactly 1."""
    if rate is None:
        return "–"
    text = f"{100 * rate:.1f}"
    # 0.9996 must not read as 100 %, nor 0.0004 as 0 %.
    if text == "100.0" and rate < 1.0:
        return "99.9"
    if text == "0.0" and rate > 0.0:
        return "<0.1"
    return text


def _with_interval(rate: float, interval: Sequence[float]) -> str:
    low, high = (100 * end for end in interval)
    # A decimal where the episodes are many enough to tell.
    decimals = 1 if high - low < 5 else 0
    return f"{percent(rate)} ({low:.{decimals}f}–{high:.{decimals}f})"


def _milliseconds(seconds: float | None) -> str:
    if seconds is None or seconds != seconds:
        return "–"
    # A tenth of a microsecond is noise.
    return f"{1e3 * seconds:.3f}" if seconds < 1e-3 else number(1e3 * seconds)


# Heading (two lines) and content of each column of the terminal and LaTeX tables.
_COLUMNS: tuple[tuple[str, str, Callable[[Row], str]], ...] = (
    ("policy", "", lambda row: policy_label(row["policy"])),
    ("success", "%", lambda row: _with_interval(row["success_rate"], row["success_ci95"])),
    ("strict", "%", lambda row: percent(row["strict_success_rate"])),
    ("effort", "N²s", lambda row: number(row["effort_mean"])),
    ("Δt ms", "median", lambda row: _milliseconds(row["step_time_median_s"])),
    ("Δt ms", "p99", lambda row: _milliseconds(row["step_time_p99_s"])),
    ("left", "tube %", lambda row: percent(row["tube_violation_rate"])),
)


def terminal_table(group: Sequence[Row]) -> Table:
    """Return the rich table of the rows of one condition."""
    from rich import box
    from rich.table import Table

    first = group[0]
    table = Table(
        title=f"{condition_title(first)}, {first['episodes']} episodes, seed {first['seed']}",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for index, (heading, unit, _) in enumerate(_COLUMNS):
        justify: Any = "left" if index == 0 else "right"
        table.add_column(f"{heading}\n{unit}".strip(), justify=justify, no_wrap=True)
    for row in group:
        table.add_row(*(content(row) for _, _, content in _COLUMNS))
    return table


def comparison_lines(group: Sequence[Row]) -> Iterator[str]:
    """Yield a line per policy: its paired difference from the planner (b), or from the first.

    Args:
        group: Rows of one condition.
    """
    names = [row["policy"] for row in group]
    if len(names) < 2:
        return
    reference = next((name for name in _REFERENCES if name in names), names[0])
    yield f"Against {policy_label(reference)} on the same episodes:"
    for row in group:
        if row["policy"] != reference:
            name = f"{policy_label(row['policy']):<{_LONGEST_LABEL}}"
            yield f"  {name} {_comparison(row, reference)}"


def _comparison(row: Row, reference: str) -> str:
    versus = row["versus"][reference]
    low, high = versus["success_difference_ci95"]
    text = (
        f"success {100 * versus['success_difference']:+.1f} points "
        f"({100 * low:+.1f} to {100 * high:+.1f})"
    )
    if versus["effort_ratio"] is not None:
        text += f", effort × {versus['effort_ratio']:.3f}"
    return text


def error_lines(rows: Sequence[Row], most: int = 5) -> Iterator[str]:
    """Yield what raised: how many episodes of each policy, and the first few texts."""
    for row in rows:
        errors = row["errors"]
        if not errors:
            continue
        yield (
            f"{policy_label(row['policy'])}, {row['disturbance']} {row['bound']:g}: {len(errors)} "
            f"of {row['episodes']} episodes raised and count as failures"
        )
        for error in errors[:most]:
            yield f"  seed {error['seed']}: {error['text']}"
        if len(errors) > most:
            yield f"  and {len(errors) - most} more; --json lists them all"


def csv_text(rows: Sequence[Row]) -> str:
    """Return the scalar figures of the rows as CSV, intervals as two columns."""
    flat = [dict(_scalars(row)) for row in rows]
    stream = io.StringIO()
    # Rows may differ in what is null: an interval that is none has no two columns.
    names = list(dict.fromkeys(name for row in flat for name in row))
    writer = csv.DictWriter(stream, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return stream.getvalue()


def _scalars(row: Row) -> Iterator[tuple[str, Any]]:
    for name, value in row.items():
        if name.endswith("_ci95"):
            low, high = value if value is not None else ("", "")
            yield f"{name}_low", low
            yield f"{name}_high", high
        elif name == "errors":
            yield name, len(value)
        elif value is None:
            if name not in _CURVES:
                yield name, ""
        elif isinstance(value, str | int | float):
            yield name, value


_CURVES = (
    "mean_tracking_error",
    "tracking_error_p10",
    "tracking_error_p90",
    "certified_tube",
    "step_time_while_contended",
)
_LATEX = {"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "–": "--", "Δ": r"$\Delta$"}
_LATEX |= {"²": r"$^2$", "…": r"\ldots{}", "<": "$<$"}


def latex_text(rows: Sequence[Row]) -> str:
    r"""Return LaTeX tables (package booktabs), one tabular per condition.

    The command that made the run is in a comment above them.
    """
    # A newline in the command would end the comment.
    blocks = ["% " + " ".join(rows[0]["command"].split()) if rows else "% no rows"]
    for group in by_condition(rows):
        units = [f"{heading} ({unit})" if unit else heading for heading, unit, _ in _COLUMNS]
        blocks += [
            f"% {condition_title(group[0])}, {group[0]['episodes']} episodes",
            r"\begin{tabular}{l" + "r" * (len(_COLUMNS) - 1) + "}",
            r"\toprule",
            " & ".join(map(_escape, units)) + r" \\",
            r"\midrule",
            *(
                " & ".join(_escape(content(row)) for _, _, content in _COLUMNS) + r" \\"
                for row in group
            ),
            r"\bottomrule",
            r"\end{tabular}",
        ]
    return "\n".join(blocks) + "\n"


def markdown_text(rows: Sequence[Row]) -> str:
    """Return Markdown tables: one per condition, or success by condition where there are many."""
    groups = by_condition(rows)
    blocks = [f"    {' '.join(rows[0]['command'].split())}"] if rows else []
    if len(groups) > 1:
        return "\n\n".join([*blocks, _success_grid(groups)]) + "\n"
    for group in groups:
        units = [f"{heading} [{unit}]" if unit else heading for heading, unit, _ in _COLUMNS]
        contents = [[content(row) for _, _, content in _COLUMNS] for row in group]
        blocks.append(_markdown(units, contents))
        heading, *lines = [*comparison_lines(group)] or [""]
        if lines:
            blocks += [heading, "\n".join(f"- {line.strip()}" for line in lines)]
    return "\n\n".join(blocks) + "\n"


def _success_grid(groups: Sequence[Sequence[Row]]) -> str:
    """Success of every policy under every condition, and (c) minus (b) on the same episodes."""
    policies = [row["policy"] for row in groups[0]]
    paired = {"lagros", "tube-mpc"} <= set(policies)
    headings = ["disturbance", "d̄", *(f"{policy_label(name)} [%]" for name in policies)]
    contents = []
    for group in groups:
        line = [group[0]["disturbance"], f"{group[0]['bound']:g}"]
        line += [percent(row["success_rate"]) for row in group]
        if paired:
            ours = next(row for row in group if row["policy"] == "lagros")
            change = ours["versus"]["tube-mpc"]["success_difference"]
            line.append(f"{100 * change:+.1f}")
        contents.append(line)
    return _markdown([*headings, "(c) − (b) [points]"] if paired else headings, contents)


def _markdown(headings: Sequence[str], contents: Sequence[Sequence[str]]) -> str:
    rule = ["---", *["---:"] * (len(headings) - 1)]
    return "\n".join(f"| {' | '.join(line)} |" for line in (headings, rule, *contents))


def _escape(text: str) -> str:
    for plain, latex in _LATEX.items():
        text = text.replace(plain, latex)
    return text
