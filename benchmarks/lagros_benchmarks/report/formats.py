"""How numbers, policies and conditions are written in tables and figures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

from lagros_benchmarks.run.experiment import Row

# The letters that the paper gives its methods.
_LETTERS = {
    "learned": "(a)",
    "learned-mpc": "(a′)",
    "tube-mpc": "(b)",
    "lagros": "(c)",
    "centralized": "(d)",
}
LONGEST_LABEL = 12
# What "effort ×" means wherever two policies are compared.
EFFORT_RATIO = "effort ratio where both succeed"
# Stands behind the name of a policy some of whose episodes raised.
RAISED_MARK = "!"
_DIGITS = 3
# Heading (two lines) and content of a column.
Column = tuple[str, str, Callable[[Row], str]]


def policy_label(policy: str, longest: int = LONGEST_LABEL) -> str:
    """Return the name of a policy in tables and figures: letter and name, its file or its class.

    Of a part of what is shipped, such as tube-mpc:gain, the letter of the whole.
    """
    whole, _, part = policy.partition(":")
    if whole in _LETTERS and not policy.endswith(".zip"):
        return f"{_LETTERS[whole]} {part or whole}"
    name = Path(policy).name if policy.endswith(".zip") else policy.rpartition(":")[2]
    return name if len(name) <= longest else name[: longest - 1] + "…"


def row_label(*rows: Row, longest: int = LONGEST_LABEL) -> str:
    """Return the name of the policy of some rows, marked where episodes raised."""
    return policy_label(rows[0]["policy"], longest) + mark(*rows)


def mark(*rows: Row) -> str:
    """Return what marks rows in which episodes raised; see `raised_lines`."""
    # Rows of earlier versions do not say how often the pass for the times did.
    return RAISED_MARK if any(row["errors"] or row.get("timing_raised") for row in rows) else ""


def figure_note(rows: Sequence[Row]) -> str:
    """Return what the mark and shared labels mean, for the end of a caption; "" without them."""
    lines = names_lines(rows)
    if mark(*rows):
        lines.append(f"{RAISED_MARK} some episodes raised and count as failures")
    return "".join(f"\n{line}" for line in lines)


def names_lines(rows: Sequence[Row]) -> list[str]:
    """Return a line for every label that several policies of a run share: who they are."""
    shared: dict[str, list[str]] = {}
    for policy in dict.fromkeys(row["policy"] for row in rows):
        shared.setdefault(policy_label(policy), []).append(policy)
    return [
        f"{label}, always in this order: {', '.join(policies)}"
        for label, policies in shared.items()
        if len(policies) > 1
    ]


def raised_lines(rows: Sequence[Row]) -> list[str]:
    """Return a line for every row in which episodes raised, for below a table."""
    lines = []
    for row in rows:
        if not mark(row):
            continue
        filtered = " + filter" if row["safety_filter"] else ""
        what = "worlds" if "agents" in row else "episodes"
        happened = f"{len(row['errors'])} of {row['episodes']} {what} raised and count as failures"
        if not row["errors"]:
            happened = f"{row['timing_raised']} {what} raised where Δt was measured"
        lines.append(
            f"{RAISED_MARK} {policy_label(row['policy'])}{filtered}, {row['disturbance']} "
            f"{row['bound']:g}: {happened}"
        )
    return lines


def short_label(policy: str) -> str:
    """Return the letter of a policy, or the name of one that has none."""
    return _LETTERS[policy] if policy in _LETTERS else policy_label(policy)


def agents_title(row: Row) -> str:
    """Return the number of agents of a row in words."""
    return f"{row['agents']} agent{'' if row['agents'] == 1 else 's'}"


def task_title(row: Row) -> str:
    """Return the task of a row; of worlds of agents with preset and number of agents."""
    if "agents" not in row:
        return str(row["task"])
    return f"{row['task']}, {row['preset']}, {agents_title(row)}"


def disturbance_title(row: Row) -> str:
    """Return the disturbance of a row."""
    if row["disturbance"] == "none":
        return "no disturbance"
    channels = "" if row["channels"] == "all" else f" on {row['channels']}"
    return f"{row['disturbance']} disturbance{channels}, d̄ = {row['bound']:g}"


def condition_title(row: Row) -> str:
    """Return what a table or figure of this row's condition is about."""
    return f"{task_title(row)}, {disturbance_title(row)}"


def by_condition(rows: Sequence[Row]) -> list[list[Row]]:
    """Group rows that follow each other and share kind, bound and number of agents."""
    groups = itertools.groupby(
        rows, key=lambda row: (row["disturbance"], row["bound"], row.get("agents"))
    )
    return [list(group) for _, group in groups]


def number(value: float | None) -> str:
    """Return a number with three significant digits and no exponent; a dash for none."""
    if value is None or value != value:
        return "–"
    if value == 0:
        return "0"
    if not 1e-6 < abs(value) < 10**7:
        return f"{value:.0e}".replace("+0", "").replace("+", "")
    decimals = max(_DIGITS - len(str(int(abs(value)))), 0)
    if abs(value) < 1:
        exponent = int(f"{abs(value):e}".partition("e")[2])
        decimals = _DIGITS - 1 - exponent
    return f"{value:.{decimals}f}"


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


def with_interval(rate: float, interval: Sequence[float]) -> str:
    """Return a rate in percent and its interval."""
    low, high = (100 * end for end in interval)
    # A decimal where the episodes are many enough to tell.
    decimals = 1 if high - low < 5 else 0
    return f"{percent(rate)} ({low:.{decimals}f}–{high:.{decimals}f})"


def milliseconds(seconds: float | None) -> str:
    """Return a time in milliseconds; a dash for none."""
    if seconds is None or seconds != seconds:
        return "–"
    # A tenth of a microsecond is noise.
    return f"{1e3 * seconds:.3f}" if seconds < 1e-3 else number(1e3 * seconds)


def signed(value: float) -> str:
    """Return a number with its sign, a true minus, and one decimal."""
    return f"{value:+.1f}".replace("-", "−")


def markdown_rows(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    """Return the Markdown table of rows."""
    headings = [f"{heading} [{unit}]" if unit else heading for heading, unit, _ in columns]
    return markdown_table(headings, [[cell(row).strip() for *_, cell in columns] for row in rows])


def markdown_table(headings: Sequence[str], contents: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table, its first column to the left."""
    rule = ["---", *["---:"] * (len(headings) - 1)]
    lines = ([cell.replace("|", r"\|") for cell in line] for line in (headings, rule, *contents))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
