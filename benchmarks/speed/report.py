"""Rows, targets and sections of the report: a table of 80 columns, and JSON."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from lagros_envs.files import write_atomic
from speed.timing import Times

WIDTH = 80
# Above this load another process competes for a core of the two that this project is measured on.
QUIET_LOAD = 1.2
_UNITS = (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6))
_PEERS = ("casadi", "cvxpy", "onnxruntime", "numba")


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        label: What was timed.
        median_s: Median of one call [s], or None for a line without a time.
        p99_s: 99th percentile of one call [s], where it was measured.
        ratio: Time in units of the section's reference, the median over the rounds.
        remark: What else there is to know.
        facts: Further numbers, for the JSON file.
    """

    label: str
    median_s: float | None = None
    p99_s: float | None = None
    ratio: float | None = None
    remark: str = ""
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Target:
    """A number to reach.

    Attributes:
        what: What was measured.
        measured: The value.
        limit: The value to reach.
        unit: Unit of both.
        at_least: Whether the limit is a lower one.
    """

    what: str
    measured: float
    limit: float
    unit: str
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Whether the measured value is on the right side of the limit."""
        inside = self.measured >= self.limit if self.at_least else self.measured <= self.limit
        return bool(inside)


@dataclass(frozen=True)
class Section:
    """One table.

    Attributes:
        title: Title.
        rows: Lines.
        targets: Numbers to reach.
        notes: What the reader must know to read the lines.
        tails: Whether the table shows the 99th percentiles; the JSON file always has them.
    """

    title: str
    rows: Sequence[Row]
    targets: Sequence[Target] = ()
    notes: Sequence[str] = ()
    tails: bool = False


def timed_row(
    label: str, times: Times, reference: Times | None, remark: str = "", **facts: Any
) -> Row:
    """Return the row of a candidate; its ratio is to the reference."""
    ratio = None if reference is None else times.ratio_to(reference)
    counted: dict[str, Any] = {"rounds": int(times.seconds.size)}
    if times.cpu_seconds is not None:
        counted["cpu_median_s"] = float(np.median(times.cpu_seconds))
    return Row(label, times.median, times.p99, ratio, remark, {**counted, **facts})


def absent_row(label: str, package: str) -> Row:
    """Return the row of a peer that is not installed."""
    return Row(label, remark=f"{package} not installed")


def duration(seconds: float | None) -> str:
    """Return a time with three significant digits and its unit; nothing for None."""
    if seconds is None:
        return ""
    unit, size = next(
        ((unit, size) for unit, size in _UNITS if seconds >= 0.9995 * size), _UNITS[-1]
    )
    value = seconds / size
    digits = 2 if value < 9.995 else 1 if value < 99.95 else 0
    return f"{value:.{digits}f} {unit}"


def surroundings(load_before: float) -> dict[str, Any]:
    """Return machine, versions, threads and load, which every published number needs."""
    from lagros_benchmarks.report import records

    versions = records.versions()
    for package in _PEERS:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "machine": records.machine(),
        "versions": versions,
        "threads": records.threads(),
        "load_before": round(load_before, 2),
        "load_after": round(os.getloadavg()[0], 2),
    }


def print_header(console: Console, load: float) -> None:
    """Say what is measured where, and whether the machine is quiet."""
    from lagros_benchmarks.report import records

    console.print(
        f"lagros, speed against peers. {records.machine()['processor']}, Python "
        f"{platform.python_version()}, one thread, load {load:.2f}."
    )
    console.print(
        "Ratio: time in units of the first row's, the median over rounds in which the rows take "
        "turns; above 1 is slower than the first row."
    )
    if load > QUIET_LOAD:
        console.print(
            f"Other processes are running (load {load:.2f} > {QUIET_LOAD}): the times are too "
            "long, the ratios still hold.",
            style="bold",
        )


def print_section(console: Console, section: Section) -> None:
    """Print one table with its notes."""
    table = Table(
        title=section.title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, width=WIDTH
    )
    table.add_column("", no_wrap=True)
    table.add_column("median", justify="right", no_wrap=True)
    if section.tails:
        table.add_column("p99", justify="right", no_wrap=True)
    table.add_column("ratio", justify="right", no_wrap=True)
    table.add_column("", ratio=1)
    for row in section.rows:
        ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
        times = [row.median_s, row.p99_s] if section.tails else [row.median_s]
        table.add_row(row.label, *map(duration, times), ratio, row.remark)
    console.print()
    console.print(table)
    for note in section.notes:
        console.print(note, style="dim", highlight=False)


def print_targets(console: Console, sections: Sequence[Section]) -> None:
    """Print every target with what was measured, and whether it was met."""
    table = Table(title="Targets", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("", "measured", "target", ""):
        table.add_column(heading, justify="left" if heading == "" else "right")
    targets = [target for section in sections for target in section.targets]
    if not targets:
        return
    for target in targets:
        sign = "≥" if target.at_least else "≤"
        table.add_row(
            target.what,
            f"{target.measured:.4g} {target.unit}",
            f"{sign} {target.limit:g} {target.unit}",
            "met" if target.met else "MISSED",
        )
    console.print()
    console.print(table)


def print_versions(console: Console, found: dict[str, Any]) -> None:
    """Print what the times were measured with."""
    listed = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    console.print()
    console.print(f"Versions: {listed}.", style="dim", highlight=False)
    console.print(
        f"Load before and after: {found['load_before']:.2f}, {found['load_after']:.2f}.",
        style="dim",
        highlight=False,
    )


def write_json(
    path: Path, sections: Sequence[Section], found: dict[str, Any], command: str
) -> Path:
    """Write the whole report, atomically."""
    record = {
        "command": command,
        **found,
        "sections": [
            {
                **asdict(section),
                "targets": [{**asdict(target), "met": target.met} for target in section.targets],
            }
            for section in sections
        ],
    }
    return write_atomic(path, json.dumps(record, indent=1, ensure_ascii=False) + "\n")
