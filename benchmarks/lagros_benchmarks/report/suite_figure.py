"""The figure of the suite: success against the area under the error, system by system."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lagros_benchmarks.report.canvas import (
    Drawn,
    canvas,
    check_figure_path,
    legend,
    save,
    styles,
)
from lagros_benchmarks.report.formats import policy_label
from lagros_benchmarks.report.suite_rows import policies_of, systems_of
from lagros_benchmarks.run.experiment import Row


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
    policies = policies_of(systems)
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
