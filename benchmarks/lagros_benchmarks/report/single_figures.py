"""Figures of a benchmark of one body: the error over time, or success against the bound."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lagros_benchmarks.report.canvas import (
    BLACK,
    LONGEST_LABEL,
    Drawn,
    canvas,
    caption,
    check_figure_path,
    curve,
    legend,
    log_ordinate,
    save,
    styles,
)
from lagros_benchmarks.report.formats import (
    by_condition,
    condition_title,
    figure_note,
    percent,
    row_label,
)
from lagros_benchmarks.run.experiment import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST_LEGEND = 7  # policies that an empty panel has room for


def draw(rows: Sequence[Row], path: str | Path | None) -> Drawn:
    """Draw the error over time of one condition, or success against the bound of several."""
    return (error_figure if len(by_condition(rows)) == 1 else grid_figure)(rows, path)


def error_figure(rows: Sequence[Row], path: str | Path | None) -> Drawn:
    """Draw the mean tracking error of each policy over time against the paper's tube.

    The bands hold 80 % of the episodes. The axis is logarithmic where a mean leaves the paper's
    tube far behind. Where every nominal plan failed there is no error, and the figure says so.

    Raises:
        ValueError: The rows are of several conditions.
    """
    path = check_figure_path(path)
    if len(by_condition(rows)) != 1:
        raise ValueError("error_figure draws the rows of one condition; use grid_figure")
    drawn = [row for row in rows if row["mean_tracking_error"] is not None]
    figure, (axes,) = canvas(7.0, 4.2)
    if not drawn:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no tracking error: every nominal plan failed", ha="center")
        return save(figure, path)
    times = curve(rows[0]["time_s"])
    published = rows[0]["paper_tube"]
    tube = None if published is None else curve(published)
    width = 0.0 if tube is None else float(tube[-1])
    means = {row["policy"]: curve(row["mean_tracking_error"]) for row in drawn}
    top = max(float(np.nanmax(mean)) for mean in means.values())
    logarithmic = tube is not None and top > 3.0 * width
    floor = 0.0
    if logarithmic:
        floor = 0.5 * min(float(np.nanmin(mean[len(mean) // 8 :])) for mean in means.values())
    ceiling = max(1.15 * width, (2.0 if logarithmic else 1.1) * top)
    labels: list[tuple[float, str, str]] = []
    for name, style in styles([row["policy"] for row in drawn]).items():
        row = next(row for row in drawn if row["policy"] == name)
        low, high = curve(row["tracking_error_p10"]), curve(row["tracking_error_p90"])
        axes.fill_between(times, low, high, color=style.colour, alpha=0.15, linewidth=0)
        axes.plot(times, means[name], color=style.colour, linestyle=style.line, linewidth=2)
        last = means[name][np.isfinite(means[name])][-1]
        labels.append((float(last), row_label(row, longest=LONGEST_LABEL), style.colour))
        if row["certified_tube"] is not None:
            proved = curve(row["certified_tube"])
            axes.plot(times, proved, color=style.colour, linestyle=(0, (1, 1)), linewidth=1)
            name = row_label(row, longest=LONGEST_LABEL)
            labels.append((float(proved[-1]), f"{name}: proved", style.colour))
    if tube is not None:
        axes.plot(times, tube, color=BLACK, linewidth=1.5)
        labels.append((width, "paper tube r(t)", BLACK))
    axes.set(xlim=(times[0], times[-1]), ylim=(max(floor, 1e-3) if logarithmic else 0.0, ceiling))
    if logarithmic:
        log_ordinate(axes)  # without the zero at which the tube begins
    units = (rows[0].get("units") or {"state": "m, rad, m/s, rad/s"})["state"]
    error = "tracking error $\\|x - x_d\\|$" + (f"  [{units}]" if units else "")
    axes.set(xlabel="time t [s]", ylabel=error)
    episodes = rows[0]["episodes"]
    axes.set_title(f"{condition_title(rows[0])}, {episodes} episodes", loc="left", fontsize=10)
    text = "lines: mean; bands: 10th to 90th percentile; a fall keeps its largest error"
    shares = [percent(row["guaranteed_rate"]) for row in drawn if row["certified_tube"] is not None]
    if shares:
        text += (
            "\nproved: of every disturbance up to the bound, of "
            + ", ".join(shares)
            + " % of the plans"
        )
    caption(figure, text + figure_note(rows))
    _label_ends(axes, labels)
    return save(figure, path)


def grid_figure(rows: Sequence[Row], path: str | Path | None) -> Drawn:
    """Draw the success rate of each policy against the bound, one panel per kind."""
    path = check_figure_path(path)
    kinds = list(dict.fromkeys(row["disturbance"] for row in rows))
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    columns = _columns(len(kinds))
    lines = -(-len(kinds) // columns)
    figure, panels = canvas(max(2.6 * columns, 4.5), 2.3 * lines + 0.9, lines, columns)
    bounds = sorted({row["bound"] for row in rows})
    # Policies of equal success would hide each other: each is moved by a little.
    step = 0.012 * (max(bounds) - min(bounds) or 1.0)
    for kind, axes in zip(kinds, panels, strict=False):
        for index, (name, style) in enumerate(styles(policies).items()):
            own = [row for row in rows if row["disturbance"] == kind and row["policy"] == name]
            own.sort(key=lambda row: float(row["bound"]))
            rates = 100 * curve([row["success_rate"] for row in own])
            ends = 100 * np.array([row["success_ci95"] for row in own]).reshape(-1, 2)
            places = curve([row["bound"] for row in own]) + step * (index - (len(policies) - 1) / 2)
            axes.errorbar(
                places,
                rates,
                yerr=np.abs(ends.T - rates),
                color=style.colour,
                linestyle=style.line,
                marker=style.marker,
                markersize=5,
                capsize=2,
                linewidth=1.6,
                elinewidth=1,
                # Of all panels: one legend is about every kind.
                label=row_label(*_of(rows, name), longest=LONGEST_LABEL),
            )
        axes.set_title(kind, loc="left", fontsize=10)
        axes.set(ylim=(-4, 104), yticks=(0, 25, 50, 75, 100))
    for index, axes in enumerate(panels):
        if index >= len(kinds):
            axes.set_axis_off()
        elif index + columns >= len(kinds):
            # Shared axes label the last line only, where this column may have no panel.
            axes.tick_params(labelbottom=True)
    note = figure_note(rows)
    figure.supxlabel(f"disturbance bound d̄  [state units/s]{note}", fontsize=10)
    figure.supylabel("success [%], 95 % interval", fontsize=10)
    handles, names = panels[0].get_legend_handles_labels()
    if len(kinds) < len(panels) and len(names) <= _LONGEST_LEGEND:
        empty = panels[len(kinds)]
        empty.legend(handles, names, loc="center left", frameon=False, handlelength=3.5)
    else:
        legend(figure, panels[0])
    return save(figure, path)


def _of(rows: Sequence[Row], policy: str) -> list[Row]:
    return [row for row in rows if row["policy"] == policy]


def _columns(panels: int) -> int:
    """Return how many panels stand beside each other: up to three, or four if fewer stay empty."""
    return min(range(min(panels, 3), min(panels, 4) + 1), key=lambda columns: -panels % columns)


def _label_ends(axes: Axes, labels: list[tuple[float, str, str]]) -> None:
    """Write each label right of the end of its line, moved apart where they would overlap."""
    transform = axes.transData + axes.transAxes.inverted()
    placed = sorted((float(transform.transform((0.0, y))[1]), text, c) for y, text, c in labels)
    spacing = 0.065
    heights = np.clip([height for height, _, _ in placed], 0.0, 1.0)
    for index in range(1, len(heights)):
        heights[index] = max(heights[index], heights[index - 1] + spacing)
    # What was pushed over the top comes down again, and pushes those below.
    heights[-1] = min(heights[-1], 1.0)
    for index in range(len(heights) - 2, -1, -1):
        heights[index] = min(heights[index], heights[index + 1] - spacing)
    for height, (_, text, colour) in zip(heights, placed, strict=True):
        axes.annotate(
            text,
            (1.0, float(height)),
            xycoords="axes fraction",
            xytext=(6, 0),
            textcoords="offset points",
            color=colour,
            fontweight="bold",
            fontsize=9,
            va="center",
        )
