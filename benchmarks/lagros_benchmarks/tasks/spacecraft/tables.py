"""What the tables of the spacecraft say."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

from lagros_benchmarks.report.formats import (
    EFFORT_RATIO,
    Column,
    agents_title,
    condition_title,
    disturbance_title,
    mark,
    markdown_rows,
    markdown_table,
    milliseconds,
    number,
    percent,
    policy_label,
    short_label,
    signed,
    task_title,
    with_interval,
)
from lagros_benchmarks.run.experiment import Row

_LEGEND = (
    "Rates are per agent. Success: within {goal_radius_m:g} m of the goal before "
    "{time_limit_s:g} s and any collision, with a 95 % interval over worlds; {others}. "
    "∫‖u‖²: mean effort of an agent to success, else to the end. Δt: one agent's decision; of a "
    "policy that plans for all agents together, that plan."
)
_OURS = (
    "strict: there at the end, never collided; paper: inside the paper's tube around the goal; "
    "coll.: collided, ever"
)
_ANCHORS = "safe: never collided; reached: within that distance, ever; both: the two together"
_LABEL = 15
_WIDTH = 80
_MOST_COLUMNS = 5  # of a sweep beside each other
_BELOW = "  + filter"


def plan_or_step(row: Row, statistic: str) -> float | None:
    """Return the Δt that the paper compares: of a joint plan, or of one agent's decision [s]."""
    plan: float | None = row[f"plan_time_{statistic}_s"]
    return row[f"step_time_{statistic}_s"] if plan is None else plan


def _label(row: Row) -> str:
    # A policy without filter stands in the line above, unless the run has none.
    below = row["filter_effect"] is not None
    return _BELOW if below else policy_label(row["policy"], _LABEL)


def _effort(row: Row) -> str:
    effort = row["effort_mean"]
    # Three decimals are enough beside the efforts of a whole table.
    return f"{effort:.3f}" if effort is not None and effort < 1.0 else number(effort)


# Heading (two lines) and content of each column of the terminal and LaTeX tables.
_COLUMNS: tuple[Column, ...] = (
    ("policy", "", lambda row: _label(row) + mark(row)),
    ("success", "%", lambda row: with_interval(row["success_rate"], row["success_world_ci95"])),
    ("strict", "%", lambda row: percent(row["strict_success_rate"])),
    ("paper", "%", lambda row: percent(row["paper_success_rate"])),
    ("coll.", "%", lambda row: percent(row["collision_rate"])),
    ("∫‖u‖²", "N²s", _effort),
    ("Δt ms", "p50", lambda row: milliseconds(plan_or_step(row, "median"))),
    ("Δt ms", "p99", lambda row: milliseconds(plan_or_step(row, "p99"))),
)


# The three rates of GCBF+ in place of the paper's, for its task.
_ANCHORS_COLUMNS: tuple[Column, ...] = (
    *_COLUMNS[:2],
    ("safe", "%", lambda row: percent(row["safe_rate"])),
    ("reached", "%", lambda row: percent(row["reached_rate"])),
    ("both", "%", lambda row: percent(row["safe_reached_rate"])),
    *_COLUMNS[5:],
)


def _as_the_anchor(row: Row) -> bool:
    """Return whether the row is of the task of GCBF+ and has its rates."""
    return str(row.get("preset")).startswith("gcbf") and "reached_rate" in row


def framed(row: Row) -> bool:
    """Return whether there is room for a frame: not beside the widest figures of eight columns."""
    return False


def legend(row: Row) -> str:
    """Return what the columns mean."""
    usual = {"goal_radius_m": 0.2, "time_limit_s": 45.0}  # of rows that do not say
    return _LEGEND.format(**{**usual, **row, "others": _ANCHORS if _as_the_anchor(row) else _OURS})


def columns(row: Row) -> tuple[Column, ...]:
    """Return the columns of a row's preset."""
    return _ANCHORS_COLUMNS if _as_the_anchor(row) else _COLUMNS


def title(row: Row) -> str:
    """Return the title of the table of a condition, on two lines; the row is its first."""
    worlds = f"{row['episodes']} world{'' if row['episodes'] == 1 else 's'}, seed {row['seed']}"
    which = "proved" if row.get("proved_filter") else "safety"
    worlds += f", all with the {which} filter" if row["safety_filter"] else ""
    return f"{task_title(row)}, {disturbance_title(row)},\n{worlds}"


def ordered(group: Sequence[Row]) -> Sequence[Row]:
    """Return the rows of a condition as the table lists them: the filter below its policy."""
    names = list(dict.fromkeys(row["policy"] for row in group))
    return sorted(group, key=lambda row: (names.index(row["policy"]), row["safety_filter"]))


def comparison_lines(group: Sequence[Row]) -> Iterator[str]:
    """Yield how each policy differs from the next one, filtered alike, and what the filter does."""
    for filtered in (False, True):
        rows = [row for row in group if row["safety_filter"] is filtered]
        if len(rows) > 1:
            which = "with" if filtered else "without"
            yield f"On the same agents, {which} the filter; {EFFORT_RATIO}:"
        for row, following in itertools.pairwise(rows):
            names = f"{short_label(row['policy'])} − {short_label(following['policy'])}"
            yield from _comparison(names, row["versus"][following["policy"]])
    effects = [row for row in group if row["filter_effect"] is not None]
    if effects:
        yield f"What the filter changes; {EFFORT_RATIO}:"
    for row in effects:
        yield from _comparison(policy_label(row["policy"], _LABEL), row["filter_effect"])


