"""The page "all systems x all policies", and what is printed of it, from the suite's rows alone."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
    short_label,
    with_interval,
)
from lagros_benchmarks.report.suite_rows import (
    MEASURES,
    OURS,
    RIVALS,
    Measure,
    System,
    policies_of,
    systems_of,
)
from lagros_benchmarks.report.tables import plain_table, texts
from lagros_benchmarks.run.experiment import Row
from lagros_benchmarks.run.suite_worst import ERROR, SUCCESS
from lagros_envs.registry import find_task, task_names
from lagros_policies.room import shipped_file

if TYPE_CHECKING:
    from rich.table import Table

_NONE = "–"
_TERMINAL = 80


def page_text(result: dict[str, Any], page: Path, figure: Path | None) -> str:
    """Return the page of a result of `lagros suite`, as Markdown.

    Args:
        result: As in its JSON.
        page: Where it is to lie; pages of the tasks that lie beside it are linked.
        figure: Where the figure lies; None without one.
    """
    rows, settings = result["rows"], result["settings"]
    systems = systems_of(rows, result["worst"])
    fewer = ", ".join(f"{name} {count}" for name, count in settings["fewer"].items())
    some = f" ({fewer})" if fewer else ""
    kinds = " / ".join(settings["disturbances"])
    measured = _link("What is measured, with formulas: ", page, "../comparing.md")
    blocks = ["# All systems, all policies"]
    if systems:
        blocks.append(_ahead_words(systems))
    blocks += [
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
        blocks += ["## Success [%]", _by_system(systems, _successes)]
        blocks += _worst_blocks(systems, settings["worst_flights"])
        blocks += _proved_blocks(systems)
        blocks += _ahead_blocks(systems)
    if systems:
        blocks.append(
            "## By system\n\narea: ∫‖x − x_d‖ dt of episodes that begin on their plan; normalised "
            "area, peak, C and rate: of those that begin beside it, by up to "
            f"{settings['initial_error']:g} of each scale. Δt: one call of the policy, the median."
        )
    for system in systems:
        blocks += _system_blocks(system, result, page)
    for name in dict.fromkeys(row["task"] for row in rows if "agents" in row):
        blocks += _worlds_blocks([row for row in rows if row["task"] == name], page)
    made = result["machine"]
    blocks.append(
        f"Flown on {made['processor'] or made['platform']}, worker processes: {settings['jobs']}."
    )
    return "\n\n".join(block for block in blocks if block) + "\n"


def printed_tables(result: dict[str, Any]) -> Iterator[tuple[str, Table]]:
    """Yield title and rich table of success, and of what was found worst, 80 columns at most."""
    systems = systems_of(result["rows"], result["worst"])
    kinds = "/".join(result["settings"]["disturbances"])
    shown: list[tuple[str, Callable[[System, str], str]]] = [
        (f"success [%], {kinds}", lambda one, name: _successes(one, name).replace(" / ", "/")),
        ("worst found: success [%], ‖x − x_d‖/d̄ [s]", _worst_cell),
    ]
    for title, cell in shown:
        for group in _that_fit(systems, cell):
            lines = [
                [short_label(name), *(cell(system, name) for system in group)]
                for name in policies_of(group)
            ]
            if any(text != _NONE for line in lines for text in line[1:]):
                headings = ["policy", *(system.task.replace("-", "-\n") for system in group)]
                yield title, plain_table(headings, lines)


def _that_fit(
    systems: Sequence[System], cell: Callable[[System, str], str]
) -> Iterator[list[System]]:
    """Yield systems in groups whose columns fit into a terminal beside those of the names."""
    policies = policies_of(systems)
    first = max((len(short_label(name)) for name in policies), default=0)
    group: list[System] = []
    width = first
    for system in systems:
        heading = max(len(part) + 1 for part in system.task.split("-"))
        own = 2 + max([heading, *(len(cell(system, name)) for name in policies)])
        if group and width + own > _TERMINAL:
            yield group
            group, width = [], first
        group.append(system)
        width += own
    if group:
        yield group


def _link(text: str, page: Path, place: str) -> str:
    """Return a text with a link behind it, if there is such a page."""
    return f"{text}[{Path(place).name}]({place})." if (page.parent / place).is_file() else ""


def _heading(task: str, page: Path) -> str:
    place = f"{task}.md"
    return f"### [{task}]({place})" if (page.parent / place).is_file() else f"### {task}"


def _pair(values: Sequence[str]) -> str:
    return _NONE if all(value == _NONE for value in values) else " / ".join(values)


def _by_system(systems: Sequence[System], cell: Callable[[System, str], str]) -> str:
    """Return the table of a cell for every system and policy."""
    policies = policies_of(systems)
    lines = [
        [system.task, number(system.first["bound"]), *(cell(system, name) for name in policies)]
        for system in systems
    ]
    return markdown_table(["system", "d̄", *map(policy_label, policies)], lines)


def _successes(system: System, policy: str) -> str:
    found = [system.row(policy, kind) for kind in system.kinds]
    return _pair([_NONE if row is None else _whole(row["success_rate"]) for row in found])


def _whole(rate: float) -> str:
    """Return a rate in percent, without a decimal where there is none."""
    return percent(rate).removesuffix(".0")


def _worst_cell(system: System, policy: str) -> str:
    success, error = (system.worst(policy, goal) for goal in (SUCCESS, ERROR))
    if success is None:
        return _NONE
    error_text = number(None if error is None else error["error_per_bound"])
    return f"{100.0 * success['success_rate']:.0f}, {error_text}"


def _worst_blocks(systems: Sequence[System], budget: int) -> Iterator[str]:
    systems = _searched(systems)
    if not systems:
        return
    episodes = max(
        row["episodes"] for name in systems[0].policies if (row := systems[0].worst(name, SUCCESS))
    )
    yield "## Worst found"
    yield (
        f"Success [%] of {episodes} episodes under the worst disturbance within d̄ that a search "
        f"with a budget of {budget} flights each found (`lagros attack --goal success`), then the "
        "largest ‖x − x_d‖/d̄ [s] that another found (`--goal error`; of policies that do not "
        "follow x_d it says little). A longer search may find worse: these are *observed*. A dash: "
        "the policy keeps a memory, which the search cannot fly."
    )
    yield _by_system(systems, _worst_cell)


def _proved_blocks(systems: Sequence[System]) -> Iterator[str]:
    rows = []
    for system in systems:
        found = [system.proved(name) for name in OURS]
        plans = [row["episodes"] for row in found if row is not None]
        if plans:
            shares = [_NONE if row is None else percent(row["guaranteed_rate"]) for row in found]
            rows.append([system.task, str(plans[0]), *shares])
    if not rows:
        return
    yield "## Proved [%]"
    yield (
        "Share of plans of which it is *proved*, over every disturbance within d̄, that the flight "
        "succeeds and breaks no rule of its task. A dash: no proof of ours is about that loop, as "
        "of a network that sees discs from where its body is."
    )
    yield markdown_table(["system", "plans", *map(policy_label, OURS)], rows)


def _ahead(systems: Sequence[System], measure: Measure, rivals: Sequence[str], *kinds: str) -> str:
    """Say on which systems one of ours is ahead of all of some rivals, under all kinds or some."""
    ahead, unknown = [], []
    for system in systems:
        verdicts = [[system.ahead(measure, our, one, *kinds) for one in rivals] for our in OURS]
        if any(all(verdict is True for verdict in one) for one in verdicts):
            ahead.append(system.task)
        elif any(None in one for one in verdicts):
            unknown.append(system.task)
    line = f"on {len(ahead)} of {len(systems)}"
    line += f" ({', '.join(ahead)})" if ahead else ""
    return line + (f"; not all of them flew {', '.join(unknown)}" if unknown else "")


def _ahead_words(systems: Sequence[System]) -> str:
    """Say at once on how many systems one of ours is ahead, and on which not."""
    area, kinds = MEASURES[0], systems[0].kinds
    lines = [
        "Is the contraction law (b), or its network (c), ahead in the area under the error? "
        "*Ahead* is: the whole interval of the paired median ratio below 1, under every kind of "
        "disturbance.",
        "",
        f"- of {', '.join(RIVALS)} together: {_ahead(systems, area, RIVALS)}",
        *(f"- the same under {k} alone: {_ahead(systems, area, RIVALS, k)}" for k in kinds),
        *(f"- of {rival} alone: {_ahead(systems, area, (rival,))}" for rival in RIVALS),
    ]
    searched = _searched(systems)
    means = [
        f"{policy_label(policy)} {100.0 * np.mean(rates):.0f} %"
        for policy in policies_of(searched)
        if len(rates := _worst_rates(searched, policy)) == len(searched)
    ]
    if means:
        names = ", ".join(system.task for system in searched)
        told = f"Success under the worst disturbance found, mean of {names}: {', '.join(means)}."
        lines += ["", told]
    return "\n".join(lines)


def _searched(systems: Sequence[System]) -> list[System]:
    """Return the systems of which worst disturbances were searched."""
    return [one for one in systems if any(one.worst(name, SUCCESS) for name in one.policies)]


def _worst_rates(systems: Sequence[System], policy: str) -> list[float]:
    rows = [system.worst(policy, SUCCESS) for system in systems]
    return [row["success_rate"] for row in rows if row is not None]


def _ahead_blocks(systems: Sequence[System]) -> Iterator[str]:
    yield "## Ahead, and behind"
    yield (
        "Median over paired episodes of the area that (b) or (c) has over that of another policy, "
        "with its interval, bold where that is below 1. An error before the goal is held against "
        "the plan that all share, whether a policy follows it or not: `lqr` does not. Of all three "
        "together ahead, in the two other measures, of episodes that begin beside their plan:"
    )
    yield "\n".join(f"- {one.name}: {_ahead(systems, one, RIVALS)}" for one in MEASURES[1:])
    yield _learned(systems)
    kinds = systems[0].kinds
    headings = ["system", "policy"]
    headings += [f"area / {rival}, {kind}" for rival in RIVALS for kind in kinds]
    lines = [
        [
            system.task,
            policy_label(ours),
            *(
                _ratio(system.ratio(MEASURES[0], ours, rival, kind))
                for rival in RIVALS
                for kind in kinds
            ),
        ]
        for system in systems
        for ours in OURS
        if ours in system.policies
    ]
    yield markdown_table(headings, lines) if lines else ""


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
        f"share of fresh states: {', '.join(shares)}. Where that is low it flies without what its "
        "method is about. Its settings are the published ones or, where those leave it unmet on "
        "more than half of the states, the best in flight of the same three for every system."
    )


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
    count = max(system.episodes)
    earlier = count != result["settings"]["episodes"]
    other = f" Of an earlier run: {count} episodes, the weights of that time." if earlier else ""
    yield f"d̄ = {first['bound']:g} per second, units {units}.{other}"
    headings = [
        "policy",
        *(f"success, {kind} [%]" for kind in system.kinds),
        *("strict [%]", "area", "normalised area [s]", "peak", "C", "rate [1/s]", "effort"),
        "Δt [ms]",
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
    known = [row for row in (*plain, *beside) if row is not None]

    def both(group: Sequence[Row | None], show: Callable[[Row], str]) -> str:
        return _pair([_NONE if row is None else show(row) for row in group])

    return [
        row_label(*known) + ("" if len(known) == len(plain) * 2 else " (in part)"),
        *(
            _NONE if row is None else with_interval(row["success_rate"], row["success_ci95"])
            for row in plain
        ),
        both(plain, lambda row: _whole(row["strict_success_rate"])),
        both(plain, lambda row: number(row["error_area_mean"])),
        both(beside, lambda row: number(row["normalised_area_mean"])),
        both(beside, lambda row: number(row["overshoot_mean"])),
        both(beside, lambda row: number(row["envelope_overshoot"])),
        both(beside, lambda row: number(row["convergence_rate_mean"])),
        both(plain, lambda row: number(row["effort_mean"])),
        both(plain[:1], lambda row: milliseconds(row["step_time_median_s"])),
    ]


def _worlds_blocks(rows: Sequence[Row], page: Path) -> Iterator[str]:
    """Yield the tables of a task of many agents, in its own columns."""
    yield _heading(rows[0]["task"], page)
    for group in by_condition(rows):
        words = texts(group[0])
        yield f"{condition_title(group[0])}, {group[0]['episodes']} worlds:"
        yield markdown_rows(words.columns(group[0]), words.ordered(group))
