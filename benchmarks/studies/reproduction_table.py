"""The paper's numbers beside ours, as Markdown, from the published results alone.

Reads `cartpole_uniform.json`, `spacecraft_paper.json` and `spacecraft_filter.json` and prints the
tables of docs/reproduction.md; with `--update` it replaces them there, between the lines
`<!-- table: NAME -->` and `<!-- end -->`. A file or row that is not there leaves a dash.

    python benchmarks/studies/reproduction_table.py [--results benchmarks/results]
        [--update docs/reproduction.md]
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from lagros_benchmarks.report.formats import markdown_table, number, percent, policy_label
from lagros_envs.files import write_atomic

Row = Mapping[str, Any]

BOUNDS = (0.2, 0.4, 0.6, 0.8, 1.0)
_CARTPOLE = ("learned", "tube-mpc", "lagros")
_SPACECRAFT = (*_CARTPOLE, "centralized")
# Table II of the paper: success [%], effort, time [s].
_TABLE_2 = {
    "learned": (40.0, 479.0, 3.01e-2),
    "tube-mpc": (100.0, 519.0, 1.00e-1),
    "lagros": (100.0, 567.0, 3.01e-2),
}
# Table III [s].
_TABLE_3 = {"learned": 4.63e-2, "tube-mpc": 1.53e-1, "lagros": 4.66e-2, "centralized": 1.12e3}
# Read off the vectors of the figure of the spacecraft, at the bounds above: success [%], effort.
# Rates are k/270 to the last digit: 45 worlds of six agents.
_FIGURE_SUCCESS = {
    "learned": (13.3, 7.0, 4.8, 2.6, 4.1),
    "tube-mpc": (41.5, 35.6, 42.2, 41.1, 38.1),
    "lagros": (90.0, 91.9, 92.6, 93.7, 95.6),
    "centralized": (100.0, 100.0, 100.0, 100.0, 100.0),
}
_FIGURE_EFFORT = {
    "learned": (413, 754, 4784, 6633, 2904),
    "tube-mpc": (7679, 9519, 7389, 8286, 8409),
    "lagros": (2199, 2251, 2238, 2211, 2281),
    "centralized": (1785, 1118, 1784, 1627, 1617),
}
# The released code adds the squares of the controls over the steps of 0.1 s, of the spacecraft over
# six agents too. In N^2 s, and of one agent, the published efforts are these shares.
_PERIOD, _AGENTS = 0.1, 6
# The paper's text.
_EFFORT_RATIO, _CARTPOLE_RATIO = 1.64, 567.0 / 519.0
_DASH = "–"


def load(folder: Path, name: str) -> list[Row]:
    """Return the rows of a published result, none if the file is not there."""
    path = folder / name
    return json.loads(path.read_text()) if path.is_file() else []


def find(rows: Sequence[Row], policy: str, bound: float) -> Row | None:
    """Return the row of a policy at a bound, or None."""
    for row in rows:
        if row["policy"] == policy and abs(float(row["bound"]) - bound) < 1e-9:
            return row
    return None


def _with_interval(row: Row | None, name: str, interval: str, form: Callable[[Any], str]) -> str:
    if row is None or row.get(name) is None:
        return _DASH
    ends = row.get(interval)
    if ends is None:
        return form(row[name])
    return f"{form(row[name])} ({form(ends[0])}–{form(ends[1])})"


def _seconds(row: Row | None, name: str) -> str:
    if row is None or row.get(name) is None:
        return _DASH
    value = float(row[name])
    return f"{1e6 * value:.0f} µs" if value < 1e-3 else f"{1e3 * value:.3g} ms"


def cartpole_table(rows: Sequence[Row]) -> str:
    """Return Table II, with our figures under the same disturbance."""
    lines = []
    for policy in _CARTPOLE:
        row = find(rows, policy, 0.75)
        success, effort, seconds = _TABLE_2[policy]
        lines.append(
            [
                policy_label(policy),
                f"{success:.1f}",
                _with_interval(row, "success_rate", "success_ci95", percent),
                f"{effort:.0f}",
                f"{_PERIOD * effort:.1f}",
                _with_interval(row, "effort_mean", "effort_ci95", number),
                _DASH if row is None else number(row["effort_total_mean"]),
                f"{1e3 * seconds:.1f} ms",
                _seconds(row, "step_time_median_s"),
            ]
        )
    headings = (
        "success [%], paper",
        "ours",
        "∫‖u‖²dt, paper",
        "× 0.1 s",
        "ours [N²s]",
        "ours, to 9 s",
        "Δt, paper",
        "ours, median",
    )
    return markdown_table(("policy", *headings), lines)


def cartpole_curve_table(rows: Sequence[Row]) -> str:
    """Return what the figure of the tracking error claims, and what we see."""
    lines = []
    for policy in _CARTPOLE:
        row = find(rows, policy, 0.75)
        mean = _DASH
        below, left = _DASH, _DASH
        if row is not None:
            values = [value for value in row["mean_tracking_error"] if value is not None]
            mean = number(max(values)) if values else _DASH
            below = "yes" if row["tracking_error_mean_below_tube"] else "no"
            left = percent(row["tube_violation_rate"])
        claim = "diverges" if policy == "learned" else "mean below r(t)"
        lines.append([policy_label(policy), claim, below, mean, left])
    headings = ("paper", "our mean below r(t)", "largest mean", "episodes that ever left [%]")
    return markdown_table(("policy", *headings), lines)


def spacecraft_success_table(plain: Sequence[Row], filtered: Sequence[Row]) -> str:
    """Return the success of the figure, ours without and with the safety filter."""
    lines = []
    for policy in _SPACECRAFT:
        paper = [f"{value:.1f}" for value in _FIGURE_SUCCESS[policy]]
        lines.append([policy_label(policy), "paper", *paper])
        for label, rows, name in (
            ("ours", plain, "success"),
            ("ours, r(t)", plain, "paper_success"),
            ("ours, filter", filtered, "success"),
        ):
            cells = [
                _with_interval(find(rows, policy, b), f"{name}_rate", f"{name}_world_ci95", percent)
                for b in BOUNDS
            ]
            lines.append(["", label, *cells])
    return markdown_table(("success [%]", "d̄ =", *(f"{bound:g}" for bound in BOUNDS)), lines)


def spacecraft_effort_table(plain: Sequence[Row], filtered: Sequence[Row]) -> str:
    """Return the effort of the figure, ours without and with the safety filter."""
    lines = []
    for policy in _SPACECRAFT:
        published = _FIGURE_EFFORT[policy]
        of_agent = (number(_PERIOD / _AGENTS * value) for value in published)
        lines.append([policy_label(policy), "paper", *(str(value) for value in published)])
        lines.append(["", "paper / 60", *of_agent])
        for label, rows in (("ours", plain), ("ours, filter", filtered)):
            cells = [
                _with_interval(find(rows, policy, b), "effort_mean", "effort_ci95", number)
                for b in BOUNDS
            ]
            lines.append(["", label, *cells])
    return markdown_table(("effort", "d̄ =", *(f"{bound:g}" for bound in BOUNDS)), lines)


def ratio_table(cartpole: Sequence[Row], plain: Sequence[Row], filtered: Sequence[Row]) -> str:
    """Return the ratios of effort that the paper names, on tasks that both policies solve."""

    def cell(rows: Sequence[Row], policy: str, other: str, bound: float) -> str:
        row = find(rows, policy, bound)
        against = None if row is None else (row.get("versus") or {}).get(other)
        return _with_interval(against, "effort_ratio", "effort_ratio_ci95", number)

    lines = [
        [
            "cart-pole (c)/(b)",
            f"{_CARTPOLE_RATIO:.3f}",
            cell(cartpole, "lagros", "tube-mpc", 0.75),
            _DASH,
        ]
    ]
    for index, bound in enumerate(BOUNDS):
        figure = _FIGURE_EFFORT["lagros"][index] / _FIGURE_EFFORT["centralized"][index]
        lines.append(
            [
                f"spacecraft (c)/(d), d̄ = {bound:g}",
                f"{_EFFORT_RATIO} (text), {figure:.2f} (figure)",
                cell(plain, "lagros", "centralized", bound),
                cell(filtered, "lagros", "centralized", bound),
            ]
        )
    return markdown_table(("ratio of effort", "paper", "ours", "ours, filter"), lines)


def spacecraft_time_table(rows: Sequence[Row]) -> str:
    """Return Table III; ours at the bound 0.4."""
    lines = []
    for policy in _SPACECRAFT:
        row = find(rows, policy, 0.4)
        paper = _TABLE_3[policy]
        plan = _seconds(row, "plan_time_median_s") if policy == "centralized" else _DASH
        lines.append(
            [
                policy_label(policy),
                f"{paper:.0f} s" if paper > 1.0 else f"{1e3 * paper:.1f} ms",
                _seconds(row, "step_time_median_s"),
                _seconds(row, "step_time_p99_s"),
                plan,
            ]
        )
    return markdown_table(("policy", "paper Δt", "ours, median", "p99", "joint plan"), lines)


def tables(folder: Path) -> dict[str, str]:
    """Return every table by its name in docs/reproduction.md."""
    cartpole = load(folder, "cartpole_uniform.json")
    plain = load(folder, "spacecraft_paper.json")
    filtered = load(folder, "spacecraft_filter.json")
    return {
        "cartpole": cartpole_table(cartpole),
        "cartpole-error": cartpole_curve_table(cartpole),
        "spacecraft-success": spacecraft_success_table(plain, filtered),
        "spacecraft-effort": spacecraft_effort_table(plain, filtered),
        "effort-ratio": ratio_table(cartpole, plain, filtered),
        "spacecraft-time": spacecraft_time_table(plain),
    }


def update(text: str, found: Mapping[str, str]) -> str:
    """Return a page with its tables replaced.

    Raises:
        ValueError: A table has no place in the page.
    """
    for name, table in found.items():
        pattern = re.compile(rf"(<!-- table: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
        places = pattern.findall(text)
        if len(places) != 1:
            raise ValueError(
                f"the page has {len(places)} places for the table {name!r}; it needs one"
            )
        # A function, so that nothing in a table is taken for a group.
        text = pattern.sub(partial(_filled, table), text)
    return text


def _filled(table: str, place: re.Match[str]) -> str:
    return f"{place[1]}{table}\n{place[2]}"


def main() -> None:
    """Print the tables, or put them into the page."""
    parser = argparse.ArgumentParser(description="The paper's numbers beside ours.")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--update", type=Path, help="page whose tables are replaced")
    options = parser.parse_args()
    found = tables(options.results)
    if options.update is not None:
        write_atomic(options.update, update(options.update.read_text(), found))
        return
    console = Console(soft_wrap=True)
    for name, table in found.items():
        console.print(f"{name}\n\n{table}\n", markup=False, highlight=False)


if __name__ == "__main__":
    main()
