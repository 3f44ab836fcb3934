"""The file of a metric: JSON with every bit of its numbers, and its reader."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from lagros_envs.checks import check_name, check_positive, shown
from lagros_envs.files import write_atomic
from lagros_envs.reading import MOST_TEXT, Record, named, parse_json, read_bytes
from lagros_policies.contraction.basis import Basis
from lagros_policies.contraction.metric import (
    ContractionMetric,
    Metric,
    Verification,
    default_basis,
)
from lagros_policies.contraction.regions import BoxRegion, MetricRegion, PlanRegion
from lagros_policies.tasks import REGIONS

# The first of them is of the even coordinate of a region that names no kind.
_FORMAT = "lagros-metric-1"
_BASIS = "cos(theta)^i"
_GENERAL = "lagros-metric-2"
_NETWORK = ".safetensors"
# Regions by their kind in a file; those of tasks are in `lagros_policies.tasks`.
_REGIONS: dict[str, type[Any]] = {"box": BoxRegion, "plans": PlanRegion}


def metric_record(metric: Metric) -> dict[str, Any]:
    """Return a metric as the JSON object that `load_metric` reads; numbers keep every bit.

    Raises:
        TypeError: Its region is of a class of the caller's own.
    """
    first = _kind_of(metric.region) == ""
    degree = len(metric.coefficients) - 1
    plain = first and metric.point == "state" and metric.phi == default_basis(metric.region, degree)
    kind = (
        {"format": _FORMAT, "basis": _BASIS}
        if plain
        else {"format": _GENERAL, "basis": list(metric.phi.terms), "point": metric.point}
    )
    return {**kind, "coefficients": metric.coefficients.tolist(), **design_record(metric)}


def design_record(metric: ContractionMetric) -> dict[str, Any]:
    """Return what the file of any metric says of its design; numbers keep every bit."""
    return {
        "alpha": metric.contraction_rate,
        "chi": metric.condition_bound,
        "nu": metric.control_weight,
        "scaling": metric.scaling.tolist(),
        "region": region_record(metric.region),
        "verification": None if metric.verification is None else _check_record(metric.verification),
    }


def region_record(region: MetricRegion) -> dict[str, Any]:
    """Return a region as what JSON can hold.

    Raises:
        TypeError: It is of a class of the caller's own.
    """
    kind = _kind_of(region)
    if kind is None:
        raise TypeError(f"region={region!r} must be a BoxRegion, a PlanRegion or that of a task")
    arrays = {item.name: getattr(region, item.name) for item in fields(cast(Any, region))}
    plain = {name: np.asarray(value).tolist() for name, value in arrays.items()}
    return {"kind": kind, **plain} if kind else plain


def _kind_of(region: MetricRegion) -> str | None:
    """Return by which kind a region is written; None for none."""
    for kind in (*_REGIONS, *REGIONS):
        if type(region) is _region_class(kind):
            return kind
    return None


def _region_class(kind: str) -> type[Any]:
    if kind in _REGIONS:
        return _REGIONS[kind]
    module, _, name = REGIONS[kind].partition(":")
    found: type[Any] = getattr(importlib.import_module(module), name)
    return found


def design_arguments(record: Record) -> dict[str, Any]:
    """Return the arguments of a metric from what `design_record` made.

    Args:
        record: The record, with any other entries.

    Raises:
        ValueError: An entry is missing, of a wrong type or out of range.
    """
    numbers = {name: record.number(name) for name in ("alpha", "chi", "nu")}
    for name, value in numbers.items():
        check_positive(name, value)
    return {
        "contraction_rate": numbers["alpha"],
        "condition_bound": numbers["chi"],
        "control_weight": numbers["nu"],
        "scaling": record.array("scaling", (None,)),
        "region": _region(record.record("region")),
        "verification": None
        if record["verification"] is None
        else _verification(record.record("verification")),
    }


def _region(record: Record) -> MetricRegion:
    kind = record.text("kind") if "kind" in record.entries else ""
    check_name("kind", kind, (*_REGIONS, *REGIONS))
    wanted = _region_class(kind)
    names = [item.name for item in fields(wanted)]
    record.only(["kind", *names] if kind else names)
    region: MetricRegion
    if kind not in _REGIONS:
        region = wanted(**{name: record.number(name) for name in names})
        return region
    arrays = {name: record.array(name) for name in names}
    if kind == "plans":
        return PlanRegion(**arrays)
    for name, array in arrays.items():
        if array.ndim != 1:
            raise ValueError(f"{record.name}: {name!r} must be a list of numbers")
    return BoxRegion(**{name: tuple(array.tolist()) for name, array in arrays.items()})


def _check_record(check: Verification) -> dict[str, Any]:
    # JSON has no infinity, which is the worst where W_bar is no metric.
    worst = check.worst if math.isfinite(check.worst) else None
    return {**asdict(check), "worst": worst}


def _verification(record: Record) -> Verification:
    record.only([item.name for item in fields(Verification)])
    return Verification(
        samples=record.whole("samples"),
        violations=record.whole("violations"),
        worst=math.inf if record["worst"] is None else record.number("worst"),
        seed=record.whole("seed"),
    )


def save_metric(metric: Metric, path: Path | str) -> None:
    """Write a metric as JSON, atomically; numbers keep every bit."""
    write_atomic(path, json.dumps(metric_record(metric), indent=1, allow_nan=False) + "\n")


def load_metric(path: Path | str, states: int | None = None) -> Metric:
    """Read a metric.

    Args:
        path: A file written by `save_metric`.
        states: Of how many states it must be; None for any number.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not a metric, is a network, is damaged, or of other states.
    """
    data = read_bytes(path, MOST_TEXT)
    if Path(path).suffix == _NETWORK or not _is_text(data):
        raise ValueError(
            f"{named(path)} is no JSON: a network is neither read nor proved here, only a "
            "polynomial is. Give a file of save_metric; the condition of a network is checked on "
            "samples"
        )
    record = Record(parse_json(data, named(path), "a metric written by save_metric"), named(path))
    with naming(path):
        metric = Metric(
            record.array("coefficients"), **_functions(record), **design_arguments(record)
        )
        size = len(metric.scaling)
        if states not in (None, size):
            raise ValueError(f"'coefficients' are of {size} states; the system has {states}")
    return metric


def _functions(record: Record) -> dict[str, Any]:
    """Return basis and point of a metric's file."""
    if record.entries.get("format") != _GENERAL:
        record.must("format", _FORMAT)
        record.must("basis", _BASIS)
        return {}
    terms = record.list("basis")
    if not all(isinstance(term, str) for term in terms):
        raise ValueError(f"{record.name}: 'basis' is {shown(terms)} and must be a list of texts")
    return {"basis": Basis(tuple(terms)), "point": record.text("point")}


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Put the name of a file before what is refused of its numbers, where it is not said yet."""
    try:
        yield
    except (ValueError, ArithmeticError) as error:
        text = str(error)
        raise ValueError(text if named(path) in text else f"{named(path)}: {text}") from error


def _is_text(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True
