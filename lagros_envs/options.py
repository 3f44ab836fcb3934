"""What all tasks read from the options of `reset`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def nominal_option(
    options: dict[str, Any],
    shape: tuple[int, ...],
    meaning: str,
    looked_at: NDArray[np.bool_] | None = None,
) -> FloatArray | None:
    """Return a copy of the option `nominal`, x_d at every control instant, if there is one.

    Args:
        options: As given to reset.
        shape: That it must have.
        meaning: What it is, for the message.
        looked_at: Which of the first axis have to be finite; all of them if left out.

    Raises:
        ValueError: The trajectory has the wrong shape or is not finite.
    """
    value = options.get("nominal")
    if value is None:
        return None
    nominal = np.array(value, dtype=np.float64)
    if nominal.shape != shape or not np.all(
        np.isfinite(nominal[... if looked_at is None else looked_at])
    ):
        raise ValueError(
            f"options['nominal'] has shape {nominal.shape}; it must be finite and of shape "
            f"{shape}, {meaning} at every control instant"
        )
    return nominal
