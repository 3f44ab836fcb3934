"""Figures of a benchmark, drawn from its rows alone (so a saved JSON can be drawn again)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lagros_benchmarks.report.canvas import Drawn, check_figure_path
from lagros_benchmarks.run.experiment import Row
from lagros_benchmarks.run.room import room_named

__all__ = ["check_figure_path", "draw"]


def draw(rows: Sequence[Row], path: str | Path | None) -> Drawn:
    """Draw what is apt for the task and the conditions of some rows of one task; see `save`."""
    drawn: Drawn = room_named(rows[0]["task"]).part("figures")(rows, path)
    return drawn