def _comparison(names: str, versus: Row) -> Iterator[str]:
    low, high = (100 * end for end in versus["success_difference_world_ci95"])
    text = (
        f"  {names}: {signed(100 * versus['success_difference'])} points "
        f"({signed(low)} to {signed(high)})"
    )
    ratio = versus["effort_ratio"]
    if ratio is None:
        yield text
        return
    effort = f"effort × {number(ratio)}"
    if versus["effort_ratio_ci95"] is not None:
        low, high = versus["effort_ratio_ci95"]
        effort += f" ({number(low)} to {number(high)})"
    whole = f"{text}, {effort}"
    if len(whole) <= _WIDTH:
        yield whole
    else:
        yield f"{text},"
        yield f"    {effort}"


def sweeps(rows: Sequence[Row]) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Yield title, headings and lines of a table per measure, conditions side by side.

    There is a table of success, one of effort and one of time for each kind of disturbance and
    number of agents against the bounds; where there are several numbers of agents, for each
    disturbance against these. Conditions that stand alone have none.
    """
    scale = _is_scale(rows)
    for series in _series(rows):
        points = list(dict.fromkeys(_point(row, scale) for row in series))
        for begin in range(0, len(points), _MOST_COLUMNS):
            part = points[begin : begin + _MOST_COLUMNS]
            shown = [row for row in series if _point(row, scale) in part]
            measures = [_SUCCESS, _EFFORT, _TOTAL, _DELAY, *([_BATCH] if scale else [])]
            if all(map(_as_the_anchor, shown)):
                measures.insert(1, _SAFE_REACHED)
            if any(row.get("guaranteed_rate") is not None for row in shown):
                measures.insert(1, _GUARANTEED)
            for name, _, content in measures:
                yield _sweep(name, content, shown, part, scale)


def _is_scale(rows: Sequence[Row]) -> bool:
    """Return whether numbers of agents are compared, and not bounds."""
    return len({row["agents"] for row in rows}) > 1


def _series(rows: Sequence[Row]) -> list[list[Row]]:
    """Group the rows that share a table of a sweep, without those of a condition alone."""
    scale = _is_scale(rows)

    def key(row: Row) -> tuple[str, float | int]:
        return (row["disturbance"], row["bound"] if scale else row["agents"])

    groups = [[row for row in rows if key(row) == one] for one in dict.fromkeys(map(key, rows))]
    return [group for group in groups if len({_point(row, scale) for row in group}) > 1]


def _point(row: Row, scale: bool) -> float:
    return float(row["agents"] if scale else row["bound"])


def _sweep(
    name: str,
    content: Callable[[Row], str],
    rows: Sequence[Row],
    points: Sequence[float],
    scale: bool,
) -> tuple[str, list[str], list[list[str]]]:
    first = rows[0]
    about = f"{first['task']}, {first['preset']}, {first['disturbance']} disturbance, "
    about += f"d̄ = {first['bound']:g}" if scale else agents_title(first)
    headings = ["agents" if scale else "d̄", *(f"{point:g}" for point in points)]
    lines: dict[tuple[str, bool], dict[float, str]] = {}
    labels: dict[tuple[str, bool], str] = {}
    for row in ordered(rows):
        key = (row["policy"], row["safety_filter"])
        labels[key] = _label(row)
        lines.setdefault(key, {})[_point(row, scale)] = content(row)
    contents = [
        [labels[key], *(cells.get(point, "–") for point in points)] for key, cells in lines.items()
    ]
    return f"{name}\n{about}, {first['episodes']} worlds", headings, contents


def _success(row: Row) -> str:
    # The wider side of the interval: near 100 % the other one is narrower.
    low, high = row["success_world_ci95"]
    rate = row["success_rate"]
    return f"{percent(rate)} ±{100 * max(high - rate, rate - low):.1f}{mark(row)}"


_SUCCESS: Column = ("Success [%], ± the wider side of its 95 % interval over worlds", "", _success)
_SAFE_REACHED: Column = (
    "Safe / reached / both, the rates of GCBF+ [%]",
    "",
    lambda row: " / ".join(
        percent(row[name]) for name in ("safe_rate", "reached_rate", "safe_reached_rate")
    ),
)
_EFFORT: Column = ("Effort [N²s]", "", _effort)
_TOTAL: Column = (
    "Effort over the same time, to the time limit [N²s]",
    "",
    lambda row: number(row["effort_total_mean"]),
)
_GUARANTEED: Column = (
    "Worlds proved collision-free / and arriving, for every disturbance of the bound [%]",
    "",
    lambda row: (
        "–"
        if row.get("guaranteed_rate") is None
        else f"{percent(row['guaranteed_rate'])} / {percent(row['guaranteed_arriving_rate'])}"
    ),
)
_DELAY: Column = (
    "Δt [ms], median: one agent's decision, or one plan for all agents",
    "",
    lambda row: milliseconds(plan_or_step(row, "median")),
)
_BATCH: Column = (
    "Δt per agent [ms], median, where one call decides for all agents of a world",
    "",
    lambda row: milliseconds(row["step_time_batch_per_agent_s"]),
)


def markdown_grids(groups: Sequence[Sequence[Row]]) -> list[str]:
    """Return the tables of the sweeps as Markdown, then those of conditions that stand alone."""
    rows = [row for group in groups for row in group]
    blocks = []
    for name, headings, contents in sweeps(rows):
        trimmed = [[cell.strip() for cell in line] for line in contents]
        blocks += [name.replace("\n", ": "), markdown_table(headings, trimmed)]
    swept = [row for series in _series(rows) for row in series]
    for group in (group for group in groups if group[0] not in swept):
        blocks += [condition_title(group[0]), markdown_rows(columns(group[0]), ordered(group))]
    return blocks
