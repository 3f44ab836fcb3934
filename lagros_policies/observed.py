"""What a policy accepts as an observation: finite numbers in the shape of the task."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import shown
from lagros_envs.options import real_numbers

Number = TypeVar("Number", np.float32, np.float64)


def as_numbers(observation: Any, dtype: type[Number]) -> NDArray[Number]:
    """Return an observation as an array; it is not copied where it is one already.

    Raises:
        ValueError: It is not made of numbers, as text, truth values and masked arrays are not.
    """
    if type(observation) is np.ndarray and observation.dtype.char in "fd":
        return np.asarray(observation, dtype)
    numbers = real_numbers(observation)
    if numbers is None:
        raise ValueError(
            f"the observation is a {type(observation).__name__} that is no array of numbers: "
            f"{shown(observation)}"
        )
    return numbers.astype(dtype)


def observed_rows(observation: Any, size: int, dtype: type[Number]) -> NDArray[Number]:
    """Return observations, (o,) or (B, o), as an array.

    Args:
        observation: As the environment returns it, one or a batch.
        size: Numbers o of an observation, `task.layout.size`.
        dtype: Single or double precision.

    Raises:
        ValueError: It has another shape, or is not made of finite numbers.
    """
    rows = as_numbers(observation, dtype)
    # The square is the quickest look at one row: beyond 1e19 it is none of the task, and looked at
    # again.
    if rows.shape == (size,) and rows.dot(rows) < math.inf:
        return rows
    if rows.ndim not in (1, 2) or rows.shape[-1] != size:
        raise ValueError(
            f"the observation has shape {rows.shape}; it must be ({size},), or (B, {size}) for a "
            "batch: build the policy from the environment that it flies, without wrappers"
        )
    if not np.isfinite(rows).all():
        raise ValueError("the observation is not finite")
    return rows
