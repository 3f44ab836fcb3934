"""The file of a metric: JSON with every bit of its numbers, and its reader."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from lagros_envs.checks import check_positive
from lagros_envs.files import write_atomic
from lagros_envs.reading import MOST_TEXT, Record, named, parse_json, read_bytes
from lagros_policies.contraction.metric import ContractionMetric, Metric, Region, Verification

_FORMAT = "lagros-metric-1"
_BASIS = "cos(theta)^i"
_NETWORK = ".safetensors"


def metric_record(metric: Metric) -> dict[str, Any]:
    """Return a metric as the JSON object that `load_metric` reads; numbers keep every bit."""
    return {
        "format": _FORMAT,
        "basis": _BASIS,
        "coefficients": metric.coefficients.tolist(),
        **design_record(metric),
    }


def design_record(metric: ContractionMetric) -> dict[str, Any]:
    """Return what the file of any metric says of its design; numbers keep every bit."""
    return {
        "alpha": metric.contraction_rate,
        "chi": metric.condition_bound,
        "nu": metric.control_weight,
        "scaling": metric.scaling.tolist(),
        "region": asdict(metric.region),
        "verification": None if metric.verification is None else _check_record(metric.verification),
    }


def design_arguments(record: Record) -> dict[str, Any]:
    """Return the arguments of a metric from what `design_record` made.

    Args:
        record: The record, with any other entries.

    Raises:
        ValueError: An entry is missing, of a wrong type or out of range.
    """
    region = record.record("region")
    region.only([item.name for item in fields(Region)])
    numbers = {name: record.number(name) for name in ("alpha", "chi", "nu")}
    for name, value in numbers.items():
        check_positive(name, value)
    return {
        "contraction_rate": numbers["alpha"],
        "condition_bound": numbers["chi"],
        "control_weight": numbers["nu"],
        "scaling": record.array("scaling", (None,)),
        "region": Region(**{item.name: region.number(item.name) for item in fields(Region)}),
        "verification": None
        if record["verification"] is None
        else _verification(record.record("verification")),
    }


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


def load_metric(path: Path | str | None = None, states: int | None = None) -> Metric:
    """Read a metric.

    Args:
        path: A file written by `save_metric`; None for the shipped cart-pole metric.
        states: Of how many states it must be; None for any number.

    Returns:
        The metric.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not a metric, is a network, is damaged, or of other states.
    """
    if path is None:
        path = Path(__file__).parents[1] / "pretrained" / "cartpole_metric.json"
    data = read_bytes(path, MOST_TEXT)
    if Path(path).suffix == _NETWORK or not _is_text(data):
        raise ValueError(
            f"{named(path)} is no JSON: a network is neither read nor proved here, only a "
            "polynomial is. Give a file of save_metric, as `python -m "
            "lagros_policies.contraction.proof.design --out FILE` writes; for networks there is "
            "load_neural_metric, and their condition is checked on samples"
        )
    record = Record(parse_json(data, named(path), "a metric written by save_metric"), named(path))
    record.must("format", _FORMAT)
    record.must("basis", _BASIS)
    with naming(path):
        metric = Metric(record.array("coefficients"), **design_arguments(record))
        size = len(metric.scaling)
        if states not in (None, size):
            raise ValueError(f"'coefficients' are of {size} states; the system has {states}")
    return metric


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
