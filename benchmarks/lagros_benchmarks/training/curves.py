"""Learning curves of several seeds: the median with an interval, as JSON and as a figure.

The median of independent runs lies between the least and the largest of n of them with confidence
1 - 2^(1 - n), whatever their distribution: 93.75 % for five.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lagros_benchmarks.report.canvas import (
    Style,
    canvas,
    caption,
    check_figure_path,
    curve,
    legend,
    save,
    styles,
)
from lagros_benchmarks.run.surroundings import machine, versions
from lagros_benchmarks.training.course import course_of
from lagros_envs.registry import find_task

# What a point of a curve has besides its figures.
AXES = ("steps", "seconds", "cpu_seconds")


def range_confidence(runs: int) -> float:
    """Return the confidence that the range of so many runs holds the median of all.

    Raises:
        ValueError: There is no run.
    """
    if runs < 1:
        raise ValueError(f"runs={runs!r} must be at least 1")
    return float(1.0 - 2.0 ** (1 - runs))


def curves_of(records: Sequence[dict[str, Any]], command: str) -> dict[str, Any]:
    """Put the records of runs of one task together, in one curve those that differ in the seed.

    Returns:
        One entry per algorithm, JSON-serialisable: the figures after every segment with median,
        least and largest over the seeds, and those at the end of each seed.

    Raises:
        ValueError: There is no record, or they are of several tasks, or runs of one algorithm
            differ in more than the seed, or a seed is there twice.
    """
    tasks = {record["training"]["task"] for record in records}
    if len(tasks) != 1:
        raise ValueError(f"curves are of one task, not of {sorted(tasks)}")
    groups: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault(_label(record["training"]), []).append(record)
    return {
        "command": command,
        "task": tasks.pop(),
        "interval": "median of the seeds, least and largest of them",
        "curves": [_curve(label, group) for label, group in groups.items()],
        "machine": machine(),
        "versions": versions(),
    }


def _label(training: dict[str, Any]) -> str:
    correction = training.get("largest_correction")
    name = str(training["algorithm"]["name"])
    if correction is None:
        return name
    unit = find_task(training["task"]).control_unit  # type: ignore[attr-defined]
    return f"residual, {correction:g}{' ' * bool(unit)}{unit} ({name})"


def _curve(label: str, group: Sequence[dict[str, Any]]) -> dict[str, Any]:
    shared = [{**record["training"], "seed": None} for record in group]
    if any(settings != shared[0] for settings in shared):
        raise ValueError(f"the runs of {label} differ in more than the seed")
    seeds = [record["training"]["seed"] for record in group]
    if len(set(seeds)) < len(seeds):
        # The confidence of the range is that of independent runs.
        raise ValueError(f"the runs of {label} have the seeds {seeds}; give each of them once")
    names = [name for name in group[0]["curve"] if name not in AXES]
    return {
        "label": label,
        "training": shared[0],
        "seeds": seeds,
        "confidence_of_range": range_confidence(len(group)),
        "steps": group[0]["curve"]["steps"],
        "figures": {name: _spread([record["curve"][name] for record in group]) for name in names},
        "seconds": [record["curve"]["seconds"][-1] for record in group],
        "cpu_seconds": [record["curve"]["cpu_seconds"][-1] for record in group],
        "final": [record["final"] for record in group],
    }


def _spread(curves: Sequence[Sequence[float]]) -> dict[str, Any]:
    values = np.asarray(curves, dtype=np.float64)
    return {
        "median": np.median(values, axis=0).round(6).tolist(),
        "least": values.min(axis=0).tolist(),
        "largest": values.max(axis=0).tolist(),
        "of_seeds": values.tolist(),
    }


def draw(curves: dict[str, Any], path: str | Path) -> Path:
    """Draw the curves of `curves_of`: lines are medians, bands the range of the seeds."""
    path = check_figure_path(path)
    task = find_task(curves["task"])
    course = course_of(task)
    panels = course.panels(task)
    figure, axes = canvas(6.0, 1.0 + 1.9 * len(panels), len(panels), 1, share="row")
    looks = _looks([group["label"] for group in curves["curves"]])
    for panel, (name, title, factor) in zip(axes, panels, strict=True):
        for group in curves["curves"]:
            spread, style = group["figures"][name], looks[group["label"]]
            steps = 1e-6 * curve(group["steps"])
            low, middle, high = (
                factor * curve(spread[part]) for part in ("least", "median", "largest")
            )
            panel.fill_between(steps, low, high, color=style.colour, alpha=0.2, linewidth=0)
            panel.plot(
                steps,
                middle,
                color=style.colour,
                linestyle=style.line,
                linewidth=1.8,
                label=group["label"],
            )
        panel.set_title(title, loc="left", fontsize=10)
        if factor == 100.0:
            panel.set_ylim(-4.0, 104.0)
    legend(figure, axes[0])
    axes[-1].set_xlim(left=0.0)
    axes[-1].set_xlabel(course.abscissa)
    caption(figure, _caption(curves))
    return save(figure, path)


def _looks(labels: Sequence[str]) -> dict[str, Style]:
    """Return a style for each label; an agent looks as it does in the figures of `lagros bench`."""
    # The policy `residual` is one of the corrections; a second one is told apart from it.
    first = next((label for label in labels if label.startswith("residual")), None)
    policies = {label: "residual" if label == first else label for label in labels}
    found = styles(list(policies.values()))
    return {label: found[policy] for label, policy in policies.items()}


def _caption(curves: dict[str, Any]) -> str:
    groups = curves["curves"]
    counts = sorted({len(group["seeds"]) for group in groups})
    if counts == [1]:
        return "one seed each, so that there is no interval"
    confidence = min(group["confidence_of_range"] for group in groups)
    return (
        f"lines: median of {', '.join(map(str, counts))} seeds; bands: their range, which holds\n"
        f"the median of all seeds with confidence {100.0 * confidence:.4g} %"
    )
