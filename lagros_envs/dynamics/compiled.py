"""Recorded steps compiled by numba, which is an optional dependency (the extra "fast").

Each process compiles for itself, which takes a second: what numba keeps on disk are pickles, and
this package reads none.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from lagros_envs.dynamics.straight_line import (
    IMPORTS,
    Measure,
    StraightLine,
    expression,
    recorded_hold,
    recorded_measure,
    statements,
)
from lagros_envs.dynamics.system import System
from lagros_envs.numbers import Recorded, functions
from lagros_envs.numbers.recorded import Operation

# Adding and subtracting it rounds a double below 2**51 to an integer, in two operations that a
# vector unit has.
_ROUNDER = 1.5 * 2.0**52
# pi in three parts; the first two have 26 bits, so that their products with integers are exact.
_PI_PARTS = (3.1415926218032837, 3.1786509424591713e-08, 1.2246467991473532e-16)
# Of an angle between -pi/2 and pi/2: the polynomials err by less than 1e-17 there.
_SINE_POWERS = range(3, 18, 2)
_COSINE_POWERS = range(2, 17, 2)
# Columns that go through all repeats before the next do, so that they stay in the first cache.
BLOCK = 128
# Before a loop the compiler makes sure that rows do not overlap, each that is written against all
# others. Beyond so many pairs it gives up, and the loop is not vectorised.
_MOST_PAIRS = 128


class VectorFunctions:
    """Functions of recorded numbers, with sine and cosine in arithmetic that can be vectorised.

    Within 6e-16 of the exact value for |x| < 1e6; a state of a task never comes near that.
    """

    @staticmethod
    def sin(x: Recorded) -> Any:
        """Record a sine."""
        rest, sign = _reduce(x)
        square = rest * rest
        return sign * (rest + (rest * square) * _polynomial(square, _economised(_SINE_POWERS)))

    @staticmethod
    def cos(x: Recorded) -> Any:
        """Record a cosine."""
        rest, sign = _reduce(x)
        square = rest * rest
        return sign * (1.0 + square * _polynomial(square, _economised(_COSINE_POWERS)))

    @classmethod
    def tan(cls, x: Recorded) -> Any:
        """Record a tangent."""
        return cls.sin(x) / cls.cos(x)

    exp = staticmethod(functions.exp)
    sqrt = staticmethod(functions.sqrt)


class CompiledBatch:
    """A held step on all worlds of a batch, compiled.

    Args:
        system: The system.
        duration: Length of the step [s].
        shape: Shape of the batch.
        substeps: Runge-Kutta steps in the step.
        measure: As in `recorded_hold`.
        given: As in `recorded_hold`.
        pushed: As in `recorded_hold`.

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
        pushed: bool = True,
    ) -> None:
        """Write the step, which its first call compiles, and allocate its inputs."""
        n = system.state_dim
        step = recorded_hold(system, duration / substeps, 1, VectorFunctions, pushed=pushed)
        tail = recorded_measure(system, measure, given, VectorFunctions) if measure else None
        inputs = len(step.inputs) + given
        size = math.prod(shape)
        # Whole blocks: the last columns may be nobody's.
        columns = size + -size % BLOCK
        self._flat = np.zeros((inputs + (len(tail.outputs) if tail else 0), columns))
        rows = self._flat[:, :size].reshape(-1, *shape)
        self.inputs, self.states, self.measured = rows[:inputs], rows[:n], rows[inputs:]
        self._held = compiled_function(batch_source(step, substeps, tail), fuse=True)

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
        numba's dispatcher; it compiles at its first call.

    Raises:
        ImportError: numba is not installed.
    """
    try:
        import numba
    except ImportError as error:
        raise ImportError(
            'compiled=True needs numba, which is not installed: pip install "lagros[fast]"'
        ) from error
    # Our own text: operators, the names of the inputs, and the numbers of the system.
    namespace: dict[str, Any] = {}
    exec(compile(source, "<held step>", "exec"), namespace)
    # "numpy": a division by zero is an infinity, not a branch that keeps loops from vectorising.
    decorate = numba.njit(error_model="numpy", fastmath={"arcp", "contract"} if fuse else False)
    return decorate(namespace["held"])


def batch_source(
    step: StraightLine,
    repeats: int,
    tail: StraightLine | None = None,
    abreast: int | None = None,
) -> str:
    """Return a module in Python whose function `held` repeats a step on the columns of an array.

    Args:
        step: What is repeated; its outputs go to its first inputs.
        repeats: How often.
        tail: What is computed at the end, from inputs of the step and from others.
        abreast: Columns that advance side by side; None for as many as the compiler takes.

    Returns:
        Source of `held(rows)`, where `rows` has shape (inputs + outputs of the tail, batch), in
        whole blocks, and is changed in place: the step's inputs, the tail's others, what the tail
        gives.
    """
    names = list(step.inputs)
    ending = ["pass"]
    count = len(names)
    if tail is not None:
        names += [name for name in tail.inputs if name not in names]
        lines, measured = statements(tail)
        ending = [f"{name} = row{names.index(name)}[i]" for name in tail.inputs] + lines
        ending += [f"row{len(names) + k}[i] = {output}" for k, output in enumerate(measured)]
        count = len(names) + len(measured)
    abreast = abreast or _abreast(len(step.inputs), len(step.outputs))
    return "\n".join(
        [
            IMPORTS,
            "",
            "def held(rows):",
            f"    for start in range(0, rows.shape[1], {BLOCK}):",
            *(f"        row{k} = rows[{k}][start:start + {BLOCK}]" for k in range(count)),
            f"        for _ in range({repeats}):",
            f"            for i in range({BLOCK // abreast}):",
            *(f"                {line}" for line in _side_by_side(step, abreast)),
            f"        for i in range({BLOCK}):",
            *(f"            {line}" for line in ending),
            "",
        ]
    )


def _abreast(inputs: int, outputs: int) -> int:
    """Return how many columns advance side by side, 1 or 2.

    Side by side an operation seldom waits for the one before it: a fourth faster.
    """
    others = 2 * (inputs - outputs)
    pairs = 2 * outputs * others + outputs * (2 * outputs - 1)
    return 2 if pairs <= _MOST_PAIRS else 1


def _side_by_side(step: StraightLine, abreast: int) -> list[str]:
    """Return the lines of a step on that many entries of each row, by turns."""
    places = {f"_{k}": f"i + {k * BLOCK // abreast}" for k in range(abreast)}
    results = {name: f"v{place}" for place, name in enumerate(step.operations)}
    results |= {name: name for name in step.inputs}

    def named(operand: str, side: str) -> str:
        return results[operand] + side if operand in results else operand

    def assigned(name: str, operation: Operation, side: str) -> str:
        operands = [named(operand, side) for operand in operation.operands]
        return f"{named(name, side)} = {expression(operation, operands)}"

    loads = [
        f"{named(name, side)} = row{k}[{place}]"
        for k, name in enumerate(step.inputs)
        for side, place in places.items()
    ]
    body = [assigned(name, one, side) for name, one in step.operations.items() for side in places]
    stores = [
        f"row{k}[{place}] = {named(name, side)}"
        for k, name in enumerate(step.outputs)
        for side, place in places.items()
    ]
    return [*loads, *body, *stores]


def _reduce(x: Recorded) -> tuple[Any, Any]:
    """Return x - k pi for the nearest integer k, and (-1)^k."""
    first, second, third = _PI_PARTS
    turns = (x * (1.0 / math.pi) + _ROUNDER) - _ROUNDER
    rest = ((x - turns * first) - turns * second) - turns * third
    odd = turns - 2.0 * ((turns * 0.5 + _ROUNDER) - _ROUNDER)
    return rest, 1.0 - 2.0 * (odd * odd)


@lru_cache(maxsize=2)
def _economised(powers: range) -> list[float]:
    """Return the coefficients of sine or cosine at these powers, for angles up to pi/2.

    The Taylor series in the square of the angle, twice as long as need be, is written in
    Chebyshev's polynomials and cut there, where it costs least (economisation, Lanczos 1956).
    """
    longer = range(powers.start, powers.stop + 2 * len(powers), 2)
    series = Polynomial([(-1) ** (power // 2) / math.factorial(power) for power in longer])
    in_chebyshev = series.convert(domain=[0.0, (math.pi / 2) ** 2], kind=Chebyshev)
    return cast(
        list[float], in_chebyshev.truncate(len(powers)).convert(kind=Polynomial).coef.tolist()
    )


def _polynomial(x: Any, coefficients: list[float]) -> Any:
    """Return the polynomial with these coefficients, the constant one first.

    By halves (Estrin), not by Horner's rule: operations that do not wait for each other overlap.
    """
    if len(coefficients) == 1:
        return coefficients[0]
    square = x * x
    even = _polynomial(square, coefficients[0::2])
    return even + x * _polynomial(square, coefficients[1::2])
