"""The page "all systems x all policies" and its figure, from the rows of the suite alone."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lagros_benchmarks.report.canvas import (
    Drawn,
    canvas,
    check_figure_path,
    legend,
    save,
    styles,
)
from lagros_benchmarks.report.formats import (
    by_condition,
    condition_title,
    markdown_rows,
    markdown_table,
    milliseconds,
    number,
    percent,
    policy_label,
    raised_lines,
    row_label,
    with_interval,
)
from lagros_benchmarks.report.tables import texts
from lagros_benchmarks.run.experiment import Row
from lagros_envs.registry import find_task, task_names
from lagros_policies.room import shipped_file

# Which of ours are held against which others.
OURS = ("tube-mpc", "lagros")
RIVALS = ("c3m", "sd-lqr", "lqr")
_NONE = "–"


class Measure(NamedTuple):
    """What policies are compared by, of which less is better.

    Attributes:
        name: In the page.
        ratio: Field of `versus`.
        beside: Whether it is of the episodes that begin beside their plan.
    """

    name: str
    ratio: str
    beside: bool


MEASURES = (
    Measure("area", "error_area_ratio", False),
    Measure("normalised area", "error_area_ratio", True),
    Measure("peak", "overshoot_ratio", True),
)


class System:
    """The rows of one task of one body, found by policy, kind and start.

    Attributes:
        task: Its name.
        policies: In the order of the suite.
        kinds: Of disturbance.
    """

    def __init__(self, rows: Sequence[Row]) -> None:
        self.task = str(rows[0]["task"])
        self.kinds = list(dict.fromkeys(row["disturbance"] for row in rows))
        self._rows = {
            (row["policy"], row["disturbance"], bool(row["initial_error"]), row["guarantee"]): row
            for row in rows
        }
        self.policies = list(dict.fromkeys(row["policy"] for row in rows))

    @property
    def first(self) -> Row:
        """Any of its rows."""
        return next(iter(self._rows.values()))

    def row(self, policy: str, kind: str, beside: bool = False) -> Row | None:
        """Return the row of a policy under a kind, of episodes on or beside their plan."""
        return self._rows.get((policy, kind, beside, False))

    def proved(self, policy: str) -> Row | None:
        """Return the row of a policy in which guarantees were proved."""
        return self._rows.get((policy, self.kinds[0], False, True))

    def ratio(self, measure: Measure, ours: str, rival: str, kind: str) -> Any:
        """Return ratio and interval of a measure on the same episodes; None where there is none."""
        row = self.row(ours, kind, measure.beside)
        versus = None if row is None else row["versus"].get(rival)
        if versus is None or versus[measure.ratio] is None:
            return None
        return versus[measure.ratio], versus[f"{measure.ratio}_ci95"]

    def ahead(self, measure: Measure, ours: str, rival: str) -> bool | None:
        """Return whether the whole interval is below 1 under every kind; None without a rival."""
        found = [self.ratio(measure, ours, rival, kind) for kind in self.kinds]
        if any(one is None for one in found):
            return None
        return all(one[1] is not None and one[1][1] < 1.0 for one in found)


def systems_of(rows: Sequence[Row]) -> list[System]:
    """Return the systems of one body among rows."""
    names = dict.fromkeys(row["task"] for row in rows if "agents" not in row)
    return [System([row for row in rows if row["task"] == name]) for name in names]


def page_text(result: dict[str, Any], page: Path, figure: Path | None) -> str:
    """Return the page of a result of `lagros suite`, as Markdown.

    Args:
        result: As in its JSON.
        page: Where it is to lie; pages of the tasks that lie beside it are linked.
        figure: Where the figure lies; None without one.
    """
    rows, settings = result["rows"], result["settings"]
    systems = systems_of(rows)
    fewer = ", ".join(f"{name} {count}" for name, count in settings["fewer"].items())
    some = f" ({fewer})" if fewer else ""
    kinds = " / ".join(settings["disturbances"])
    measured = _link("What is measured, with formulas: ", page, "../comparing.md")
    blocks = [
        "# All systems, all policies",
        f"    {result['command']}",
        f"{settings['episodes']} paired episodes{some} of each system, policy and kind of "
        "disturbance, each system at its own bound d̄; intervals are 95 %. Starts, goals, discs, "
        "plans x_d and disturbances are the same for all policies of a system. Several numbers in "
        f"one cell: {kinds}. {measured}",
    ]
    if figure is not None:
        place = os.path.relpath(figure, page.parent)
        blocks.append(f"![Success against the area under the error, by system]({place})")
    if systems:
        blocks += ["## Success [%]", _glance(systems), "## Ahead, and behind"]
        blocks += [_words(systems), _ahead_table(systems)]
    for system in systems:
        blocks += _system_blocks(system, result, page)
    for name in dict.fromkeys(row["task"] for row in rows if "agents" in row):
        blocks += _worlds_blocks([row for row in rows if row["task"] == name], page)
    made = result["machine"]
    blocks.append(
        f"Flown on {made['processor'] or made['platform']}, worker processes: {settings['jobs']}. "
        "Δt is that of one call of the policy, the median."
    )
    return "\n\n".join(block for block in blocks if block) + "\n"


def _link(text: str, page: Path, place: str) -> str:
    """Return a text with a link behind it, if there is such a page."""
    return f"{text}[{Path(place).name}]({place})." if (page.parent / place).is_file() else ""


def _heading(task: str, page: Path) -> str:
    place = f"{task}.md"
    return f"## [{task}]({place})" if (page.parent / place).is_file() else f"## {task}"


def _pair(values: Sequence[str]) -> str:
    return _NONE if all(value == _NONE for value in values) else " / ".join(values)


def _glance(systems: Sequence[System]) -> str:
    policies = list(dict.fromkeys(name for system in systems for name in system.policies))
    lines = []
    for system in systems:
        line = [system.task, number(system.first["bound"])]
        for policy in policies:
            found = [system.row(policy, kind) for kind in system.kinds]
            line.append(
                _pair([_NONE if one is None else percent(one["success_rate"]) for one in found])
            )
        lines.append(line)
    return markdown_table(["system", "d̄", *map(policy_label, policies)], lines) if lines else ""


def _words(systems: Sequence[System]) -> str:
    """Say on how many systems one of ours is ahead of all rivals, and on which not."""
    names = ", ".join(RIVALS)
    parts = [
        "Median over paired episodes of what (b) or (c) has over what another policy has, with its "
        "interval: *ahead* is a whole interval below 1, under every kind of disturbance. An error "
        "before the goal is held against the plan that all share, whether a policy follows it or "
        "not: `lqr` does not. One of (b) and (c) is ahead of all of "
        f"{names}:"
    ]
    for measure in MEASURES:
        ahead, behind, unknown = [], [], []
        for system in systems:
            verdicts = [[system.ahead(measure, our, one) for one in RIVALS] for our in OURS]
            if any(all(verdict is True for verdict in one) for one in verdicts):
                ahead.append(system.task)
            elif any(None in one for one in verdicts):
                unknown.append(system.task)
            else:
                behind.append(system.task)
        line = f"- {measure.name}: on {len(ahead)} of {len(systems)}"
        line += f" ({', '.join(ahead)})" if ahead else ""
        line += f"; not on {', '.join(behind)}" if behind else ""
        line += f"; not all of them flew {', '.join(unknown)}" if unknown else ""
        parts.append(line)
    blocks = (parts[0], "\n".join(parts[1:]), _learned(systems))
    return "\n\n".join(block for block in blocks if block)


def _learned(systems: Sequence[System]) -> str:
    """Say of how many fresh states what a learned metric promises is so: "" where none is there."""
    shares = []
    for system in systems:
        if system.task not in task_names():
            continue
        record = shipped_file(find_task(system.task), f"{RIVALS[0]}.json")
        if record.is_file():
            conditions = json.loads(record.read_text(encoding="utf-8"))["conditions"]
            shares.append(f"{system.task} {100.0 * conditions['closed']:.0f} %")
    if not shares:
        return ""
    return (
        f"What {RIVALS[0]} promises, contraction over a hold at its rate, was observed at this "
        f"share of fresh states: {', '.join(shares)}. Where that is near zero it flies without "
        "what its method is about, and to be ahead of it says little. One recipe trained it for "
        "all systems."
    )


def _ahead_table(systems: Sequence[System]) -> str:
    headings = ["system", "policy", "disturbance"]
    headings += [f"{measure.name} / {rival}" for rival in RIVALS for measure in MEASURES]
    lines = []
    for system in systems:
        for ours in (name for name in OURS if name in system.policies):
            for kind in system.kinds:
                line = [system.task, policy_label(ours), kind]
                for rival in RIVALS:
                    line += [
                        _ratio(system.ratio(measure, ours, rival, kind)) for measure in MEASURES
                    ]
                lines.append(line)
    return markdown_table(headings, lines) if lines else ""


def _ratio(found: Any) -> str:
    if found is None:
        return _NONE
    ratio, interval = found
    if interval is None:
        return number(ratio)
    text = f"{number(ratio)} ({number(interval[0])}–{number(interval[1])})"
    return f"**{text}**" if interval[1] < 1.0 else text


def _system_blocks(system: System, result: dict[str, Any], page: Path) -> Iterator[str]:
    yield _heading(system.task, page)
    first = system.first
    units = (first.get("units") or {}).get("state") or "those of the state"
    beside = result["settings"]["initial_error"]
    yield (
        f"d̄ = {first['bound']:g} per second, units {units}. area: ∫‖x − x_d‖ dt of episodes that "
        f"begin on their plan; the next four columns: of those that begin beside it, by up to "
        f"{beside:g} of each scale."
    )
    headings = [
        "policy",
        *(f"success, {kind} [%]" for kind in system.kinds),
        "strict [%]",
        *(f"area, {kind}" for kind in system.kinds),
        *("normalised area [s]", "peak", "C", "rate [1/s]", "effort", "Δt [ms]", "proved [%]"),
    ]
    lines = [_line(system, policy) for policy in system.policies]
    missing = [one for one in result["missing"] if one[0] == system.task]
    there = set(system.policies)
    lines += [
        [policy_label(one[1]), *[_NONE] * (len(headings) - 1)]
        for one in missing
        if one[1] not in there
    ]
    yield markdown_table(headings, lines)
    if missing:
        yield "Not flown: " + "; ".join(f"{one[1]} ({one[2]})" for one in missing) + "."
    for row in (
        system.row(policy, kind, beside)
        for policy in system.policies
        for kind in system.kinds
        for beside in (False, True)
    ):
        if row is not None:
            yield from raised_lines([row])


def _line(system: System, policy: str) -> list[str]:
    plain = [system.row(policy, kind) for kind in system.kinds]
    beside = [system.row(policy, kind, True) for kind in system.kinds]
    proved = system.proved(policy)
    known = [row for row in (*plain, *beside) if row is not None]

    def both(group: Sequence[Row | None], show: Callable[[Row], str]) -> str:
        return _pair([_NONE if row is None else show(row) for row in group])

    return [
        row_label(*known) + ("" if len(known) == len(plain) * 2 else " (in part)"),
        *(
            _NONE if row is None else with_interval(row["success_rate"], row["success_ci95"])
            for row in plain
        ),
        both(plain, lambda row: percent(row["strict_success_rate"])),
        *(_NONE if row is None else _spread(row, "error_area") for row in plain),
        both(beside, lambda row: number(row["normalised_area_mean"])),
        both(beside, lambda row: number(row["overshoot_mean"])),
        both(beside, lambda row: number(row["envelope_overshoot"])),
        both(beside, lambda row: number(row["convergence_rate_mean"])),
        both(plain, lambda row: number(row["effort_mean"])),
        both(plain[:1], lambda row: milliseconds(row["step_time_median_s"])),
        _NONE if proved is None else percent(proved["guaranteed_rate"]),
    ]


def _spread(row: Row, name: str) -> str:
    mean, interval = row[f"{name}_mean"], row[f"{name}_ci95"]
    if mean is None or interval is None:
        return number(mean)
    return f"{number(mean)} ({number(interval[0])}–{number(interval[1])})"


def _worlds_blocks(rows: Sequence[Row], page: Path) -> Iterator[str]:
    """Yield the tables of a task of many agents, in its own columns."""
    yield _heading(rows[0]["task"], page)
    for group in by_condition(rows):
        words = texts(group[0])
        yield f"{condition_title(group[0])}, {group[0]['episodes']} worlds:"
        yield markdown_rows(words.columns(group[0]), words.ordered(group))


def suite_figure(rows: Sequence[Row], path: str | Path | None) -> Drawn:
    """Draw strict success against the area under the error, system by system.

    Under the last kind of disturbance; the area is in units of that of the least.

    Raises:
        ValueError: The rows are of no system of one body.
    """
    path = check_figure_path(path)
    systems = systems_of(rows)
    if not systems:
        raise ValueError("the figure needs a system of one body")
    columns = min(len(systems), 4)
    lines = -(-len(systems) // columns)
    figure, panels = canvas(2.6 * columns + 0.6, 2.5 * lines + 0.8, lines, columns)
    policies = list(dict.fromkeys(name for system in systems for name in system.policies))
    looks = styles(policies)
    kind = systems[0].kinds[-1]
    for system, axes in zip(systems, panels, strict=False):
        found = {name: system.row(name, kind) for name in policies}
        areas = {
            name: row["error_area_mean"]
            for name, row in found.items()
            if row is not None and row["error_area_mean"]
        }
        least = min(areas.values(), default=1.0)
        for name in policies:
            row = found[name]
            drawn = row is not None and name in areas
            axes.plot(
                [areas[name] / least] if drawn else [np.nan],
                [100.0 * row["strict_success_rate"]] if drawn and row is not None else [np.nan],
                color=looks[name].colour,
                marker=looks[name].marker,
                markersize=7,
                alpha=0.85,
                linestyle="none",
                label=policy_label(name),
            )
        axes.set_xscale("log")
        axes.set(ylim=(-5, 105), yticks=(0, 25, 50, 75, 100))
        axes.set_title(f"{system.task}, d̄ = {system.first['bound']:g}", loc="left", fontsize=10)
    for axes in panels[len(systems) :]:
        axes.set_axis_off()
    figure.supxlabel(
        f"area under the error, in units of the least ({kind} disturbance)", fontsize=10
    )
    figure.supylabel("strict success [%]", fontsize=10)
    legend(figure, panels[0])
    return save(figure, path)
