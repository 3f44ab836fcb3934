"""Arrays as text: whole numbers of 16 bits in base64, which a page reads into what it draws."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lagros_envs.arrays import FloatArray

_MOST = 32767
_NOTHING = -32768  # stands for what is not finite


def packed(values: ArrayLike) -> dict[str, Any]:
    """Return an array as steps between its least and its largest entry; nan where not finite.

    An entry is off by at most 1/131068 of the span.
    """
    array = np.asarray(values, np.float64)
    finite = array[np.isfinite(array)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    step = (high - low) / (2 * _MOST) or 1.0
    with np.errstate(invalid="ignore"):
        steps = np.round((array - low) / step) - _MOST
    steps = np.where(np.isfinite(array), steps, _NOTHING)
    text = base64.b64encode(steps.astype("<i2").tobytes()).decode("ascii")
    return {"shape": list(array.shape), "low": low, "step": step, "data": text}


def unpacked(given: dict[str, Any]) -> FloatArray:
    """Return the array of what `packed` returned, as the page reads it."""
    steps = np.frombuffer(base64.b64decode(given["data"]), "<i2").astype(np.float64)
    steps[steps == _NOTHING] = np.nan
    array: FloatArray = given["low"] + given["step"] * (steps + _MOST)
    return array.reshape(given["shape"])
