"""What a network sees of an observation: written once, for NumPy, for training and for export.

The features of a task are one function over the kinds of number of `lagros_envs.numbers`: called
with floats or arrays it gives features, called with recorded numbers the list of its operations, of
which `lagros export` makes C and ONNX. It may use `+ - * /`, integer powers, `abs`, `<=`, `>` and
the functions that are passed to it, and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.numbers import functions

Float32Array = NDArray[np.float32]


class Seen(NamedTuple):
    """What is made of one observation.

    Attributes:
        features: What goes into the network.
        signs: What each of its outputs is multiplied by to be the control u, in units of u, not of
            the action; () for nothing. A task that is its own mirror image learns one side only.
    """

    features: Sequence[Any]
    signs: Sequence[Any] = ()


# (components of an observation, functions) -> features and signs.
See = Callable[[Sequence[Any], Any], Seen]


def seen(see: See, observation: Float32Array) -> tuple[Float32Array, Float32Array | None]:
    """Return the features and the signs of observations.

    Args:
        see: The function.
        observation: Shape (o,) or (..., o).

    Returns:
        Features, shape (f,) or (..., f), and signs, likewise; None where there are none.
    """
    # In double precision, rounded at the end; Python's floats are the quickest for one.
    if observation.ndim == 1:
        one = see(observation.tolist(), functions)
        signs = np.array(one.signs, np.float32) if one.signs else None
        return np.array(one.features, np.float32), signs
    components: Any = np.moveaxis(observation, -1, 0).astype(np.float64, order="C")
    many = see(components, functions)
    return _table(many.features, observation.shape[:-1]), (
        _table(many.signs, observation.shape[:-1]) if many.signs else None
    )


def _table(columns: Sequence[Any], shape: tuple[int, ...]) -> Float32Array:
    table = np.empty((*shape, len(columns)), np.float32)
    for place, column in enumerate(columns):
        table[..., place] = column
    return table
