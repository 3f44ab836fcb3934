"""Figures of a spacecraft benchmark: success and effort, or success and time, from its rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lagros_benchmarks.report.canvas import (
    LONGEST_LABEL,
    Drawn,
    Style,
    canvas,
    caption,
    check_figure_path,
    curve,
    legend,
    log_ordinate,
    save,
    styles,
)
from lagros_benchmarks.report.formats import disturbance_title, figure_note, row_label, task_title
from lagros_benchmarks.run.experiment import Row
from lagros_envs.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDE_RANGE = 12.0  # of efforts, from which their axis is logarithmic
_NARROWEST = 7.2  # so that the legend of four policies fits [inch]


class _Measure(NamedTuple):
    """One line of panels: what is drawn, its interval, and its label."""

    value: Callable[[Row], float | None]
    interval: Callable[[Row], Any]
    label: str


_SUCCESS = _Measure(
    lambda row: 100.0 * row["success_rate"],
    lambda row: [100.0 * end for end in row["success_world_ci95"]],
    "success [%]",
)
_EFFORT = _Measure(
    lambda row: row["effort_mean"],
    lambda row: row["effort_ci95"],
    "effort $\\int\\|u\\|^2dt$ [N²s]",
)


def draw(rows: Sequence[Row], path: str | Path | None) -> Drawn:
    """Draw success and effort against the bound, or success and time against the number of agents.

    Where there is one condition, success and effort of each policy are drawn side by side.
    """
    path = check_figure_path(path)
    if len({row["agents"] for row in rows}) > 1:
        return _sweep_figure(rows, path, "agents")
    if len({(row["disturbance"], row["bound"]) for row in rows}) > 1:
        return _sweep_figure(rows, path, "bound")
    return _policy_figure(rows, path)


def _sweep_figure(rows: Sequence[Row], path: Path | None, along: str) -> Drawn:
    """Draw success above, and below it effort along the bounds or time along the agents."""
    scale = along == "agents"
    keys = ("disturbance", "bound", "safety_filter") if scale else ("disturbance", "safety_filter")
    columns = _columns(rows, keys)
    figure, panels = canvas(max(_NARROWEST, 3.1 * len(columns) + 0.9), 5.0, 2, len(columns), "row")
    marks = sorted({row[along] for row in rows})
    for index, (title, part) in enumerate(columns):
        success, below = panels[index], panels[index + len(columns)]
        success.set_title(title, loc="left", fontsize=10)
        _draw_lines(success, part, along, _SUCCESS)
        if scale:
            _draw_times(below, part)
            below.set(xscale="log", xlabel="agents in the world")
            below.set_xticks(marks, [str(count) for count in marks])
            below.minorticks_off()
        else:
            _draw_lines(below, part, along, _EFFORT)
            below.set(xlabel="disturbance bound d̄ [state units/s]")
            below.set_xticks(marks)
    panels[0].set(ylim=(-4, 104), yticks=(0, 25, 50, 75, 100), ylabel=_SUCCESS.label)
    first, below = rows[0], panels[len(columns)]
    efforts = [row["effort_mean"] for row in rows if row["effort_mean"]]
    if scale or (efforts and max(efforts) > _WIDE_RANGE * min(efforts)):
        log_ordinate(below)
    else:
        below.set_ylim(bottom=0.0)
    below.set_ylabel("time [ms], median" if scale else _EFFORT.label)
    if scale:
        text = (
            f"{first['task']}, {first['preset']}, {first['episodes']} worlds per point; success "
            "per agent; bands: 95 % intervals over worlds\ntime: filled, one agent's decision, or "
            "one plan for all agents; open, per agent where one call decides for all"
        )
    else:
        text = (
            f"{task_title(first)}, {first['episodes']} worlds per point; success per agent; bands: "
            "95 % intervals over worlds"
        )
    caption(figure, text + figure_note(rows))
    legend(figure, panels[0])
    return save(figure, path)


def _draw_times(axes: Axes, rows: Sequence[Row]) -> None:
    for own, style in _lines(rows, "agents"):
        places = curve([row["agents"] for row in own])
        delay = [_first_known(row, "plan_time_median_s", "step_time_median_s") for row in own]
        _draw_line(axes, places, 1e3 * curve(delay), style)
        if own[0]["plan_time_median_s"] is None:
            axes.plot(
                places,
                1e3 * curve([row["step_time_batch_per_agent_s"] for row in own]),
                color=style.colour,
                linewidth=0.9,
                linestyle="dotted",
                marker=style.marker,
                markersize=4,
                markerfacecolor="white",
            )


def _policy_figure(rows: Sequence[Row], path: Path | None) -> Drawn:
    """Draw success and effort of each policy under one condition, the filter as a filled mark."""
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    figure, panels = canvas(7.0, 1.2 + 0.45 * len(policies), 1, 2, abscissa=False)
    for axes, measure in zip(panels, (_SUCCESS, _EFFORT), strict=True):
        for line, (name, style) in enumerate(styles(policies).items()):
            own = [row for row in rows if row["policy"] == name]
            for row in own:
                value = measure.value(row)
                if value is None:
                    continue
                shift = 0.16 if row["safety_filter"] else -0.16
                low, high = measure.interval(row) or (value, value)
                axes.errorbar(
                    [value],
                    [line + (shift if len(own) > 1 else 0.0)],
                    xerr=[[max(value - low, 0.0)], [max(high - value, 0.0)]],
                    color=style.colour,
                    marker=style.marker,
                    markerfacecolor=style.colour if row["safety_filter"] else "white",
                    capsize=2,
                )
        axes.set_xlabel(measure.label)
        axes.grid(axis="y", visible=False)
        axes.grid(axis="x", color="#DDDDDD", linewidth=0.6)
    panels[1].set_xlim(left=0.0)
    labels = [
        row_label(*(row for row in rows if row["policy"] == name), longest=LONGEST_LABEL)
        for name in policies
    ]
    panels[0].set_yticks(range(len(policies)), labels)
    panels[0].set_ylim(len(policies) - 0.5, -0.5)
    first = rows[0]
    figure.suptitle(
        f"{task_title(first)}, {disturbance_title(first)}, {first['episodes']} worlds",
        x=0.01,
        ha="left",
        fontsize=10,
    )
    caption(
        figure,
        "success per agent; bars: 95 % intervals over worlds; open: without, filled: with the "
        "safety filter" + figure_note(rows),
    )
    return save(figure, path)


def _columns(rows: Sequence[Row], names: Sequence[str]) -> list[tuple[str, list[Row]]]:
    """Group rows by these keys; a title says which of them vary."""
    keys = list(dict.fromkeys(tuple(row[name] for name in names) for row in rows))
    varied = [name for at, name in enumerate(names) if len({key[at] for key in keys}) > 1]
    columns = []
    for key in keys:
        part = [row for row in rows if tuple(row[name] for name in names) == key]
        words = [_worded(name, part[0]) for name in names if name in varied]
        if not varied:
            words = ["with the safety filter" if part[0]["safety_filter"] else ""]
        columns.append((", ".join(words), part))
    return columns


def _worded(name: str, row: Row) -> str:
    if name == "safety_filter":
        return "with the safety filter" if row[name] else "without filter"
    return f"d̄ = {row[name]:g}" if name == "bound" else str(row[name])


def _lines(rows: Sequence[Row], along: str) -> list[tuple[list[Row], Style]]:
    """Return the rows of each policy, sorted along the abscissa, with its style."""
    found = styles(list(dict.fromkeys(row["policy"] for row in rows)))
    return [
        (sorted((r for r in rows if r["policy"] == name), key=lambda r: float(r[along])), style)
        for name, style in found.items()
    ]


def _draw_lines(axes: Axes, rows: Sequence[Row], along: str, measure: _Measure) -> None:
    for own, style in _lines(rows, along):
        places = curve([row[along] for row in own])
        values = curve([measure.value(row) for row in own])
        ends = [measure.interval(row) or (np.nan, np.nan) for row in own]
        low, high = np.array(ends, dtype=np.float64).T
        axes.fill_between(places, low, high, color=style.colour, alpha=0.15, linewidth=0)
        _draw_line(axes, places, values, style, row_label(*own, longest=LONGEST_LABEL))


def _draw_line(
    axes: Axes, places: FloatArray, values: FloatArray, style: Style, label: str | None = None
) -> None:
    axes.plot(
        places,
        values,
        color=style.colour,
        linestyle=style.line,
        marker=style.marker,
        markersize=5,
        linewidth=1.6,
        label=label,
    )


def _first_known(row: Row, *names: str) -> float | None:
    return next((row[name] for name in names if row[name] is not None), None)
