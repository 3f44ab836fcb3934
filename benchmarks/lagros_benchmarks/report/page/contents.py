"""What a page holds: its table, its figures and the episodes that it plays, as one JSON object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lagros_benchmarks.report import tables
from lagros_benchmarks.report.canvas import LONGEST_LABEL, styles
from lagros_benchmarks.report.formats import (
    agents_title,
    by_condition,
    names_lines,
    policy_label,
    row_label,
)
from lagros_benchmarks.report.page.reels import Reel, joined
from lagros_benchmarks.run.experiment import Row
from lagros_envs.task import Described, Task

Content = dict[str, Any]
# Of a row, what the page says once, or not at all.
_LEFT_OUT = {"machine", "versions", "threads", "command", "versus", "filter_effect", "counters"}
_LEFT_OUT |= {"errors"}


def of_rows(rows: Sequence[Row], task: Described) -> Content:
    """Return what a page says of the rows of a run, without episodes."""
    groups = by_condition(rows)
    first, whole = rows[0], [tables.texts(group[0]).ordered(group) for group in groups]
    series = _series(rows)
    columns = tables.texts(first).columns(first)
    return {
        **_of_task(task),
        "title": f"{task.title}, {first['episodes']} episodes, seed {first['seed']}",
        "command": first["command"],
        "made": ", ".join(f"{name} {text}" for name, text in first["versions"].items()),
        "legend": tables.legend(rows),
        "lines": [*names_lines(rows), *tables.error_lines(rows)],
        "columns": [[heading, unit] for heading, unit, _ in columns],
        "effort": (first.get("units") or {"effort": "N²s"})["effort"],
        "series": list(series.values()),
        "conditions": [
            _condition(group[0], list(tables.comparison_lines(group))) for group in groups
        ],
        "rows": [
            {
                "condition": index,
                "series": list(series).index(_who(row)),
                "cells": [cell(row).strip() for _, _, cell in columns],
                "figures": {name: one for name, one in row.items() if name not in _LEFT_OUT},
            }
            for index, group in enumerate(whole)
            for row in group
        ],
        "episodes": [],
    }


def of_episode(
    task: Described, policy: str, condition: Mapping[str, Any], seed: int, reel: Reel
) -> Content:
    """Return what a page says of one episode.

    Args:
        task: The task.
        policy: Its name.
        condition: `disturbance`, `bound`, and `agents` of a world of many.
        seed: Of the episode.
        reel: What was noted.
    """
    label = policy_label(policy, LONGEST_LABEL)
    return {
        **_of_task(task),
        "title": f"{task.title}, {label}, seed {seed}",
        "series": list(_series([{**condition, "policy": policy, "safety_filter": False}]).values()),
        "conditions": [_condition(condition, [])],
        "rows": [],
        "lines": [],
        "episodes": [episode(0, 0, seed, [], {0: reel})],
    }


def episode(
    condition: int, index: int, seed: int, why: Sequence[tuple[int, str]], reels: dict[int, Reel]
) -> Content:
    """Return an episode that a page plays.

    Args:
        condition: Index of its condition.
        index: Which of the run's it is, from 0.
        seed: Its seed.
        why: Why it is kept: indices of policies, and reasons.
        reels: What each policy made of it, by the policy's index.
    """
    scene = next(iter(reels.values())).scene
    flights = {str(series): reel.flight for series, reel in reels.items()}
    view = joined(scene["box"], list(flights.values()))
    return {
        "condition": condition,
        "index": index,
        "seed": str(seed),  # a script knows whole numbers up to 2^53 alone
        "why": [list(reason) for reason in why],
        "scene": {**scene, "view": np.round(view, 4).tolist()},
        "flights": flights,
    }


def series_at(rows: Sequence[Row], policy: str, filtered: bool) -> int:
    """Return the index of a policy, with the safety filter or without, among those of a page."""
    return list(_series(rows)).index((policy, filtered))


def _who(row: Row) -> tuple[str, bool]:
    return row["policy"], bool(row["safety_filter"])


def _series(rows: Sequence[Row]) -> dict[tuple[str, bool], Content]:
    """Return how each policy is called and drawn, by its name and whether it is filtered."""
    found: dict[tuple[str, bool], list[Row]] = {}
    for row in rows:
        found.setdefault(_who(row), []).append(row)
    looks = styles(list(dict.fromkeys(name for name, _ in found)))
    both = len({filtered for _, filtered in found}) > 1
    series = {}
    for (name, filtered), own in found.items():
        marked = policy_label(name, LONGEST_LABEL)
        if "errors" in own[0]:
            marked = row_label(*own, longest=LONGEST_LABEL)
        look = looks[name]
        series[name, filtered] = {
            "name": name,
            "label": f"{marked} + filter" if filtered and both else marked,
            "colour": look.colour,
            "dashes": "" if look.line == "solid" else " ".join(map(str, look.line[1])),
            "filled": filtered or not both,
        }
    return series


def _condition(row: Mapping[str, Any], lines: list[str]) -> Content:
    agents = agents_title(dict(row)) if row.get("agents") is not None else ""
    return {
        "kind": row["disturbance"],
        "bound": row["bound"],
        "agents": agents,
        "lines": lines,
    }


def _of_task(task: Described) -> Content:
    """Return what the player says and draws of a task."""
    corners: list[int] = []
    states: list[str] = []
    if isinstance(task, Task):
        count = task.system.state_dim
        corners = [len(one) for one in task.outline(np.zeros(count))]
        states = list(task.state_names or (f"x{index}" for index in range(count)))
    return {
        "task": task.name,
        "corners": corners,
        "states": states,
        "speed": task.defaults.speed,
    }
