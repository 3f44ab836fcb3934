"""The file of a metric: JSON with every bit of its numbers, and its reader."""

from __future__ import annotations

import json
from collections.abc import Mapping, Set
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.files import write_atomic
from lagros_policies.contraction.metric import ContractionMetric, Metric, Region, Verification

FloatArray = NDArray[np.float64]

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
        "verification": None if metric.verification is None else asdict(metric.verification),
    }


def design_arguments(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a metric from what `design_record` made.

    Args:
        record: The record, with any other entries.

    Raises:
        KeyError: An entry is missing.
        TypeError: An entry has a wrong type.
        ValueError: A number is out of range, or is text or true or false.
    """
    region = _entries(record, "region", {item.name for item in fields(Region)})
    verification: Verification | None = None
    if record["verification"] is not None:
        check = _entries(record, "verification", {item.name for item in fields(Verification)})
        verification = Verification(**check)
    return {
        "contraction_rate": number(record, "alpha"),
        "condition_bound": number(record, "chi"),
        "control_weight": number(record, "nu"),
        "scaling": numbers(record, "scaling"),
        "region": Region(**region),
        "verification": verification,
    }


def _entries(record: Mapping[str, Any], name: str, known: Set[str]) -> dict[str, Any]:
    """Return an object of a JSON object, of numbers under known names."""
    value = record[name]
    if not isinstance(value, Mapping) or set(value) != known:
        found = sorted(value) if isinstance(value, Mapping) else value
        raise ValueError(f"{name}={found!r} must be an object with {', '.join(sorted(known))}")
    only_numbers(value, name)
    return dict(value)


def number(record: Mapping[str, Any], name: str) -> float:
    """Return a number of a JSON object; text and true, which Python takes for one, are refused.

    Args:
        record: The object.
        name: Key of the number.

    Raises:
        KeyError: There is no such key.
        ValueError: It is no number.
    """
    value = record[name]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name}={value!r} must be a number: write it without quotes")
    return _as_float(value, name)


def _as_float(value: float, name: str) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ValueError(f"{name} holds a whole number that is too large for a double") from None


def numbers(record: Mapping[str, Any], name: str) -> FloatArray:
    """Return nested lists of numbers of a JSON object as an array; see `number`.

    Raises:
        KeyError: There is no such key.
        ValueError: An entry is no number, or the lists are of different lengths.
    """
    only_numbers(record[name], name)
    try:
        return np.array(record[name], dtype=np.float64)
    except (ValueError, OverflowError, TypeError) as error:
        raise ValueError(f"{name} must be lists of one length, of finite numbers") from error


def only_numbers(value: Any, name: str) -> None:
    """Refuse text, true, false and null anywhere inside lists and objects of JSON.

    Args:
        value: What JSON was read to.
        name: What it is called in the message.

    Raises:
        ValueError: There is one.
    """
    if isinstance(value, Mapping | list):
        for item in value.values() if isinstance(value, Mapping) else value:
            only_numbers(item, name)
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} holds {value!r}, which must be a number: write it without quotes")


def read_text(path: Path | str) -> str:
    """Return the text of a metric's file, which is JSON; a network is refused by name.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is a network, or no text.
    """
    data = Path(path).read_bytes()
    try:
        text = data.decode()
    except UnicodeDecodeError:
        text = ""
    if Path(path).suffix == _NETWORK or (data and not text):
        raise ValueError(
            f"{path} is no JSON: a network is neither read nor proved here, only a polynomial is. "
            "Give a file of save_metric, as `python -m lagros_policies.contraction.proof.design "
            "--out FILE` writes; for networks there is load_neural_metric, and their condition is "
            "checked on samples"
        )
    return text


def save_metric(metric: Metric, path: Path | str) -> None:
    """Write a metric as JSON, atomically; numbers keep every bit."""
    write_atomic(path, json.dumps(metric_record(metric), indent=1) + "\n")


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
    text = read_text(path)
    try:
        record = json.loads(text)
        for name, wanted in (("format", _FORMAT), ("basis", _BASIS)):
            if record[name] != wanted:
                raise ValueError(f"{name} {record[name]!r} is not {wanted!r}")
        metric = Metric(numbers(record, "coefficients"), **design_arguments(record))
        size = len(metric.scaling)
        if states not in (None, size):
            raise ValueError(f"coefficients are of {size} states; the system has {states}")
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"{path} is not a metric written by save_metric: {reason}") from error
    return metric
