"""Recorded steps compiled by numba, which is an optional dependency (the extra "fast").

What is compiled is kept in the user's cache folder and found there by the next process. The file's
name is the hash of the source, so that no change of the physics meets an older result.
"""

from __future__ import annotations

import hashlib
import math
import os
import sys
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics.straight_line import (
    IMPORTS,
    Measure,
    Recorded,
    Recording,
    StraightLine,
    recorded_hold,
    statements,
)
from lagros_envs.dynamics.system import System
from lagros_envs.files import write_atomic

FloatArray = NDArray[np.float64]

# Adding and subtracting it rounds a double below 2**51 to an integer, in two operations that a
# vector unit has.
_ROUNDER = 1.5 * 2.0**52
# pi in three parts; the first two have 26 bits, so that their products with integers are exact.
_PI_PARTS = (3.1415926218032837, 3.1786509424591713e-08, 1.2246467991473532e-16)
# Taylor series on [-pi/2, pi/2]: the first term left out is below 1e-18.
_SINE_TERMS = range(3, 22, 2)
_COSINE_TERMS = range(2, 21, 2)


class VectorFunctions(Recording):
    """Functions of recorded numbers, with sine and cosine in arithmetic that can be vectorised.

    Within 6e-16 of the exact value for |x| < 1e6; a state of a task never comes near that.
    """

    @staticmethod
    def sin(x: Recorded) -> Any:
        """Record a sine."""
        rest, sign = _reduce(x)
        square = rest * rest
        return sign * (rest + rest * (square * _polynomial(square, _series(_SINE_TERMS))))

    @staticmethod
    def cos(x: Recorded) -> Any:
        """Record a cosine."""
        rest, sign = _reduce(x)
        square = rest * rest
        return sign * (1.0 + square * _polynomial(square, _series(_COSINE_TERMS)))


class CompiledBatch:
    """A held step on all worlds of a batch, compiled.

    Args:
        system: The system.
        duration: Length of the step [s].
        shape: Shape of the batch.
        substeps: Runge-Kutta steps in the step.
        measure: As in `recorded_hold`.
        given: As in `recorded_hold`.

    Attributes:
        inputs: x, u, d and what is given, to be filled in before a call, shape (inputs, *shape).
        states: x at the end of the step, in place of the inputs, shape (n, *shape).
        measured: What the measure computed, shape (measured, *shape).

    Raises:
        ImportError: numba is not installed.
    """

    def __init__(
        self,
        system: System,
        duration: float,
        shape: tuple[int, ...],
        substeps: int,
        measure: Measure | None = None,
        given: int = 0,
    ) -> None:
        """Compile the step, or load it, and allocate its inputs."""
        n = system.state_dim
        step = recorded_hold(system, duration / substeps, 1, VectorFunctions, measure, given)
        inputs = len(step.inputs)
        rows = np.zeros((inputs + len(step.outputs) - n, *shape))
        self.inputs, self.states, self.measured = rows[:inputs], rows[:n], rows[inputs:]
        self._flat = rows.reshape(len(rows), -1)
        self._held = compiled_function(batch_source(step, substeps, n), fuse=True)

    def __call__(self) -> None:
        """Evaluate at `inputs`."""
        self._held(self._flat)


@lru_cache(maxsize=32)
def compiled_function(source: str, fuse: bool = False) -> Any:
    """Compile the function `held` of a module that this package has written.

    Args:
        source: The module.
        fuse: Whether a product and a sum may become one operation with one rounding, and a
            quotient a product.

    Returns:
        numba's dispatcher; it compiles, or loads, at its first call.

    Raises:
        ImportError: numba is not installed.
    """
    try:
        import numba
    except ImportError as error:
        raise ImportError(
            'compiled=True needs numba, which is not installed: pip install "lagros[fast]"'
        ) from error
    name = f"lagros_held_{hashlib.sha256(source.encode()).hexdigest()[:24]}"
    path = _kept_source(name, source)
    module = ModuleType(name)
    # numba looks there for the globals of a function that it has found in its cache.
    sys.modules[name] = module
    exec(compile(source, path or name, "exec"), module.__dict__)
    # "numpy": a division by zero is an infinity, not a branch that keeps loops from vectorising.
    decorate = numba.njit(
        cache=path is not None,
        error_model="numpy",
        fastmath={"arcp", "contract"} if fuse else False,
    )
    return decorate(module.held)


def batch_source(step: StraightLine, repeats: int, fed: int) -> str:
    """Return a module in Python whose function `held` repeats a step on the columns of an array.

    Args:
        step: What is repeated.
        repeats: How often.
        fed: Outputs that go to the first inputs; the others go to rows behind the inputs.

    Returns:
        Source of `held(rows)`, where `rows` has shape (inputs + others, batch) and is changed in
        place.
    """
    lines, outputs = statements(step)
    targets = [*range(fed), *range(len(step.inputs), len(step.inputs) + len(outputs) - fed)]
    places = range(len(step.inputs) + len(outputs) - fed)
    body = [f"{name} = row{k}[i]" for k, name in enumerate(step.inputs)]
    body += lines
    body += [f"new{k} = {output}" for k, output in enumerate(outputs)]
    body += [f"row{target}[i] = new{k}" for k, target in enumerate(targets)]
    return "\n".join(
        [
            IMPORTS,
            "",
            "def held(rows):",
            *(f"    row{k} = rows[{k}]" for k in places),
            f"    for _ in range({repeats}):",
            "        for i in range(rows.shape[1]):",
            *(f"            {line}" for line in body),
            "",
        ]
    )


def _reduce(x: Recorded) -> tuple[Any, Any]:
    """Return x - k pi for the nearest integer k, and (-1)^k."""
    first, second, third = _PI_PARTS
    turns = (x * (1.0 / math.pi) + _ROUNDER) - _ROUNDER
    rest = ((x - turns * first) - turns * second) - turns * third
    odd = turns - 2.0 * ((turns * 0.5 + _ROUNDER) - _ROUNDER)
    return rest, 1.0 - 2.0 * (odd * odd)


def _series(powers: range) -> list[float]:
    """Return the coefficients of the Taylor series of sine or cosine at these powers."""
    return [float(Fraction((-1) ** (power // 2), math.factorial(power))) for power in powers]


def _polynomial(x: Any, coefficients: list[float]) -> Any:
    """Return the polynomial with these coefficients, the constant one first.

    By halves (Estrin), not by Horner's rule: operations that do not wait for each other overlap.
    """
    if len(coefficients) == 1:
        return coefficients[0]
    square = x * x
    even = _polynomial(square, coefficients[0::2])
    return even + x * _polynomial(square, coefficients[1::2])


def _kept_source(name: str, source: str) -> str | None:
    """Write the source to the cache folder and return its path, or None if that cannot be."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lagros"
    path = folder / f"{name}.py"
    try:
        if not path.is_file() or path.read_text(encoding="utf-8") != source:
            write_atomic(path, source)
    except OSError:
        return None
    return str(path)
