"""What the tables of a task of one body say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lagros_benchmarks.report.formats import (
    EFFORT_RATIO,
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
    with_interval,
)
from lagros_benchmarks.run.experiment import Row

_REFERENCES = ("tube-mpc", "lagros")

_LEGEND = (
    "Success and strict success (inside the tube at the time limit, never fell) with 95 % "
    "intervals; effort: mean integral of u² to success, else to the end; Δt: time of one call of "
    "predict; left tube: episodes that fell, have no plan, or whose error x - x_d ever left the "
    "paper's tube."
)
# Of a task without a published tube.
_PLAIN_LEGEND = (
    "Success (at the goal before the limit, a collision or a fall) and strict success (there at "
    "the end) with 95 % intervals; coll.: touched a disc; fell: left what the task allows; effort: "
    "mean integral of ‖u − centre‖² to success, else to the end; Δt: time of one call of predict."
)


_BESIDE_LEGEND = (
    "Success and strict success with 95 % intervals; episodes begin beside their plan by e(0). "
    "area: integral of ‖e(t)‖/‖e(0)‖, e = x − x_d, and peak: the largest of it, both the mean; C, "
    "rate: its tightest envelope C exp(−λt), C of the highest peak, λ the mean; Δt: time of one "
    "call of predict. What ended early counts on with its largest error."
)
_GUARANTEE_LEGEND = (
    " Proved: episodes of which it is proved, for every disturbance up to d̄, that they are strict "
    "successes; bound: what is proved of the largest ‖x − x_d‖ over what these flights came to."
)


def framed(row: Row) -> bool:
    """Return whether the terminal table has room for a frame in 80 columns."""
    return _has_tube(row) and not row.get("guarantee") and not row.get("initial_error")


def legend(row: Row) -> str:
    """Return what the columns mean."""
    if row.get("initial_error"):
        return _BESIDE_LEGEND
    said = _LEGEND if _has_tube(row) else _PLAIN_LEGEND
    return said + _GUARANTEE_LEGEND if row.get("guarantee") else said


def columns(row: Row) -> tuple[Column, ...]:
    """Return heading (two lines) and content of each column of the terminal and LaTeX tables."""
    effort = (row.get("units") or {"effort": "N²s"})["effort"]
    begin: tuple[Column, ...] = (
        ("policy", "", row_label),
        ("success", "%", lambda row: with_interval(row["success_rate"], row["success_ci95"])),
        ("strict", "%", lambda row: percent(row["strict_success_rate"])),
    )
    if row.get("initial_error"):
        return (
            *begin,
            ("area", "s", lambda row: number(row["normalised_area_mean"])),
            ("peak", "", lambda row: number(row["overshoot_mean"])),
            ("C", "", lambda row: number(row["envelope_overshoot"])),
            ("rate", "1/s", lambda row: number(row["convergence_rate_mean"])),
            ("effort", effort, lambda row: number(row["effort_mean"])),
            ("Δt ms", "median", lambda row: milliseconds(row["step_time_median_s"])),
        )
    middle: tuple[Column, ...] = (
        ("effort", effort, lambda row: number(row["effort_mean"])),
        ("Δt ms", "median", lambda row: milliseconds(row["step_time_median_s"])),
        ("Δt ms", "p99", lambda row: milliseconds(row["step_time_p99_s"])),
    )
    end: tuple[Column, ...] = ()
    if row.get("guarantee"):
        # In place of times, for which there is no room.
        middle = middle[:-1] if _has_tube(row) else middle[:1]
        end = (
            ("proved", "%", lambda row: percent(row["guaranteed_rate"])),
            ("bound", "/worst", lambda row: number(row["bound_over_worst"])),
        )
    if _has_tube(row):
        left: Column = ("left", "tube %", lambda row: percent(row["tube_violation_rate"]))
        return (*begin, *middle, left, *end)
    return (
        *begin,
        ("coll.", "%", lambda row: percent(row["collision_rate"])),
        ("fell", "%", lambda row: percent(row["fall_rate"])),
        *middle,
        *end,
    )


def _has_tube(row: Row) -> bool:
    return row["paper_tube"] is not None


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
    """Yield a line per policy: its paired difference from the planner (b), or from the first."""
    names = [row["policy"] for row in group]
    if len(names) < 2:
        return
    reference = next((name for name in _REFERENCES if name in names), names[0])
    yield f"Against {policy_label(reference)} on the same episodes; {EFFORT_RATIO}:"
    for row in group:
        if row["policy"] != reference:
            name = f"{policy_label(row['policy']):<{LONGEST_LABEL}}"
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


def markdown_grids(groups: Sequence[Sequence[Row]]) -> list[str]:
    """Return success by condition, and (c) minus (b) on the same episodes."""
    policies = [row["policy"] for row in groups[0]]
    paired = {"lagros", "tube-mpc"} <= set(policies)
    headings = ["disturbance", "d̄", *(f"{policy_label(name)} [%]" for name in policies)]
    contents = []
    for group in groups:
        line = [group[0]["disturbance"], f"{group[0]['bound']:g}"]
        line += [percent(row["success_rate"]) + mark(row) for row in group]
        if paired:
            ours = next(row for row in group if row["policy"] == "lagros")
            change = ours["versus"]["tube-mpc"]["success_difference"]
            line.append(f"{100 * change:+.1f}")
        contents.append(line)
    grid = markdown_table([*headings, "(c) − (b) [points]"] if paired else headings, contents)
    return [grid, *_guarantee_grid(groups)]


def _guarantee_grid(groups: Sequence[Sequence[Row]]) -> list[str]:
    """Return what is proved by bound, of the policies that statements are about."""
    if not groups[0][0].get("guarantee"):
        return []
    # What is proved of a bound is proved for every kind of disturbance.
    by_bound = {group[0]["bound"]: group for group in reversed(groups)}
    headings = ["d̄", *(f"{policy_label(row['policy'])}, proved [%]" for row in groups[0])]
    contents = [
        [f"{bound:g}", *(percent(row["guaranteed_rate"]) for row in group)]
        for bound, group in sorted(by_bound.items())
    ]
    return [markdown_table(headings, contents)]
